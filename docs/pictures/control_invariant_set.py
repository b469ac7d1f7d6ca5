"""The largest control invariant set of a plant, and a careless controller with and without the filter."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from invariant_sets import AdmissibleInputs, Polytope, maximal_control_invariant_set

A = np.array([[0.8, 0.5], [0.5, 0.6]])
B = np.array([[0.5], [1.0]])
X = Polytope.from_bounds([-10, -5], [5, 2])
U = Polytope.from_bounds([-1], [1])
C = maximal_control_invariant_set(A, B, X, U).set
inputs = AdmissibleInputs(A, B, C, U)
starts = C.sample(50, rng=np.random.default_rng(1))

figure = Figure(figsize=(8, 3.4), layout="constrained")
for ax, title in zip(figure.subplots(1, 2, sharex=True, sharey=True), ("filtered", "without the filter")):
    C.plot(ax=ax, alpha=0.25)
    X.plot(ax=ax, facecolor="none", edgecolor="k", linestyle=":")
    x = starts
    path = [x]
    for _ in range(40):
        u = np.clip(-0.2 * x[:, :1] + 0.9 * np.sin(3 * x[:, 1:]), -1, 1)
        u = inputs.project(x, u)[0] if title == "filtered" else u
        x = x @ A.T + u @ B.T
        path.append(x)
    ax.plot(*np.moveaxis(path, 2, 0), color="#D55E00", lw=0.6)
    ax.set(title=f"{title}: 50 starts in C", xlabel="$x_1$ [-]", ylabel="$x_2$ [-]", xlim=(-12, 7), ylim=(-6, 3))
figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)
