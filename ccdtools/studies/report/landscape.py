"""Return of LQR over the box of designs."""

from __future__ import annotations

import numpy as np

from ccdtools import figure_style as style
from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.co_design.risk import Mean, measure
from ccdtools.evidence.percent import share, with_minus
from ccdtools.plants.design_space import DesignSpace
from ccdtools.simulation import simulate
from ccdtools.studies.report import return_plots
from ccdtools.studies.report.finished_run import FinishedRun
from ccdtools.studies.report.formatting import axis_label, number
from ccdtools.studies.report.report_figure import ReportFigure
from ccdtools.studies.tolerances import DIVERGED_RUNS, LANDSCAPE
from mpc import MPCError


def landscape(run: FinishedRun) -> list[ReportFigure]:
    """Return of LQR over one or two design parameters, with design paths."""
    space = run.problem.design
    lower, upper = space.outermost
    shown = np.flatnonzero(upper > lower).tolist()  # one whole number is no axis
    if len(shown) not in LANDSCAPE:
        return []
    visited = np.vstack([history.design for history in run.histories] + [run.designs])
    axes = [_axis(space, i, LANDSCAPE[len(shown)], visited[:, i]) for i in shown]
    over = np.stack(np.meshgrid(*axes), axis=-1)  # (n, 1), or (y, x, 2)
    held = space.settled(space.allowed.rounded(np.zeros(space.dim)))
    grid = np.broadcast_to(held, (*over.shape[:-1], space.dim)).copy()
    grid[..., shown] = over
    columns = _returns_over(run, grid.reshape(-1, space.dim))
    mean, interval, diverged = (np.reshape(v, grid.shape[:-1]) for v in columns)
    feasible = np.reshape(space.feasible(grid.reshape(-1, space.dim)), grid.shape[:-1])
    diverged = np.where(feasible, diverged, 1.0)
    fine = diverged <= DIVERGED_RUNS
    paths = [np.vstack([h.design[: k + 1], p])[:, shown] for h, k, p in zip(run.histories, run.chosen, run.designs[1:])]
    labels = [axis_label(space.names[i], space.units[i]) for i in shown]
    figure = style.blank(8, 4.6, quick=run.quick)
    ax = figure.add_subplot()
    if len(shown) == 1:
        return_plots.plot_landscape_curve(
            ax, axes[0], mean, interval, diverged, [path[:, 0] for path in paths], label=labels[0],
            allowed=DIVERGED_RUNS, whole=bool(space.whole[shown[0]]),
        )  # fmt: skip
    else:
        return_plots.plot_landscape_map(ax, axes[0], axes[1], mean, fine, paths, labels=(labels[0], labels[1]),
                                        whole=bool(space.whole[shown].any()))  # fmt: skip
    start = run.designs[0][shown]
    height = start[1] if len(shown) == 2 else np.interp(start[0], axes[0], mean)
    ax.plot(start[0], height, "D", color=style.generation_colour(0), mec="k", ms=9, label="start design", zorder=5)
    ax.legend(loc="best", markerscale=0.5)
    caption = (
        f"Mean return of saturated LQR on the nominal model over the design box ({mean.size} designs, "
        f"{_runs(run)} runs each on common random numbers), computed apart from the co-design; "
    )
    if isinstance(run.problem.risk, Mean):
        caption += "diamond: the start design; square: where a co-design began; star, above it: where it ended."
    else:
        caption += f"the co-design followed the {measure(run.problem.risk)}, whose best design may lie elsewhere."
    if space.whole[shown].any():
        caption += " Of whole numbers there is nothing between those shown."
    if fine.any():
        top = np.unravel_index(np.where(fine, mean, -np.inf).argmax(), mean.shape)
        caption += f" Best of the grid: {run.describe(grid[top])}, {with_minus(number(float(mean[top])))}."
    if not fine.all():
        broken = "" if feasible.all() else ", or a constraint is broken,"
        many = f"more than {share(DIVERGED_RUNS)} of the runs diverge"
        caption += f" Where {many}{broken} the design is left grey or blank."
    return [ReportFigure("landscape", "Landscape of the return", caption, figure)]


def _axis(space: DesignSpace, i: int, n: int, visited: Array) -> Array:
    """Grid of one parameter over its range; whole numbers with those visited."""
    lower, upper = space.outermost
    values = np.linspace(lower[i], upper[i], n)
    return np.unique(np.round(np.r_[values, visited])) if space.whole[i] else values


def _runs(run: FinishedRun) -> int:
    """Number of runs of every design."""
    return 100 if run.quick else 400  # of a nonlinear plant, 400 take longer than a generation


def _returns_over(run: FinishedRun, designs: Array) -> tuple[list[float], list[float], list[float]]:
    """Mean LQR returns, half-widths of 95 % intervals and diverged fractions."""
    rng = np.random.default_rng(np.random.SeedSequence(run.results["seed"], spawn_key=tuple(b"landscape")))
    x0, w = run.problem.scenarios.sample(_runs(run), run.study.steps, rng)
    columns = [_return_at(run, design, x0, w) for design in designs]
    mean, interval, diverged = (list(column) for column in zip(*columns))
    return mean, interval, diverged


def _return_at(run: FinishedRun, design: Array, x0: Array, w: Array) -> tuple[float, float, float]:
    """Values of `_returns_over` at one design; all diverged without LQR."""
    try:
        controller = saturated_lqr(run.problem, design)
    except MPCError:
        return float("nan"), float("nan"), 1.0
    loop = simulate(
        run.study.model, controller, x0=x0, steps=run.study.steps, disturbance=w, design=design,
        limit=run.problem.limit,
    )  # fmt: skip
    kept = loop.returns(run.study.objective)[~loop.diverged]
    mean = float(kept.mean()) if len(kept) else float("nan")
    interval = 1.96 * float(kept.std()) / np.sqrt(max(len(kept), 1)) if len(kept) else float("nan")
    return mean, interval, float(loop.diverged.mean())
