"""The figures of a report, one function each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ccdtools.arrays import Array
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.learned import load_policy
from ccdtools.simulation import simulate
from ccdtools.studies.report import plotting
from ccdtools.studies.report.finished_run import FinishedRun
from ccdtools.studies.report.tables import measured_on, number, with_minus
from ccdtools.trajectory import Trajectory
from ccdtools.twin.residuals import residuals
from ccdtools.twin.twin import BLOCKS, HELD_OUT
from invariant_sets import Polytope

SHOWN_DESIGNS = 4
SURFACE_GRID = 121
SHOWN_STEPS = 200  # of a long trajectory
SHOWN_ERRORS = 150
LANDSCAPE = {1: 21, 2: 9}  # designs per axis, by the number of design parameters
LANDSCAPE_RUNS = 400
LANDSCAPE_DIVERGED = 0.01


@dataclass(frozen=True, eq=False)
class Picture:
    """A figure with its file name, title and the sentence that says what to see."""

    name: str
    title: str
    caption: str
    figure: Figure


def pictures(run: FinishedRun) -> Iterator[Picture]:
    """Every figure that the study can have."""
    makers: list[Callable[[FinishedRun], Iterator[Picture]]] = [
        _history, _landscape, _comparison, _feasible_sets, _policy_surface, _trajectories, _quantiles,
    ]  # fmt: skip
    for make in makers:
        yield from make(run)


def _history(run: FinishedRun) -> Iterator[Picture]:
    space, count = run.problem.design, run.last
    figure = plotting.blank(max(5.5, min(3.4 * count + 1, 15)), 1.2 + 1.7 * (1 + space.dim), quick=run.quick)
    judges = [measured_on(g) for g in run.results["generations"]]
    plotting.plot_history(figure, run.histories, run.chosen, space, judges)
    caption = (
        "Return (mean and one standard deviation over the evaluation runs) and design at every evaluation of the "
        "co-designs; the star is the iterate that was returned, dashed lines are the bounds of the design. "
        "Returns of different columns are measured on different models and do not compare."
    )
    yield Picture("history", "Return and design", caption, figure)


def _landscape(run: FinishedRun) -> Iterator[Picture]:
    space = run.problem.design
    if space.dim not in LANDSCAPE:
        return
    n = LANDSCAPE[space.dim]
    axes = [np.linspace(low, high, n) for low, high in zip(space.lower, space.upper)]
    grid = np.stack(np.meshgrid(*axes), axis=-1)  # (n, 1), or (y, x, 2)
    mean, interval, diverged = (np.reshape(v, grid.shape[:-1]) for v in _returns_over(run, grid.reshape(-1, space.dim)))
    fine = diverged <= LANDSCAPE_DIVERGED
    paths = [np.vstack([h.design[: k + 1], p]) for h, k, p in zip(run.histories, run.chosen, run.designs[1:])]
    labels = [name if unit == "-" else f"{name} [{unit}]" for name, unit in zip(space.names, space.units)]
    figure = plotting.blank(8, 4.6, quick=run.quick)
    ax = figure.add_subplot()
    if space.dim == 1:
        plotting.plot_landscape_curve(
            ax, axes[0], mean, interval, diverged, [path[:, 0] for path in paths], label=labels[0],
            allowed=LANDSCAPE_DIVERGED,
        )  # fmt: skip
    else:
        plotting.plot_landscape_map(ax, axes[0], axes[1], mean, fine, paths, labels=(labels[0], labels[1]))
    caption = (
        f"Mean return of saturated LQR on the nominal model over the design box ({mean.size} designs, "
        f"{LANDSCAPE_RUNS} runs each on common random numbers), computed apart from the co-design; the design should "
        "walk from its square to its star towards higher return."
    )
    if fine.any():
        top = np.unravel_index(np.where(fine, mean, -np.inf).argmax(), mean.shape)
        caption += f" Best of the grid: {run.describe(grid[top])}, {with_minus(number(float(mean[top])))}."
    if not fine.all():
        caption += f" Where more than {LANDSCAPE_DIVERGED:.0%} of the runs diverge the design is left grey or blank."
    yield Picture("landscape", "Landscape of the return", caption, figure)


def _returns_over(run: FinishedRun, designs: Array) -> tuple[list[float], list[float], list[float]]:
    rng = np.random.default_rng(np.random.SeedSequence(run.results["seed"], spawn_key=tuple(b"landscape")))
    x0, w = run.problem.scenarios.sample(LANDSCAPE_RUNS, run.study.steps, rng)
    mean, interval, diverged = [], [], []
    for design in designs:
        loop = simulate(
            run.study.model, run.lqr(design), x0=x0, steps=run.study.steps, disturbance=w, design=design,
            limit=run.problem.limit,
        )  # fmt: skip
        kept = loop.returns(run.study.objective)[~loop.diverged]
        mean.append(float(kept.mean()) if len(kept) else float("nan"))
        interval.append(1.96 * float(kept.std()) / np.sqrt(max(len(kept), 1)) if len(kept) else float("nan"))
        diverged.append(float(loop.diverged.mean()))
    return mean, interval, diverged


def _comparison(run: FinishedRun) -> Iterator[Picture]:
    rows = run.results["comparison"]
    figure = plotting.blank(10, 0.8 + 2.0 * (run.last + 1), quick=run.quick)
    plotting.plot_comparison(figure, rows)
    caption = (
        "Return beside LQR at the same design, paired on common random numbers, with 95 % intervals (linear between "
        "−1 and 1 %, logarithmic beyond): the learned policy should touch or pass the line at zero; the green strip "
        "counts as not worse."
    )
    yield Picture("comparison", "Controllers beside LQR", caption, figure)


def _feasible_sets(run: FinishedRun) -> Iterator[Picture]:
    nx, names = run.study.plant.nx, run.study.plant.state_names
    if nx < 2:
        return
    sets, missing = _shown_sets(run)
    if not sets:
        return
    caption = (
        "X_fea(p), from which some input keeps the state in X forever, at different designs: the larger, the better. "
    )
    if missing:
        caption += f"There is none to show at {'; '.join(missing)}. "
    if nx == 2:
        figure = plotting.blank(7, 5.2, quick=run.quick)
        plotting.plot_sets(figure.add_subplot(), sets, frame=run.study.X, labels=(names[0], names[1]), legend=True)
        yield Picture("feasible_sets", "Feasible sets", caption + "The dashed frame is X.", figure)
        return
    pairs = _telling_pairs(sets, nx)
    figure = plotting.blank(9, 8.2, quick=run.quick)
    grid = figure.subplots(2, len(pairs), squeeze=False)
    for c, pair in enumerate(pairs):
        frame, labels = run.study.X.projection(pair), (names[pair[0]], names[pair[1]])
        for r, (cut, title) in enumerate(((_projected, "projection"), (_sliced, "slice, other states 0"))):
            flat = {label: cut(S, pair) for label, S in sets.items()}
            plotting.plot_sets(grid[r, c], flat, frame=frame, labels=labels, legend=(r, c) == (0, 0))
            grid[r, c].set_title(title, fontsize=9)
    caption += (
        f"The sets have {nx} dimensions; shown are the state pairs on which the designs differ most: above the "
        "projections, below the slices through zero. The dashed frame is X."
    )
    yield Picture("feasible_sets", "Feasible sets", caption, figure)


def _shown_sets(run: FinishedRun) -> tuple[dict[str, Polytope], list[str]]:
    """X_fea of four different designs (start, last generation, corners, middle), and where there was none."""
    space = run.problem.design
    places = {"lower corner": 0.0, "upper corner": 1.0, "centre": 0.5, "between": 0.25}
    candidates = [("start", run.designs[0]), (f"generation {run.last}", run.designs[-1])]
    candidates += [(label, space.from_unit(np.full(space.dim, v))) for label, v in places.items()]
    seen: list[Array] = []
    sets: dict[str, Polytope] = {}
    missing: list[str] = []
    for label, design in candidates:
        v, title = space.to_unit(design), f"{label}: {run.describe(design)}"
        if len(sets) == SHOWN_DESIGNS or any(np.abs(v - other).max() <= 1e-2 for other in seen):
            continue
        seen.append(v)
        found = run.sets.result(design)
        if found.set.is_empty:
            missing.append(f"{title} ({found.status.name.lower().replace('_', ' ')})")
        else:
            sets[title] = found.set
    return sets, missing


def _telling_pairs(sets: dict[str, Polytope], nx: int) -> list[tuple[int, int]]:
    pairs = list(combinations(range(nx), 2)) if nx <= 4 else [(i, i + 1) for i in range(0, nx - 1, 2)]

    def spread(pair: tuple[int, int]) -> float:
        total = 0.0
        for cut in (_projected, _sliced):
            areas = [cut(S, pair).volume for S in sets.values()]
            total += (max(areas) - min(areas)) / max(max(areas), 1e-300)
        return total

    return sorted(sorted(pairs, key=spread)[-2:])


def _projected(S: Polytope, pair: tuple[int, int]) -> Polytope:
    return S.projection(pair)


def _sliced(S: Polytope, pair: tuple[int, int]) -> Polytope:
    others = [i for i in range(S.dim) if i not in pair]
    return S.slice(others, np.zeros(len(others)))


def _policy_surface(run: FinishedRun) -> Iterator[Picture]:
    if run.study.plant.nx != 2:
        return
    lower, upper = run.study.X.bounding_box()
    x = (np.linspace(lower[0], upper[0], SURFACE_GRID), np.linspace(lower[1], upper[1], SURFACE_GRID))
    states = np.stack(np.meshgrid(*x), axis=-1)
    policy = load_policy(run.folder.path / "policy.safetensors")
    controllers: dict[str, Controller] = {"learned": policy, "LQR": run.lqr(policy.design)}
    surfaces = {
        name: controller(states.reshape(-1, 2)).reshape(SURFACE_GRID, SURFACE_GRID, -1)
        for name, controller in controllers.items()
    }
    inputs, names = run.study.plant.input_names, run.study.plant.state_names
    figure = plotting.blank(11, 0.6 + 2.8 * len(inputs), quick=run.quick)
    plotting.plot_surfaces(
        figure, x, surfaces, outline=run.sets.at(policy.design), labels=(names[0], names[1]), inputs=inputs
    )
    caption = (
        f"The policy as it was last in service, over X at {run.describe(policy.design)}, beside saturated LQR; inside "
        "X_fea (black outline) the two should differ little or for a reason, outside it nothing was trained."
    )
    yield Picture("policy", "Policy surface", caption, figure)


def _trajectories(run: FinishedRun) -> Iterator[Picture]:
    plant, problem = run.study.plant, run.problem
    labels = [*plant.state_names, *plant.input_names]
    limits = tuple(np.r_[a, b] for a, b in zip(run.study.X.bounding_box(), run.study.U.bounding_box()))
    for kind, title in (("model", "Trajectories on the model"), ("real", "Trajectories on the real plant")):
        stages = {g: run.folder.read_stage(f"comparison-{g}").arrays for g in (0, run.last)}
        single = kind == "real" and run.study.real.runs == 1
        window = _liveliest(stages[0][f"{kind}_LQR_states"][1], problem.state_scale) if single else slice(0, None)
        columns = {}
        for g, arrays in stages.items():
            heading = "start" if g == 0 else f"generation {g}"
            columns[f"{heading}: {run.describe(run.designs[g])}"] = {
                name: _signals(arrays, f"{kind}_{name}", window) for name in ("LQR", "learned")
            }
        length = next(iter(next(iter(columns.values())).values())).shape[1]
        time = plant.dt * (np.arange(length) + window.start)
        figure = plotting.blank(11, 0.9 + 1.45 * len(labels), quick=run.quick)
        plotting.plot_trajectories(
            figure, columns, time, labels=labels, limits=(limits[0], limits[1]), time_label=run.time_label
        )
        what = "the liveliest stretch of the one recorded run" if single else "mean and 95 % band of the runs"
        caption = (
            f"States and inputs under LQR and the learned policy, at the start design (left) and the final one "
            f"(right): {what}. Dashed lines are limits of X and U where they are in sight."
        )
        if kind == "model":
            caption += (
                " Left the nominal model from x0; right the model with logged errors replayed, if there was a log."
            )
        yield Picture(f"trajectories_{kind}", title, caption, figure)


def _signals(arrays: dict[str, Array], name: str, window: slice) -> Array:
    states, inputs = arrays[f"{name}_states"], arrays[f"{name}_inputs"]
    return np.concatenate([states[:, : inputs.shape[1]], inputs], axis=2)[:, window]


def _liveliest(states: Array, scale: Array) -> slice:
    """The stretch of a long run in which the scaled state is largest in the mean square."""
    steps = len(states) - 1
    if steps <= SHOWN_STEPS:
        return slice(0, None)
    energy = np.r_[0.0, np.cumsum(((states / scale) ** 2).sum(axis=1))]
    starts = np.arange(0, steps - SHOWN_STEPS + 1, 10)
    start = int(starts[np.argmax(energy[starts + SHOWN_STEPS] - energy[starts])])
    return slice(start, start + SHOWN_STEPS)


def _quantiles(run: FinishedRun) -> Iterator[Picture]:
    names, dt = run.study.plant.state_names, run.study.plant.dt
    for g in range(1, run.last + 1):
        logged: dict[str, Any] = run.folder.read_stage(f"deployment-{g}").arrays
        log = residuals(run.study.model, Trajectory(**logged, dt=dt))
        network = run.folder.read_stage(f"twin-{g}").networks["quantiles"]
        total = log.x.shape[1]
        count = min(SHOWN_ERRORS, total if len(log.x) > 1 else max(round(HELD_OUT * total / BLOCKS), 2))
        stretch = log.part(slice(-1, None), slice(total - count, None))
        quantiles = network.predict(np.hstack([stretch.e[0], stretch.x[0], stretch.u[0]]))
        figure = plotting.blank(10, 0.9 + 1.55 * len(names), quick=run.quick)
        plotting.plot_quantiles(
            figure,
            dt * np.arange(total - count, total),
            stretch.e_next[0],
            quantiles,
            network.levels,
            labels=names,
            time_label=run.time_label,
        )
        promised = run.results["generations"][g - 1]["quantiles"]["nominal_coverage"]
        caption = (
            f"One-step errors of the nominal model at the end of deployment {g}, which training had not seen, in the "
            f"learned quantiles: about {promised:.0%} should lie inside the band, and the median should follow what "
            "can be predicted."
        )
        yield Picture(f"quantiles_{g}", f"Learned quantiles, generation {g}", caption, figure)
