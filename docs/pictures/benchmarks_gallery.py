"""Draw the picture of benchmarks/gallery.md, from its table of first co-designs."""

import matplotlib.pyplot as plt
from _page import number, save, table

from ccdtools.figure_style import styled

rows = [row for row in table("benchmarks/gallery.md", "first co-design") if row[0] != "`rail_mass`"]
with styled():
    figure, ax = plt.subplots(figsize=(7, 3.2), layout="constrained")
    for column, label, marker, shift in (
        (2, "from the study's start", "o", -0.12),
        (3, "from the worst corner", "^", 0.12),
    ):
        points = [(number(v), i + shift) for i, row in enumerate(rows) for v in row[column].split(",")]
        ax.plot(*zip(*points), marker, ls="none", label=label)
    ax.axvline(0.5, color="#444444", lw=0.9, ls="--", label="required")
    ax.set_yticks(range(len(rows)), [row[0].strip("`") for row in rows])
    ax.set(xlabel="below the independent optimum [%]; rail_mass (−19 to −16 %) left out")
    ax.legend(loc="lower left")
    save(figure, __file__)
