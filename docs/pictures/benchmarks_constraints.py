"""Draw the picture of benchmarks/constraints.md, from its table."""

import matplotlib.pyplot as plt
import numpy as np
from _page import number, save, table

from ccdtools.figure_style import styled

LEAST = 5e-4  # per cent: half a unit of the last digit in the table
names, start, found, learned = [], [], [], []
for row in table("benchmarks/constraints.md", "problem"):
    for k, name in enumerate(row[0].split(";")):
        names.append(name.strip())
        for values, cell in ((start, row[1]), (found, row[2]), (learned, row[3])):
            values.append(max(number(cell.split(";")[k]), LEAST))
with styled():
    figure, ax = plt.subplots(figsize=(7, 3.8), layout="constrained")
    for values, label, marker in ((start, "start", "s"), (found, "design found", "o"), (learned, "learned there", "^")):
        ax.semilogx(values, np.arange(len(names)), marker, label=label)
    ax.set_yticks(np.arange(len(names)), [name[:44] for name in names])
    ax.set(xlabel="cost above the exact optimum [%]")
    ax.legend()
    save(figure, __file__)
