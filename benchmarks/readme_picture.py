"""The picture of the README, from a run of the suspension study: python benchmarks/readme_picture.py RUN OUT."""

import csv
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from ccdtools.controllers.controllers import LinearFeedback, Passive
from ccdtools.controllers.learned import load_policy
from ccdtools.simulation import simulate
from ccdtools.studies import load_study
from mpc import lqr

GRID = 13  # designs on each axis of the map
RUNS = 200
SHOWN = 100  # samples of the trajectories


def regulator(study, design):
    """Return saturated LQR of the nominal model at one design."""
    A, B, _ = study.model.matrices(design)
    gain, _ = lqr(A, B, Q=study.objective.Q, R=study.objective.R)
    return LinearFeedback(gain, *study.problem().input_bounds)


def returns_of(study, designs):
    """Return the mean return of LQR at each design, on common random numbers."""
    x0, w = study.problem().scenarios.sample(RUNS, study.steps, np.random.default_rng(0))
    loops = (
        simulate(study.model, regulator(study, p), x0=x0, steps=study.steps, disturbance=w, design=p) for p in designs
    )
    return np.array([loop.returns(study.objective).mean() for loop in loops])


def path_of(run):
    """Return the designs (k, 2) of the first co-design."""
    with open(run / "learning_curves.csv", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["generation"] == "1"]
    return np.array([[float(row["k_s"]), float(row["c_s"])] for row in rows])


def draw_map(ax, study, path):
    """Draw the return over the box of designs and the path of the co-design."""
    space = study.problem().design
    springs = np.linspace(space.lower[0], space.upper[0], GRID)
    dampers = np.linspace(space.lower[1], space.upper[1], GRID)
    designs = np.array([[k, c] for c in dampers for k in springs])
    mean = returns_of(study, designs).reshape(GRID, GRID)
    levels = np.arange(-180, -39, 10)
    filled = ax.contourf(springs / 1e3, dampers / 1e3, mean, levels=levels, cmap="Blues_r", extend="min")
    ax.figure.colorbar(filled, ax=ax, label="mean return of LQR")
    ax.plot(*(path.T / 1e3), color="#d95f02", lw=1.8, label="co-design")
    ax.plot(*(path[0] / 1e3), "s", color="#d95f02", mec="white", ms=8, label="start")
    ax.plot(*(path[-1] / 1e3), "*", color="#d95f02", mec="white", ms=16, clip_on=False, zorder=5, label="optimum")
    ax.set(xlabel="spring $k_s$ [kN/m]", ylabel="damper $c_s$ [kN·s/m]", title="Policy and design, optimised together")
    ax.legend(loc="lower right", framealpha=0.9)


def draw_ride(ax, study, run, design):
    """Draw the speed of the body over one road: the first design passive and with LQR, the final one as learned."""
    x0, w = study.problem().scenarios.sample(1, SHOWN, np.random.default_rng(4))
    policy = load_policy(run / "policy.safetensors")
    shown = (
        ("start design, passive", Passive(1), study.p0, "#bbbbbb"),
        ("start design, LQR", regulator(study, study.p0), study.p0, "#1f77b4"),
        ("final design, learned", policy, design, "#d95f02"),
    )
    time = study.plant.dt * np.arange(SHOWN + 1)
    for label, controller, p, colour in shown:
        loop = simulate(study.real.plant, controller, x0=x0, steps=SHOWN, disturbance=w, design=p)
        ax.plot(time, loop.states[0, :, 3], color=colour, lw=1.6, label=label)
    ax.axhline(0, color="k", lw=0.5)
    ax.set(xlabel="time [s]", ylabel="speed of the body [m/s]", title="The real plant on one road", xlim=(0, time[-1]))
    ax.legend(framealpha=0.9)


def main(run: Path, target: Path) -> None:
    """Write the picture."""
    study = load_study("suspension")
    path = path_of(run)
    figure, axes = plt.subplots(1, 2, figsize=(11, 3.9), layout="constrained")
    draw_map(axes[0], study, path)
    draw_ride(axes[1], study, run, path[-1])
    figure.savefig(target, dpi=110)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
