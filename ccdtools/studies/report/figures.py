"""Figures of a report, one function each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ccdtools import figure_style as style
from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.learned import load_policy
from ccdtools.evidence.percent import share
from ccdtools.studies.report import plotting, return_plots
from ccdtools.studies.report.finished_run import FinishedRun
from ccdtools.studies.report.formatting import generation_name, place
from ccdtools.studies.report.landscape import landscape
from ccdtools.studies.report.report_figure import ReportFigure
from ccdtools.studies.report.set_figure import feasible_set_figure
from ccdtools.studies.report.summary import in_first_place
from ccdtools.studies.tolerances import SHOWN_STEPS, SURFACE_GRID
from ccdtools.trajectory import Trajectory
from ccdtools.twin.residuals import residuals
from ccdtools.twin.twin import BLOCKS, HELD_OUT


def figures(run: FinishedRun) -> Iterator[ReportFigure]:
    """Figures that the study can have."""
    makers: list[Callable[[FinishedRun], list[ReportFigure]]] = [
        _changes, _history, landscape, _comparison, feasible_set_figure, _policy_surface, _trajectories, _quantiles,
    ]  # fmt: skip
    for make in makers:
        with style.styled():
            made = make(run)
        yield from made


def _changes(run: FinishedRun) -> list[ReportFigure]:
    """Figure of the changes from LQR at the start, and their sources."""
    rows = in_first_place(run.results)
    places = run.results["gains"]
    figure = style.blank(11, 1.0 + 0.36 * max(len(rows), 2 * len(places)), quick=run.quick)
    left, right = figure.subplots(1, 2)
    return_plots.plot_changes(left, rows)
    return_plots.plot_gains(right, places)
    caption = (
        "From LQR at the start design to what is deployed at the end, on the real plant and the same disturbances. "
        "Left: the cost in every place, and every other number where the plant was deployed, with 95 % intervals. "
        "Right: the gain in return by what brought it."
    )
    return [ReportFigure("changes", "What changed", caption, figure)]


def _history(run: FinishedRun) -> list[ReportFigure]:
    """Figure of return and design over the iterations."""
    space = run.problem.design
    count = run.last
    figure = style.blank(max(5.5, min(3.4 * count + 1, 15)), 1.2 + 1.7 * (1 + space.dim), quick=run.quick)
    judges = [place(g) for g in run.results["generations"]]
    return_plots.plot_history(figure, run.histories, run.chosen, space, judges)
    caption = (
        "Return (mean and one standard deviation over the evaluation runs) and design at every evaluation of the "
        "co-designs; the star marks the design that was deployed, dashed lines are the bounds of the design. "
        "Returns of different columns are measured on different models and do not compare."
    )
    return [ReportFigure("history", "Return and design", caption, figure)]


def _comparison(run: FinishedRun) -> list[ReportFigure]:
    """Figure of every controller beside LQR."""
    rows = run.results["comparison"]
    figure = style.blank(10, 0.8 + 2.0 * (run.last + 1), quick=run.quick)
    return_plots.plot_comparison(figure, rows)
    caption = (
        "Return beside LQR at the same design, paired on common random numbers, with 95 % intervals (linear between "
        "−1 and 1 %, logarithmic beyond): the learned policy should touch or pass the line at zero; the green strip "
        "counts as not worse."
    )
    return [ReportFigure("comparison", "Controllers beside LQR", caption, figure)]


def _policy_surface(run: FinishedRun) -> list[ReportFigure]:
    """Figure of the policy and LQR over two states."""
    if run.study.plant.nx != 2:
        return []
    policy = load_policy(run.folder.path / "policy.safetensors")
    lower, upper = run.problem.state_limits(policy.design).bounding_box()
    x = (np.linspace(lower[0], upper[0], SURFACE_GRID), np.linspace(lower[1], upper[1], SURFACE_GRID))
    states = np.stack(np.meshgrid(*x), axis=-1)
    controllers: dict[str, Controller] = {"learned": policy, "LQR": saturated_lqr(run.problem, policy.design)}
    surfaces = {
        name: controller(states.reshape(-1, 2)).reshape(SURFACE_GRID, SURFACE_GRID, -1)
        for name, controller in controllers.items()
    }
    inputs = run.study.plant.input_names
    names = run.study.plant.state_names
    figure = style.blank(11, 0.6 + 2.8 * len(inputs), quick=run.quick)
    plotting.plot_surfaces(
        figure, x, surfaces, outline=run.sets.at(policy.design), labels=(names[0], names[1]), inputs=inputs
    )
    caption = (
        f"The policy as it was last deployed, over X at {run.describe(policy.design)}, beside saturated LQR; inside "
        "X_fea (black outline) the two should differ little or for a reason, outside it nothing was trained."
    )
    return [ReportFigure("policy", "Policy surface", caption, figure)]


def _trajectories(run: FinishedRun) -> list[ReportFigure]:
    """Figures of states and inputs, on the model and on the real plant."""
    return [_trajectories_on(run, kind) for kind in ("model", "real")]


def _trajectories_on(run: FinishedRun, kind: str) -> ReportFigure:
    """Figure of states and inputs at the start and final design."""
    plant = run.study.plant
    stages = {g: run.folder.read_stage(f"comparison-{g}").arrays for g in (0, run.last)}
    single = kind == "real" and run.study.real.runs == 1
    window = _active_part(stages[0][f"{kind}_LQR_states"][1], run.problem.state_scale) if single else slice(0, None)
    columns = {}
    limits = []
    for g, arrays in stages.items():
        X, U = (each(run.designs[g]).bounding_box() for each in (run.problem.state_limits, run.problem.input_limits))
        limits.append((np.r_[X[0], U[0]], np.r_[X[1], U[1]]))
        columns[f"{generation_name(g)}: {run.describe(run.designs[g])}"] = {
            name: _signals(arrays, f"{kind}_{name}", window) for name in ("LQR", "learned")
        }
    length = max(bands.shape[1] for controllers in columns.values() for bands in controllers.values())
    labels = [*plant.state_names, *plant.input_names]
    figure = style.blank(11, 0.9 + 1.45 * len(labels), quick=run.quick)
    plotting.plot_trajectories(
        figure, columns, plant.dt * (np.arange(length) + window.start), labels=labels, limits=limits,
        time_label=run.time_label, title_colours=[style.generation_colour(g) for g in stages],
    )  # fmt: skip
    what = "the liveliest part of the one recorded run" if single else "mean and 95 % band of the runs"
    caption = (
        f"States and inputs under LQR (broad, pale) and the learned policy (thin), at the start design (left) and the "
        f"final one (right): {what}. Dashed lines are limits of X and U at that design where they are in sight."
    )
    if kind == "model":
        caption += " Left the nominal model from x0; right the model with logged errors replayed, if there was a log."
    title = "Trajectories on the model" if kind == "model" else "Trajectories on the real plant"
    return ReportFigure(f"trajectories_{kind}", title, caption, figure)


def _signals(arrays: dict[str, Array], name: str, window: slice) -> Array:
    """States and inputs of a controller, (3, T, nx + nu): low, mean, high."""
    states = arrays[f"{name}_states"]
    inputs = arrays[f"{name}_inputs"]
    return np.concatenate([states[:, : inputs.shape[1]], inputs], axis=2)[:, window]


def _active_part(states: Array, scale: Array) -> slice:
    """Liveliest part of a long run, by scaled states."""
    steps = len(states) - 1
    if steps <= SHOWN_STEPS:
        return slice(0, None)
    energy = np.r_[0.0, np.cumsum(((states / scale) ** 2).sum(axis=1))]
    starts = np.arange(0, steps - SHOWN_STEPS + 1, 10)
    start = int(starts[np.argmax(energy[starts + SHOWN_STEPS] - energy[starts])])
    return slice(start, start + SHOWN_STEPS)


def _quantiles(run: FinishedRun) -> list[ReportFigure]:
    """Figures of learned quantiles and errors after every deployment."""
    taught = [g["generation"] for g in run.results["generations"] if g["deployed_diverged"] < 1]
    return [_quantiles_of(run, generation) for generation in taught]


def _quantiles_of(run: FinishedRun, generation: int) -> ReportFigure:
    """Figure of one generation's learned quantiles and errors."""
    dt = run.study.plant.dt
    logged: dict[str, Any] = run.folder.read_stage(f"deployment-{generation}").arrays
    log = residuals(run.study.model, Trajectory(**logged, dt=dt))
    network = run.folder.read_stage(f"twin-{generation}").networks["quantiles"]
    total = log.x.shape[1]
    held_out = max(round(HELD_OUT * total / BLOCKS), 2)
    count = min(150, total if len(log.x) > 1 else held_out)  # errors that are drawn
    end = log.part(slice(-1, None), slice(total - count, None))
    quantiles = network.predict(np.hstack([end.e[0], end.x[0], end.u[0]]))
    names = run.study.plant.state_names
    figure = style.blank(10, 0.9 + 1.55 * len(names), quick=run.quick)
    plotting.plot_quantiles(
        figure, dt * np.arange(total - count, total), end.e_next[0], quantiles, network.levels, labels=names,
        time_label=run.time_label,
    )  # fmt: skip
    stated = run.results["generations"][generation - 1]["quantiles"]["nominal_coverage"]
    caption = (
        f"One-step errors of the nominal model at the end of deployment {generation}, which training had not seen, in "
        f"the learned quantiles: about {share(stated)} should lie inside the band, and the median should follow what "
        "can be predicted."
    )
    return ReportFigure(f"quantiles_{generation}", f"Learned quantiles, generation {generation}", caption, figure)
