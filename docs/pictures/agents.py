"""Draw the picture of how_to/agents.md."""

from _page import run, save

save(run("how_to/agents.md")["ax"].figure, __file__)
