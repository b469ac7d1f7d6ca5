"""Draw the picture of benchmarks/paper.md, from its tables: returns before and after the first co-design."""

import matplotlib.pyplot as plt
from _page import DOCS, number, save

from ccdtools.figure_style import styled

COLUMNS = {"paper": 1, "LQR at the paper's design": 3, "ours": 5, "optimum": 6}
LOOKS = {"paper": "ks", "LQR at the paper's design": "o", "ours": "D", "optimum": "k|"}

lines = (DOCS / "benchmarks" / "paper.md").read_text(encoding="utf-8").splitlines()
tables = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("| return ")]
rows = [row for row in tables if row[0].startswith(("return before", "return after"))]
with styled():
    figure, axes = plt.subplots(1, 2, figsize=(9, 2.4), layout="constrained", sharey=True)
    for ax, own, case in zip(axes, (rows[:3], rows[3:]), ("illustrative", "suspension")):
        for name, column in COLUMNS.items():
            ax.plot([number(row[column]) for row in own], range(len(own)), LOOKS[name], ms=7, label=name)
        ax.set(xlabel="mean return", title=case)
        ax.set_yticks(range(len(own)), [row[0].replace("the first ", "") for row in own])
        ax.invert_yaxis()
    axes[0].invert_yaxis()
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    save(figure, __file__)
