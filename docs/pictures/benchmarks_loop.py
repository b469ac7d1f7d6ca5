"""Draw the picture of benchmarks/loop.md, from its table of the preview."""

import re

import matplotlib.pyplot as plt
from _page import number, save, table

from ccdtools.figure_style import styled

rows = [row for row in table("benchmarks/loop.md", " | without") if len(row) == 4]
with styled():
    figure, ax = plt.subplots(figsize=(7, 2.4), layout="constrained")
    for i, row in enumerate(rows):
        mean = number(row[3])
        low, high = (float(end) for end in re.search(r"\[(.*), (.*)\]", row[3]).groups())
        ax.errorbar(mean, i, xerr=[[mean - low], [high - mean]], fmt="o", capsize=3, color="#0072B2")
    ax.set_yticks(range(len(rows)), [row[0] for row in rows])
    ax.set(xlabel="gain of 0.5 s of preview [%]", xlim=(0, None))
    save(figure, __file__)
