"""Draw the picture of explanation/generations.md: the loop as a ring of its stages."""

from itertools import pairwise

import matplotlib.pyplot as plt
from _page import save

from ccdtools.figure_style import styled

STAGES = {  # place and words
    "imitate an expert": (0.0, 1.0), "co-design\npolicy and p": (1.0, 1.0), "decide:\ndeploy it?": (2.0, 1.0),
    "deploy on the\nreal plant, update": (3.0, 1.0), "decide:\nroll back?": (3.0, 0.0),
    "learn from\nthe log": (2.0, 0.0), "updated model": (1.0, 0.0),
}  # fmt: skip
NEXT = [0, 1, 2, 3, 4, 5, 6, 1]
with styled():
    figure, ax = plt.subplots(figsize=(9.5, 2.6), layout="constrained")
    places = list(STAGES.values())
    ax.plot(*zip(*places), ",", color="white")
    for text, (x, y) in STAGES.items():
        colour = "#DDEBDD" if text.startswith("decide") else "#DCE8F2"
        ax.text(x, y, text, ha="center", va="center", bbox={"boxstyle": "round,pad=0.5", "fc": colour, "ec": "#666666"})
    for a, b in pairwise(NEXT):
        along = places[a][1] == places[b][1]
        arrow = {"arrowstyle": "->", "shrinkA": 64 if along else 24, "shrinkB": 64 if along else 24}
        ax.annotate("", places[b], places[a], arrowprops=arrow)
    ax.set(xlim=(-0.5, 3.5), ylim=(-0.4, 1.4))
    ax.axis("off")
    save(figure, __file__)
