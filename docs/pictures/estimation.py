"""Draw the picture of how_to/estimation.md."""

from _page import run, save

save(run("how_to/estimation.md")["figure"], __file__)
