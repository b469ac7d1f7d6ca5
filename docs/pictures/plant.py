"""Draw the picture of how_to/plant.md."""

from _page import run, save

save(run("how_to/plant.md")["figure"], __file__)
