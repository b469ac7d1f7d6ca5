"""Draw the picture of reference/decision_rules.md, from the table of deployed changes."""

import matplotlib.pyplot as plt
import numpy as np
from _page import number, save, table

from ccdtools.figure_style import styled

PAGE, FIRST = "benchmarks/loop.md", "default run of the suspension"
PLACES = ("study's start", "on a mild road", "mild driver", "aggressive driver", "box of starts")
with styled():
    figure, ax = plt.subplots(figsize=(7, 3), layout="constrained")
    for row, marker in zip(table(PAGE, FIRST), "s^o"):
        cells = [cell.split("±") for cell in row[1:]]
        ax.errorbar(np.arange(len(PLACES)), [number(a) for a, _ in cells], yerr=[number(b) for _, b in cells],
                    fmt=marker, capsize=3, label=row[0])  # fmt: skip
    ax.axhline(-0.5, color="#444444", lw=0.9, ls="--", label="accepted loss")
    ax.set_xticks(np.arange(len(PLACES)), PLACES)
    ax.set(ylabel="difference on the real plant [%]")
    ax.legend()
    save(figure, __file__)
