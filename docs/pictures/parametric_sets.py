"""Control invariant sets of four designs, and their area over the design with its derivative."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from invariant_sets import ParametricSet, plot_family

family = ParametricSet(lambda p: ([[0.8, 0.5], [0.5, 0.6]], [[0.5], [p[0]]]), X=([-10, -5], [5, 2]), U=(-1, 1))
designs = np.array([0.5, 1.0, 1.5, 2.0])

figure = Figure(figsize=(8, 3.4), layout="constrained")
sets, area = figure.subplots(1, 2)
plot_family([family.at([p]) for p in designs], values=designs, labels=[f"p = {p}" for p in designs], ax=sets)
sets.set(xlabel="$x_1$ [-]", ylabel="$x_2$ [-]", title="C(p)")
sets.legend(loc="lower left")
grid = np.linspace(0.5, 3, 40)
area.plot(grid, family.volume(grid[:, None]))
for p in (1.0, 2.0):
    ends = np.array([-0.3, 0.3])
    area.plot(p + ends, family.volume([p]) + family.volume_gradient([p])[0] * ends, "k--")
area.set(xlabel="p [-]", ylabel="area [-]", title="area of C(p) and its derivative")
figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)
