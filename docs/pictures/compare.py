"""Draw the picture of how_to/compare.md."""

from _page import run, save

save(run("how_to/compare.md")["ax"].figure, __file__)
