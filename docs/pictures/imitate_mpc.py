"""Draw the picture of how_to/imitate_mpc.md."""

from _page import run, save

save(run("how_to/imitate_mpc.md")["ax"].figure, __file__)
