"""The detailed active suspension of Allison, Guo and Han (2014), simultaneous and nested."""
