"""The figures of a report, one function each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.controllers.baselines import saturated_lqr
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.learned import load_policy
from ccdtools.simulation import simulate
from ccdtools.studies.report import plotting, return_plots, style
from ccdtools.studies.report.finished_run import FinishedRun
from ccdtools.studies.report.formatting import axis_label, generation_name, number, place, share, with_minus
from ccdtools.trajectory import Trajectory
from ccdtools.twin.residuals import residuals
from ccdtools.twin.twin import BLOCKS, HELD_OUT
from invariant_sets import Polytope
from mpc import MPCError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWN_DESIGNS = 4
SURFACE_GRID = 121
SHOWN_STEPS = 200  # of a long trajectory
SHOWN_ERRORS = 150
LANDSCAPE = {1: 21, 2: 9}  # designs per axis, by the number of design parameters
LANDSCAPE_RUNS = 400
LANDSCAPE_DIVERGED = 0.01


@dataclass(frozen=True, eq=False)
class ReportFigure:
    """A figure with its file name, title and the sentence that says what to see."""

    name: str
    title: str
    caption: str
    figure: Figure


def figures(run: FinishedRun) -> Iterator[ReportFigure]:
    """Every figure that the study can have."""
    makers: list[Callable[[FinishedRun], list[ReportFigure]]] = [
        _history, _landscape, _comparison, _feasible_sets, _policy_surface, _trajectories, _quantiles,
    ]  # fmt: skip
    for make in makers:
        with style.styled():
            made = make(run)
        yield from made


def _history(run: FinishedRun) -> list[ReportFigure]:
    """Return and design over the iterations of every co-design."""
    space, count = run.problem.design, run.last
    figure = style.blank(max(5.5, min(3.4 * count + 1, 15)), 1.2 + 1.7 * (1 + space.dim), quick=run.quick)
    judges = [place(g) for g in run.results["generations"]]
    return_plots.plot_history(figure, run.histories, run.chosen, space, judges)
    caption = (
        "Return (mean and one standard deviation over the evaluation runs) and design at every evaluation of the "
        "co-designs; the star is the iterate that was returned, dashed lines are the bounds of the design. "
        "Returns of different columns are measured on different models and do not compare."
    )
    return [ReportFigure("history", "Return and design", caption, figure)]


def _landscape(run: FinishedRun) -> list[ReportFigure]:
    """Return of LQR over one or two design parameters, with the paths of the design."""
    space = run.problem.design
    if space.dim not in LANDSCAPE:
        return []
    n = LANDSCAPE[space.dim]
    axes = [np.linspace(low, high, n) for low, high in zip(space.lower, space.upper)]
    grid = np.stack(np.meshgrid(*axes), axis=-1)  # (n, 1), or (y, x, 2)
    mean, interval, diverged = (np.reshape(v, grid.shape[:-1]) for v in _returns_over(run, grid.reshape(-1, space.dim)))
    fine = diverged <= LANDSCAPE_DIVERGED
    paths = [np.vstack([h.design[: k + 1], p]) for h, k, p in zip(run.histories, run.chosen, run.designs[1:])]
    labels = [axis_label(name, unit) for name, unit in zip(space.names, space.units)]
    figure = style.blank(8, 4.6, quick=run.quick)
    ax = figure.add_subplot()
    if space.dim == 1:
        return_plots.plot_landscape_curve(
            ax, axes[0], mean, interval, diverged, [path[:, 0] for path in paths], label=labels[0],
            allowed=LANDSCAPE_DIVERGED,
        )  # fmt: skip
    else:
        return_plots.plot_landscape_map(ax, axes[0], axes[1], mean, fine, paths, labels=(labels[0], labels[1]))
    caption = (
        f"Mean return of saturated LQR on the nominal model over the design box ({mean.size} designs, "
        f"{LANDSCAPE_RUNS} runs each on common random numbers), computed apart from the co-design; the design should "
        "walk from its square to its star towards higher return."
    )
    if fine.any():
        top = np.unravel_index(np.where(fine, mean, -np.inf).argmax(), mean.shape)
        caption += f" Best of the grid: {run.describe(grid[top])}, {with_minus(number(float(mean[top])))}."
    if not fine.all():
        caption += f" Where more than {share(LANDSCAPE_DIVERGED)} of the runs diverge the design is left grey or blank."
    return [ReportFigure("landscape", "Landscape of the return", caption, figure)]


def _returns_over(run: FinishedRun, designs: Array) -> tuple[list[float], list[float], list[float]]:
    """Mean return of LQR, half-width of its 95 % interval, and fraction of diverged runs, of every design."""
    rng = np.random.default_rng(np.random.SeedSequence(run.results["seed"], spawn_key=tuple(b"landscape")))
    x0, w = run.problem.scenarios.sample(LANDSCAPE_RUNS, run.study.steps, rng)
    columns = [_return_at(run, design, x0, w) for design in designs]
    mean, interval, diverged = (list(column) for column in zip(*columns))
    return mean, interval, diverged


def _return_at(run: FinishedRun, design: Array, x0: Array, w: Array) -> tuple[float, float, float]:
    """The values of `_returns_over` at one design; where LQR does not exist, every run counts as diverged."""
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


def _comparison(run: FinishedRun) -> list[ReportFigure]:
    """Every controller beside LQR."""
    rows = run.results["comparison"]
    figure = style.blank(10, 0.8 + 2.0 * (run.last + 1), quick=run.quick)
    return_plots.plot_comparison(figure, rows)
    caption = (
        "Return beside LQR at the same design, paired on common random numbers, with 95 % intervals (linear between "
        "−1 and 1 %, logarithmic beyond): the learned policy should touch or pass the line at zero; the green strip "
        "counts as not worse."
    )
    return [ReportFigure("comparison", "Controllers beside LQR", caption, figure)]


def _feasible_sets(run: FinishedRun) -> list[ReportFigure]:
    """X_fea at different designs."""
    nx = run.study.plant.nx
    if nx < 2:
        return []
    shown = _shown_sets(run)
    if not shown.sets:
        return []
    caption = (
        "X_fea(p), the largest set of states from which the limits can be kept for ever, at different designs; "
        "shaded: the final design. "
    )
    if shown.missing:
        caption += f"There is none to show at {'; '.join(shown.missing)}. "
    pairs = [(0, 1)] if nx == 2 else _telling_pairs(shown.sets, nx)
    cuts = [(_projected, "")] if nx == 2 else [(_projected, "projection"), (_sliced, "slice, other states 0")]
    figure = style.blank(7, 5.2, quick=run.quick) if nx == 2 else style.blank(9, 8.2, quick=run.quick)
    grid = figure.subplots(len(cuts), len(pairs), squeeze=False)
    names = run.study.plant.state_names
    for c, pair in enumerate(pairs):
        frame = run.study.X if nx == 2 else run.study.X.projection(pair)
        for r, (cut, title) in enumerate(cuts):
            flat = {label: cut(S, pair) for label, S in shown.sets.items()}
            artists = plotting.plot_sets(
                grid[r, c], flat, shown.lines, frame=frame, labels=(names[pair[0]], names[pair[1]]), filled=shown.final
            )
            grid[r, c].set_title(title)
            if (r, c) == (0, 0):
                figure.legend(handles=artists, loc="outside lower center", ncols=2, frameon=False)
    if nx > 2:
        caption += (
            f"The sets have {nx} dimensions; shown are the state pairs on which the designs differ most: above the "
            "projections, below the slices through zero. "
        )
    return [ReportFigure("feasible_sets", "Feasible sets", caption + "The dashed frame is X.", figure)]


@dataclass(frozen=True, eq=False)
class _ShownSets:
    """Sets by label with their (colour, line style), the label of the final design, and designs without a set."""

    sets: dict[str, Polytope]
    lines: dict[str, tuple[str, Any]]
    final: str
    missing: list[str]


def _shown_sets(run: FinishedRun) -> _ShownSets:
    """X_fea of four different designs: the start, the last generation, corners, middle."""
    space = run.problem.design
    places = {"lower corner": 0.0, "upper corner": 1.0, "centre": 0.5, "between": 0.25}
    candidates = [(generation_name(run.last), run.designs[-1]), (generation_name(0), run.designs[0])]
    candidates += [(label, space.from_unit(np.full(space.dim, v))) for label, v in places.items()]
    lines = {generation_name(g): (style.generation_colour(g), "-") for g in (0, run.last)}
    lines |= dict(zip(places, style.OTHER_DESIGNS))
    seen: list[Array] = []
    shown = _ShownSets({}, {}, f"{generation_name(run.last)}: {run.describe(run.designs[-1])}", [])
    for label, design in candidates:
        unit, title = space.to_unit(design), f"{label}: {run.describe(design)}"
        if len(shown.sets) == SHOWN_DESIGNS or any(np.abs(unit - other).max() <= 1e-2 for other in seen):
            continue
        seen.append(unit)
        result = run.sets.result(design)
        if result.set.is_empty:
            shown.missing.append(f"{title} ({result.status.name.lower().replace('_', ' ')})")
        else:
            shown.sets[title] = result.set
            shown.lines[title] = lines[label]
    return shown


def _telling_pairs(sets: dict[str, Polytope], nx: int) -> list[tuple[int, int]]:
    """The two pairs of states on which the areas of the sets differ most."""
    pairs = list(combinations(range(nx), 2)) if nx <= 4 else [(i, i + 1) for i in range(0, nx - 1, 2)]

    def spread(pair: tuple[int, int]) -> float:
        total = 0.0
        for cut in (_projected, _sliced):
            areas = [cut(S, pair).volume for S in sets.values()]
            total += (max(areas) - min(areas)) / max(max(areas), 1e-300)
        return total

    return sorted(sorted(pairs, key=spread)[-2:])


def _projected(S: Polytope, pair: tuple[int, int]) -> Polytope:
    """The projection on two states."""
    return S if S.dim == 2 else S.projection(pair)


def _sliced(S: Polytope, pair: tuple[int, int]) -> Polytope:
    """The slice in two states with the others zero."""
    others = [i for i in range(S.dim) if i not in pair]
    return S.slice(others, np.zeros(len(others)))


def _policy_surface(run: FinishedRun) -> list[ReportFigure]:
    """The policy and LQR over two states."""
    if run.study.plant.nx != 2:
        return []
    lower, upper = run.study.X.bounding_box()
    x = (np.linspace(lower[0], upper[0], SURFACE_GRID), np.linspace(lower[1], upper[1], SURFACE_GRID))
    states = np.stack(np.meshgrid(*x), axis=-1)
    policy = load_policy(run.folder.path / "policy.safetensors")
    controllers: dict[str, Controller] = {"learned": policy, "LQR": saturated_lqr(run.problem, policy.design)}
    surfaces = {
        name: controller(states.reshape(-1, 2)).reshape(SURFACE_GRID, SURFACE_GRID, -1)
        for name, controller in controllers.items()
    }
    inputs, names = run.study.plant.input_names, run.study.plant.state_names
    figure = style.blank(11, 0.6 + 2.8 * len(inputs), quick=run.quick)
    plotting.plot_surfaces(
        figure, x, surfaces, outline=run.sets.at(policy.design), labels=(names[0], names[1]), inputs=inputs
    )
    caption = (
        f"The policy as it was last in service, over X at {run.describe(policy.design)}, beside saturated LQR; inside "
        "X_fea (black outline) the two should differ little or for a reason, outside it nothing was trained."
    )
    return [ReportFigure("policy", "Policy surface", caption, figure)]


def _trajectories(run: FinishedRun) -> list[ReportFigure]:
    """States and inputs under LQR and the learned policy, on the model and on the real plant."""
    return [_trajectories_on(run, kind) for kind in ("model", "real")]


def _trajectories_on(run: FinishedRun, kind: str) -> ReportFigure:
    """States and inputs at the start design and at the final one, on the model or on the real plant."""
    plant = run.study.plant
    limits = tuple(np.r_[a, b] for a, b in zip(run.study.X.bounding_box(), run.study.U.bounding_box()))
    stages = {g: run.folder.read_stage(f"comparison-{g}").arrays for g in (0, run.last)}
    single = kind == "real" and run.study.real.runs == 1
    window = _liveliest(stages[0][f"{kind}_LQR_states"][1], run.problem.state_scale) if single else slice(0, None)
    columns = {}
    for g, arrays in stages.items():
        columns[f"{generation_name(g)}: {run.describe(run.designs[g])}"] = {
            name: _signals(arrays, f"{kind}_{name}", window) for name in ("LQR", "learned")
        }
    length = next(iter(next(iter(columns.values())).values())).shape[1]
    labels = [*plant.state_names, *plant.input_names]
    figure = style.blank(11, 0.9 + 1.45 * len(labels), quick=run.quick)
    plotting.plot_trajectories(
        figure, columns, plant.dt * (np.arange(length) + window.start), labels=labels, limits=(limits[0], limits[1]),
        time_label=run.time_label, title_colours=[style.generation_colour(g) for g in stages],
    )  # fmt: skip
    what = "the liveliest part of the one recorded run" if single else "mean and 95 % band of the runs"
    caption = (
        f"States and inputs under LQR (broad, pale) and the learned policy (thin), at the start design (left) and the "
        f"final one (right): {what}. Dashed lines are limits of X and U where they are in sight."
    )
    if kind == "model":
        caption += " Left the nominal model from x0; right the model with logged errors replayed, if there was a log."
    title = "Trajectories on the model" if kind == "model" else "Trajectories on the real plant"
    return ReportFigure(f"trajectories_{kind}", title, caption, figure)


def _signals(arrays: dict[str, Array], name: str, window: slice) -> Array:
    """States and inputs of a controller side by side: low, mean and high, (3, T, nx + nu)."""
    states, inputs = arrays[f"{name}_states"], arrays[f"{name}_inputs"]
    return np.concatenate([states[:, : inputs.shape[1]], inputs], axis=2)[:, window]


def _liveliest(states: Array, scale: Array) -> slice:
    """The part of a long run in which the scaled state is largest in the mean square."""
    steps = len(states) - 1
    if steps <= SHOWN_STEPS:
        return slice(0, None)
    energy = np.r_[0.0, np.cumsum(((states / scale) ** 2).sum(axis=1))]
    starts = np.arange(0, steps - SHOWN_STEPS + 1, 10)
    start = int(starts[np.argmax(energy[starts + SHOWN_STEPS] - energy[starts])])
    return slice(start, start + SHOWN_STEPS)


def _quantiles(run: FinishedRun) -> list[ReportFigure]:
    """The learned quantiles with the errors at the end of every deployment."""
    return [_quantiles_of(run, g) for g in range(1, run.last + 1)]


def _quantiles_of(run: FinishedRun, generation: int) -> ReportFigure:
    """The learned quantiles of one generation with the errors at the end of its deployment."""
    dt = run.study.plant.dt
    logged: dict[str, Any] = run.folder.read_stage(f"deployment-{generation}").arrays
    log = residuals(run.study.model, Trajectory(**logged, dt=dt))
    network = run.folder.read_stage(f"twin-{generation}").networks["quantiles"]
    total = log.x.shape[1]
    count = min(SHOWN_ERRORS, total if len(log.x) > 1 else max(round(HELD_OUT * total / BLOCKS), 2))
    end = log.part(slice(-1, None), slice(total - count, None))
    quantiles = network.predict(np.hstack([end.e[0], end.x[0], end.u[0]]))
    names = run.study.plant.state_names
    figure = style.blank(10, 0.9 + 1.55 * len(names), quick=run.quick)
    plotting.plot_quantiles(
        figure, dt * np.arange(total - count, total), end.e_next[0], quantiles, network.levels, labels=names,
        time_label=run.time_label,
    )  # fmt: skip
    promised = run.results["generations"][generation - 1]["quantiles"]["nominal_coverage"]
    caption = (
        f"One-step errors of the nominal model at the end of deployment {generation}, which training had not seen, in "
        f"the learned quantiles: about {share(promised)} should lie inside the band, and the median should follow what "
        "can be predicted."
    )
    return ReportFigure(f"quantiles_{generation}", f"Learned quantiles, generation {generation}", caption, figure)
