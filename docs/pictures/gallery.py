"""Draw the picture of gallery/index.md and print its table: nested LQR of six studies, from their start designs."""

import matplotlib.pyplot as plt
import numpy as np
from _page import save

from ccdtools import Nested, codesign, load_study, saturated_lqr, simulate
from ccdtools.figure_style import COLOURS, styled

STUDIES = {  # the state that is shown
    "illustrative": 0, "suspension": 3, "quarter_car": 3, "dc_servo": 0, "mass_chain": 3, "wind_turbine": 0,
}  # fmt: skip


def drawn(ax, name, state):
    """Draw one state under LQR of the start design and of the design found; print the row of the table."""
    study = load_study(name)
    problem = study.problem()
    result = codesign(problem, method=Nested("lqr", starts=1), design=study.p0, rng=np.random.default_rng(0))
    x0, w = problem.scenarios.sample(200, problem.steps, np.random.default_rng(1))
    mean = []
    for label, p, colour in (("start", study.p0, "passive"), ("co-designed", result.design, "learned")):
        run = simulate(problem.model, saturated_lqr(problem, p), x0=x0, steps=problem.steps, disturbance=w, design=p)
        mean.append(run.returns(problem.objective).mean())
        ax.plot(run.time, run.states[0, :, state], color=COLOURS[colour], label=label)
    names = ", ".join(f"{n} = {v:.4g}" for n, v in zip(study.plant.design.names, result.design))
    ax.set(title=name, xlabel="time [s]", ylabel=study.plant.state_names[state])
    print(f"| `{name}` | {names} | {mean[0]:.4g} → {mean[1]:.4g} | {result.status.name} |", flush=True)


with styled():
    figure, axes = plt.subplots(2, 3, figsize=(10, 4.6), layout="constrained")
    for ax, (name, state) in zip(axes.flat, STUDIES.items()):
        drawn(ax, name, state)
    axes[0, 0].legend()
    save(figure, __file__)
