"""Draw the picture of explanation/glossary.md: the depth of a state outside X."""

import matplotlib.pyplot as plt
from _page import save

from ccdtools.figure_style import styled
from invariant_sets import Polytope

with styled():
    figure, ax = plt.subplots(figsize=(6, 2.8), layout="constrained")
    Polytope.from_bounds([-2.0, -1.0], [2.0, 1.0]).plot(ax=ax, alpha=0.3)
    ax.plot(3.0, 0.4, "o", color="#D55E00")
    for start, end, y, text in ((0.0, 2.0, 0.0, "half-width"), (2.0, 3.0, 0.4, "depth 0.5")):
        ax.annotate("", (end, y), (start, y), arrowprops={"arrowstyle": "<->", "shrinkA": 0, "shrinkB": 0})
        ax.text((start + end) / 2, y + 0.08, text, ha="center")
    ax.text(-1.9, 0.75, "X")
    ax.set(xlim=(-2.5, 3.6), ylim=(-1.3, 1.3), xlabel="$x_1$", ylabel="$x_2$")
    save(figure, __file__)
