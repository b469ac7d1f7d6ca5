"""Draw the picture of benchmarks/intervals.md, from its table of series."""

import matplotlib.pyplot as plt
from _page import number, save, table

from ccdtools.figure_style import styled

with styled():
    figure, ax = plt.subplots(figsize=(7, 3.4), layout="constrained")
    for i, row in enumerate(table("benchmarks/intervals.md", " | 1000 samples")):
        ax.plot([number(cell.split(",")[1]) for cell in row[1:]], marker="os^"[i % 3], label=row[0])
    ax.axhline(95, color="#444444", lw=0.9, ls="--")
    ax.set_xticks(range(3), ["1000", "5000", "15 000"])
    ax.set(xlabel="samples", ylabel="covers, where given [%]")
    figure.legend(loc="outside right upper")
    save(figure, __file__)
