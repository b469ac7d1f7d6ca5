"""Draw the picture of benchmarks/plants.md, from its table."""

import matplotlib.pyplot as plt
from _page import number, save, table

from ccdtools.figure_style import styled

rows = [row for row in table("benchmarks/plants.md", "plant | method, parts a sample") if len(row) == 5]
with styled():
    figure, ax = plt.subplots(figsize=(7, 3), layout="constrained")
    for column, label, marker in ((2, "stated", "s"), (3, "met", "o")):
        ax.semilogx([number(row[column]) for row in rows], [row[0] for row in rows], marker, label=label)
    ax.set(xlabel="largest error of a sample [half-widths of X]")
    ax.legend()
    save(figure, __file__)
