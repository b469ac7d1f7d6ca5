"""Draw the picture of how_to/objectives.md."""

from _page import run, save

save(run("how_to/objectives.md")["figure"], __file__)
