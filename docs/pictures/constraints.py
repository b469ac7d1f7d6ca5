"""Draw the picture of how_to/constraints.md."""

import matplotlib.pyplot as plt
import numpy as np
from _page import run, save

from ccdtools import saturated_lqr, simulate
from ccdtools.figure_style import draw_map, styled

page = run("how_to/constraints.md")
problem, space, found = page["problem"], page["space"], page["result"].design
k, c = np.linspace(1.0, 5.0, 13), np.linspace(0.1, 1.0, 13)
x0, w = problem.scenarios.sample(100, problem.steps, np.random.default_rng(1))


def value(design):
    """The mean return of saturated LQR at one design."""
    loop = simulate(problem.model, saturated_lqr(problem, design), x0=x0, steps=problem.steps, disturbance=w,
                    design=design)  # fmt: skip
    return loop.returns(problem.objective).mean()


values = np.array([[value([a, b]) for a in k] for b in c])
with styled():
    figure, ax = plt.subplots(figsize=(6, 3.4), layout="constrained")
    draw_map(ax, k, c, values, np.isfinite(values), label="return of saturated LQR")
    ax.fill_between(k, (3.2 - k) / 2, 1.0, fc="none", ec="#444444", hatch="//", label="beyond the budget")
    ax.plot(*found, "*", color="#D55E00", mec="white", ms=16, label="co-designed")
    ax.set(xlabel="k", ylabel="c", ylim=(0.1, 1.0))
    ax.legend(loc="lower right")
    save(figure, __file__)
