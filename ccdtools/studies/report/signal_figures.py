"""Figures of the policy, of states and inputs, and of one-step errors."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ccdtools import figure_style as style
from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.evidence.percent import share
from ccdtools.studies.report.finished_run import FinishedRun, ReportFigure
from ccdtools.studies.report.formatting import generation_name
from ccdtools.studies.stage_storage import log_of
from ccdtools.twin.budgets import BLOCKS
from ccdtools.twin.residuals import residuals
from ccdtools.twin.tolerances import HELD_OUT
from invariant_sets import plot_polytope


def policy_surface(run: FinishedRun) -> list[ReportFigure]:
    """Figure of the policy, LQR and their difference over two states."""
    from ccdtools.controllers.history import load_policy  # loads torch

    plant = run.study.plant
    if plant.nx != 2:
        return []
    policy = load_policy(run.folder.path / "policy.safetensors")
    lower, upper = run.problem.state_limits(policy.design).bounding_box()
    n = 121  # values of each of the two states
    x = np.linspace(lower, upper, n).T
    states = np.stack(np.meshgrid(*x), axis=-1).reshape(-1, 2)
    learned, lqr = (controller(states).reshape(n, n, -1)
                    for controller in (policy, saturated_lqr(run.problem, policy.design)))  # fmt: skip
    outline = run.sets.at(policy.design)
    figure = style.blank(11, 0.6 + 2.8 * plant.nu, quick=run.quick)
    grid = figure.subplots(plant.nu, 3, squeeze=False, sharex=True, sharey=True)
    for row, unit in enumerate(plant.input_names):
        one, two = learned[..., row], lqr[..., row]
        largest = max(np.abs(one).max(), np.abs(two).max(), 1e-12)
        for ax, title, values, top, colours in (
            (grid[row, 0], "learned", one, largest, "RdBu_r"),
            (grid[row, 1], "LQR", two, largest, "RdBu_r"),
            (grid[row, 2], "learned − LQR", one - two, max(np.abs(one - two).max(), 1e-12), "PuOr_r"),
        ):
            mesh = style.without_grid(ax).pcolormesh(
                *x, values, cmap=colours, vmin=-top, vmax=top, shading="nearest", rasterized=True
            )
            plot_polytope(outline, ax=ax, facecolor="none", edgecolor="k", lw=1.3)
            ax.set_title(title)
            ax.set(xlabel=plant.state_names[0], xlim=x[0][[0, -1]], ylim=x[1][[0, -1]])
            style.without_grid(figure.colorbar(mesh, ax=ax, shrink=0.9, label=unit).ax)
        grid[row, 0].set_ylabel(plant.state_names[1])
    caption = (
        f"The policy as it was last deployed, over X at {run.describe(policy.design)}, beside saturated LQR; inside "
        "X_fea (black outline) the two should differ little or for a reason, outside it nothing was trained."
    )
    return [ReportFigure("policy", "Policy surface", caption, figure)]


def trajectories(run: FinishedRun) -> list[ReportFigure]:
    """Figures of states and inputs, on the model and on the real plant."""
    return [_trajectories_on(run, kind) for kind in ("model", "real")]


def _trajectories_on(run: FinishedRun, kind: str) -> ReportFigure:
    plant = run.study.plant
    stages = {g: run.folder.read_stage(f"comparison-{g}").arrays for g in (0, run.last)}
    single = kind == "real" and run.study.real.runs == 1
    window = _active_part(stages[0][f"{kind}_LQR_states"][1], run.problem.state_scale) if single else slice(0, None)
    labels = [*plant.state_names, *plant.input_names]
    figure = style.blank(11, 0.9 + 1.45 * len(labels), quick=run.quick)
    grid = figure.subplots(len(labels), len(stages), squeeze=False, sharex="col", sharey="row")
    limits = [_limits(run, run.designs[g]) for g in stages]
    for column, (g, arrays) in zip(grid.T, stages.items()):
        for name in ("LQR", "learned"):
            low, mean, high = _signals(arrays, f"{kind}_{name}", window)
            time = plant.dt * (np.arange(len(mean)) + window.start)
            for i, ax in enumerate(column):
                ax.fill_between(time, low[:, i], high[:, i], color=style.COLOURS[name], alpha=0.15, lw=0)
                ax.plot(time, mean[:, i], color=style.COLOURS[name], label=name, **style.LINES[name])
        title = style.title(f"{generation_name(g)}: {run.describe(run.designs[g])}")
        column[0].set_title(title, color=style.generation_colour(g))
        column[-1].set_xlabel(run.time_label)
    for i, label in enumerate(labels):
        low, high = grid[i, 0].get_ylim()
        for ax, edges in zip(grid[i], limits):
            for edge in edges[:, i]:
                if low - 0.05 * (high - low) <= edge <= high + 0.05 * (high - low):
                    ax.axhline(edge, **style.BOUND)
        grid[i, 0].set_ylabel(style.label(label))
    grid[0, 0].legend(ncols=2, loc="best")
    figure.align_ylabels()
    what = "the liveliest part of the one recorded run" if single else "mean and 95 % band of the runs"
    caption = (
        f"States and inputs under LQR (broad, pale) and the learned policy (thin), at the start design (left) and the "
        f"final one (right): {what}. Dashed lines are limits of X and U at that design where they are in sight."
    )
    if kind == "model":
        caption += " Left the nominal model from x0; right the model with logged errors replayed, if there was a log."
    title = "Trajectories on the model" if kind == "model" else "Trajectories on the real plant"
    return ReportFigure(f"trajectories_{kind}", title, caption, figure)


def _limits(run: FinishedRun, design: Array) -> Array:
    """Lower and upper limits (2, nx + nu) of states and inputs at a design."""
    boxes = [limits(design).bounding_box() for limits in (run.problem.state_limits, run.problem.input_limits)]
    return np.concatenate(boxes, axis=1)


def _signals(arrays: Mapping[str, Array], name: str, window: slice) -> Array:
    """States and inputs of a controller, (3, T, nx + nu): low, mean, high."""
    states = arrays[f"{name}_states"]
    inputs = arrays[f"{name}_inputs"]
    return np.concatenate([states[:, : inputs.shape[1]], inputs], axis=2)[:, window]


def _active_part(states: Array, scale: Array, shown: int = 200) -> slice:
    """Liveliest part of a long run, by scaled states."""
    steps = len(states) - 1
    if steps <= shown:
        return slice(0, None)
    energy = np.r_[0.0, np.cumsum(((states / scale) ** 2).sum(axis=1))]
    starts = np.arange(0, steps - shown + 1, 10)
    start = int(starts[np.argmax(energy[starts + shown] - energy[starts])])
    return slice(start, start + shown)


def quantiles(run: FinishedRun) -> list[ReportFigure]:
    """Figures of learned quantiles and errors after every deployment."""
    taught = [g["generation"] for g in run.results["generations"] if g["deployed_diverged"] < 1]
    return [_quantiles_of(run, generation) for generation in taught]


def _quantiles_of(run: FinishedRun, generation: int) -> ReportFigure:
    plant = run.study.plant
    log = residuals(run.study.model, log_of(run.folder.read_stage(f"deployment-{generation}"), plant.dt))
    network = run.folder.read_stage(f"twin-{generation}").networks["quantiles"]
    total = log.steps
    held_out = max(round(HELD_OUT * total / BLOCKS), 2)
    count = min(150, total if log.runs > 1 else held_out)  # errors that are drawn
    end = log.part(slice(-1, None), slice(total - count, None))
    predicted = network.predict(np.hstack([end.e[0], end.x[0], end.u[0]]))
    time = plant.dt * np.arange(total - count, total)
    figure = style.blank(10, 0.9 + 1.55 * plant.nx, quick=run.quick)
    grid = figure.subplots(plant.nx, 1, squeeze=False, sharex=True)[:, 0]
    outer = f"{network.levels[0]:g} to {network.levels[-1]:g} quantile"
    learned = style.COLOURS["learned"]
    for i, (ax, label) in enumerate(zip(grid, plant.state_names)):
        errors = end.e_next[0, :, i]
        low, median, high = (predicted[:, k, i] for k in (0, len(network.levels) // 2, -1))
        inside = (errors >= low) & (errors <= high)
        ax.fill_between(time, low, high, color=learned, alpha=0.25, lw=0, label=outer)
        ax.plot(time, median, color=learned, lw=1.3, label="median")
        ax.plot(time, errors, ".-", color="k", lw=0.5, ms=3.5, label="logged error")
        ax.plot(time[~inside], errors[~inside], "o", mfc="none", mec=style.COLOURS["LQR"], ms=6, label="outside")
        ax.set_ylabel(style.label(f"error of {label}"))
        ax.set_title(f"{inside.mean():.0%} inside", loc="right", fontsize=8, pad=3)
    grid[-1].set_xlabel(run.time_label)
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper center", ncols=4, frameon=False)
    figure.align_ylabels()
    stated = run.results["generations"][generation - 1]["quantiles"]["nominal_coverage"]
    caption = (
        f"One-step errors of the nominal model at the end of deployment {generation}, which training had not seen, in "
        f"the learned quantiles: about {share(stated)} should lie inside the band, and the median should follow what "
        "can be predicted."
    )
    return ReportFigure(f"quantiles_{generation}", f"Learned quantiles, generation {generation}", caption, figure)
