"""Plots of solutions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mpc.checks import Array
from mpc.exceptions import InputError
from mpc.optimal_control.phase_solution import PhaseSolution


def plot_phases(phases: Sequence[PhaseSolution], *, costates: bool, mesh: bool, title: str, figure: Any = None) -> Any:
    """Figure with states, inputs and costates, one phase a column; see `Solution.plot`."""
    import matplotlib.pyplot as plt

    states = max(phase.part.layout.nx for phase in phases)
    inputs = max(phase.part.layout.nu for phase in phases)
    rows = [("x", i) for i in range(states)] + [("u", i) for i in range(inputs)]
    rows += [("costate", i) for i in range(states)] * bool(costates)
    longest = max(phase.duration for phase in phases)
    widths = [max(phase.duration / longest, 0.25) for phase in phases]
    if figure is None:
        figure = plt.figure(figsize=(7.0 * min(max(sum(widths), 1.0), 2.5), 1.5 * (len(rows) + 0.5)),
                            layout="constrained")  # fmt: skip
    elif not hasattr(figure, "subplots"):
        raise InputError("figure", type(figure).__name__, "a matplotlib Figure")
    axes = figure.subplots(len(rows), len(phases), sharex="col", sharey="row", squeeze=False, width_ratios=widths)
    for column, phase in enumerate(phases):
        for row, (kind, i) in enumerate(rows):
            ax = axes[row, column]
            names = phase.part.phase.input_names if kind == "u" else phase.part.phase.state_names
            if i >= len(names):
                ax.set_axis_off()
                continue
            _entry(ax, phase, kind, i)
        last = [ax for ax in axes[:, column] if ax.axison][-1]
        last.tick_params(labelbottom=True)
        last.set_xlabel("step" if phase.part.phase.discrete else "t [s]")
        if mesh:
            last.plot(phase.times, np.zeros(len(phase.times)), "|", color="0.3", ms=5, clip_on=False,
                      transform=last.get_xaxis_transform())  # fmt: skip
        if len(phases) > 1:
            axes[0, column].set_title(f"phase {column + 1}", fontsize="medium")
    for row, (kind, i) in enumerate(rows):
        column = next(k for k, ax in enumerate(axes[row]) if ax.axison)
        of = phases[column].part.phase
        name = (of.input_names if kind == "u" else of.state_names)[i]
        axes[row, column].tick_params(labelleft=True)
        axes[row, column].set_ylabel(f"costate of {name}" if kind == "costate" else name)
    figure.suptitle(title, fontsize="medium")
    return figure


def _entry(ax: Any, phase: PhaseSolution, kind: str, i: int) -> None:
    """Draw one state, input or costate, and its bounds."""
    discrete = phase.part.phase.discrete
    if kind == "costate":
        ax.plot(phase.times, phase.costates[:, i], color="C2", lw=1.2)
        return
    if kind == "x" and discrete:
        ax.plot(phase.times, phase.states[:, i], "o-", color="C0", ms=3, lw=0.6)
        values = phase.states[:, i]
    elif kind == "x":
        times = _fine(phase.times).ravel()
        values = phase.x(times)[:, i]
        ax.plot(times, values, color="C0", lw=1.2)
    else:
        values = _input(ax, phase, i)
    sides = phase.part.phase.u_bounds if kind == "u" else phase.part.phase.x_bounds
    margin = 0.05
    extent = max(float(np.ptp(values)), float(np.abs(values).max()) * margin)
    for bound in (sides[0][i], sides[1][i]):
        if np.isfinite(bound) and values.min() - extent <= bound <= values.max() + extent:
            ax.axhline(bound, color="0.5", ls="--", lw=0.8)
    ax.margins(y=margin)


def _input(ax: Any, phase: PhaseSolution, i: int) -> Array:
    """Draw an input, which may jump; return its values."""
    known = phase.stages.inputs[:, :, i]
    if known.shape[1] == 1:  # held over every interval
        ax.step(phase.times, np.append(known[:, 0], known[-1, 0]), where="post", color="C1", lw=1.2)
        return known.ravel()
    times = _fine(phase.times)
    inside = times[:, :-1] + 0.5 * np.diff(times, axis=1)
    inside[:, 0], inside[:, -1] = times[:, 0], times[:, -1] - 1e-9 * np.diff(phase.times)
    values = np.concatenate([phase.u(inside), phase.z(inside)], axis=2)[:, :, i]
    gaps = np.full((len(inside), 1), np.nan)
    ax.plot(np.hstack([inside, gaps]).ravel(), np.hstack([values, gaps]).ravel(), color="C1", lw=1.2)
    return values.ravel()


def _fine(mesh: Array) -> Array:
    """Times (N, 13) within every interval, ends included."""
    return mesh[:-1, None] + np.diff(mesh)[:, None] * np.linspace(0, 1, 13)
