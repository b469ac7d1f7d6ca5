"""Draw the picture of how_to/codesign.md."""

from _page import run, save

save(run("how_to/codesign.md")["figure"], __file__)
