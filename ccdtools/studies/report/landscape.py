"""Return of LQR over the box of designs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ccdtools import figure_style as style
from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.co_design.risk import Mean, measure
from ccdtools.evidence.percent import number, share, with_minus
from ccdtools.plants.design_space import DesignSpace
from ccdtools.scenario import Scenario
from ccdtools.studies.report.finished_run import FinishedRun, ReportFigure
from ccdtools.studies.tolerances import DIVERGED_RUNS
from mpc import MPCError


def landscape(run: FinishedRun) -> list[ReportFigure]:
    """Return of LQR over one or two design parameters, with design paths."""
    space = run.problem.design
    lower, upper = space.outermost
    shown = np.flatnonzero(upper > lower).tolist()  # one whole number is no axis
    if len(shown) not in (1, 2):
        return []
    per_axis = 21 if len(shown) == 1 else 9  # designs
    visited = np.vstack([history.design for history in run.histories] + [run.designs])
    axes = [_axis(space, i, per_axis, visited[:, i]) for i in shown]
    over = np.stack(np.meshgrid(*axes), axis=-1)  # (n, 1), or (y, x, 2)
    held = space.settled(space.allowed.rounded(np.zeros(space.dim)))
    grid = np.broadcast_to(held, (*over.shape[:-1], space.dim)).copy()
    grid[..., shown] = over
    designs = grid.reshape(-1, space.dim)
    runs = 100 if run.quick else 400  # of a nonlinear plant, 400 take longer than a generation
    mean, interval, diverged = (np.reshape(v, grid.shape[:-1]) for v in _returns_over(run, designs, runs).T)
    feasible = np.reshape(space.feasible(designs), grid.shape[:-1])
    fine = feasible & (diverged <= DIVERGED_RUNS)
    whole = bool(space.whole[shown].any())
    figure = style.blank(8, 4.6, quick=run.quick)
    ax = figure.add_subplot()
    ax.set_xlabel(space.labels[shown[0]])
    if len(shown) == 1:
        draw_curve(ax, axes[0], mean, interval, fine, whole=whole)
        ax.set_ylabel("return, nominal model")
    else:
        style.draw_map(ax, axes[0], axes[1], mean, fine, label="return of LQR, nominal model", whole=whole)
        ax.set_ylabel(space.labels[shown[1]])
    ways = [np.vstack([h.design[: k + 1], p]) for h, k, p in zip(run.histories, run.chosen, run.designs[1:])]
    *paths, start = (
        (way[:, shown[0]], way[:, shown[1]] if len(shown) == 2 else np.interp(way[:, shown[0]], axes[0], mean))
        for way in (*ways, run.designs[0][None])
    )
    for g, path in enumerate(paths):
        draw_path(ax, *path, g, line="none" if len(shown) == 1 else "-")
    ax.plot(*start, "D", color=style.generation_colour(0), mec="k", ms=9, label="start design", zorder=5)
    ax.legend(loc="best", markerscale=0.5)
    caption = (
        f"Mean return of saturated LQR on the nominal model over the design box ({mean.size} designs, "
        f"{runs} runs each on common random numbers), computed apart from the co-design; "
    )
    if isinstance(run.problem.risk, Mean):
        caption += "diamond: the start design; square: where a co-design began; star, above it: where it ended."
    else:
        caption += f"the co-design followed the {measure(run.problem.risk)}, whose best design may lie elsewhere."
    if whole:
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


def _returns_over(run: FinishedRun, designs: Array, runs: int) -> Array:
    """Mean LQR return, half-width of its 95 % interval and diverged fraction of designs, (n, 3)."""
    rng = np.random.default_rng(np.random.SeedSequence(run.results["seed"], spawn_key=tuple(b"landscape")))
    x0, w = run.problem.scenarios.sample(runs, run.study.steps, rng)
    scenario = Scenario(run.study.model, x0, w)
    return np.array([_return_at(run, design, scenario) for design in designs])


def _return_at(run: FinishedRun, design: Array, scenario: Scenario) -> tuple[float, float, float]:
    """Values of `_returns_over` at one design; all diverged without LQR."""
    try:
        controller = saturated_lqr(run.problem, design)
    except MPCError:
        return np.nan, np.nan, 1.0
    loop = scenario.run(controller, design=design, limit=run.problem.limit)
    kept = loop.returns(run.study.objective)[~loop.diverged]
    if not len(kept):
        return np.nan, np.nan, 1.0
    return float(kept.mean()), 1.96 * float(kept.std()) / np.sqrt(len(kept)), float(loop.diverged.mean())


def draw_curve(
    ax: style.Axes, designs: Array, mean: Array, interval: Array, fine: NDArray[np.bool_], *, whole: bool
) -> None:
    """Draw LQR's return over one design parameter; whole numbers with nothing between them.

    Designs that are not fine, because too many runs diverge, are shaded and do not set the scale.
    """
    colour = style.COLOURS["LQR"]
    name = "LQR at this design"
    if whole:
        ax.errorbar(designs, mean, yerr=interval, fmt="_", color=colour, ms=14, mew=2, capsize=3, label=name)
        style.whole_ticks(ax)
    else:
        ax.fill_between(designs, mean - interval, mean + interval, color=colour, alpha=0.2, lw=0)
        ax.plot(designs, mean, color=colour, label=name)
    edges = np.r_[designs[0], (designs[1:] + designs[:-1]) / 2, designs[-1]]
    for i in np.flatnonzero(~fine):
        ax.axvspan(edges[i], edges[i + 1], color="#DDDDDD", lw=0, zorder=0)
    if fine.any():
        spread = np.ptp(mean[fine])
        ax.set_ylim(mean[fine].min() - 0.1 * spread - 1e-9, mean[fine].max() + 0.15 * spread + 1e-9)
    for edge in designs[[0, -1]]:
        ax.axvline(edge, **style.BOUND)


def draw_path(ax: style.Axes, x: Array, y: Array, g: int, *, line: str) -> None:
    """Draw the design's path through one generation: square, dots, star."""
    colour = style.generation_colour(g + 1)
    ax.plot(x, y, ls=line, marker="o", color=colour, ms=4, lw=1.5, label=f"path of generation {g + 1}", zorder=4)
    ax.plot(x[0], y[0], "s", color=style.generation_colour(g), mec="k", ms=8, zorder=5)
    ax.plot(x[-1], y[-1], "*", color=colour, mec="k", ms=15, zorder=6)
