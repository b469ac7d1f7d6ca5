"""X_fea at different designs."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import Any

import numpy as np

from ccdtools import figure_style as style
from ccdtools.arrays import Array
from ccdtools.design_limits import DesignLimits
from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import DesignSpace
from ccdtools.studies.budgets import SET_SECONDS
from ccdtools.studies.report.finished_run import FinishedRun, ReportFigure
from ccdtools.studies.report.formatting import generation_name
from invariant_sets import Polytope, SetResult, plot_polytope
from invariant_sets.results import Status

_Cut = tuple[Callable[[Polytope, tuple[int, int]], Polytope], str]  # the planar set of a pair of states, its title
_Line = tuple[str, Any]  # colour and style
NEAR = "near the "  # begins the label of the nearest design to one that cannot be built


def feasible_set_figure(run: FinishedRun) -> list[ReportFigure]:
    """Figure of X_fea at different designs."""
    nx = run.study.plant.nx
    if nx < 2 or run.results["configuration"]["sets"] != "auto":
        return []
    results = _results(run)
    sets = {title: result.set for title, (result, _) in results.items() if not result.set.is_empty}
    if not sets:
        return []
    local = not run.study.plant.linear
    caption = _caption({title: result for title, (result, _) in results.items()}, local)
    pairs = [(0, 1)] if nx == 2 else _most_different_pairs(sets, nx)
    cuts = _cuts(nx)
    figure = style.blank(7, 5.2, quick=run.quick) if nx == 2 else style.blank(9, 4.1 * len(cuts), quick=run.quick)
    grid = figure.subplots(len(cuts), len(pairs), squeeze=False)
    names = run.study.plant.state_names
    X = run.problem.state_limits(run.designs[-1])
    lines = {title: line for title, (_, line) in results.items()}
    final = _title(run, generation_name(run.last), run.designs[-1])
    for c, pair in enumerate(pairs):
        frame = X if nx == 2 else X.projection(pair)
        for r, (cut, title) in enumerate(cuts):
            flat = {label: cut(S, pair) for label, S in sets.items()}
            artists = _draw_sets(grid[r, c], flat, lines, frame, filled=final)
            grid[r, c].set(xlabel=names[pair[0]], ylabel=names[pair[1]], title=title)
            if (r, c) == (0, 0):
                figure.legend(handles=artists, loc="outside lower center", ncols=2, frameon=False)
    heading = "Feasible sets of the linearisation" if local else "Feasible sets"
    if nx > 2:
        drawn = "above the projections, below the slices through zero" if len(cuts) > 1 else "slices through zero"
        caption += f"The sets have {nx} dimensions; shown are the pairs of states on which they differ most: {drawn}. "
    of_final = " of the final design" if isinstance(run.study.X, DesignLimits) else ""
    return [ReportFigure("feasible_sets", heading, caption + f"The dashed frame is X{of_final}.", figure)]


def _caption(results: dict[str, SetResult], local: bool) -> str:
    """What the sets by title are, which of them are not the largest, and which are missing."""
    caption = (
        "X_fea(p), the largest set of states from which the limits can be kept for ever, at different designs; "
        "shaded: the final design. "
    )
    if local:
        caption += "They are those of the linearisation at rest, which the plant itself may leave. "
    if any(title.startswith(NEAR) for title in results):
        caption += "Where a design of the box cannot be built, the nearest that can stands for it. "
    shown = {title: result for title, result in results.items() if not result.set.is_empty}
    inner = [title for title, result in shown.items() if result.status is not Status.CONVERGED]
    if inner:
        caption += (
            f"Not the largest, but a part of it that the limits can be kept in, as far as {SET_SECONDS:g} s went: "
            f"{'; '.join(inner)}. "
        )
    missing = [title for title in results if title not in shown]
    if missing:
        why = [f"{title} ({results[title].status.name.lower().replace('_', ' ')})" for title in missing]
        caption += f"There is none to show at {'; '.join(why)}. "
    return caption


def _results(run: FinishedRun) -> dict[str, tuple[SetResult, _Line]]:
    """Sets X_fea by title with their lines, of designs until four have one."""
    space = run.problem.design
    ends = (run.last, 0)
    candidates = [(generation_name(g), run.designs[g], (style.generation_colour(g), "-")) for g in ends]
    places = {"lower corner": 0.0, "upper corner": 1.0, "centre": 0.5, "between": 0.25}
    for (place, v), line in zip(places.items(), style.OTHER_DESIGNS):
        design = space.from_unit(np.full(space.dim, v))
        if space.feasible(design):
            candidates.append((place, design, line))
        elif (nearest := _nearest(space, design)) is not None:
            candidates.append((f"{NEAR}{place}", nearest, line))
    seen: list[Array] = []
    found: dict[str, tuple[SetResult, _Line]] = {}
    for label, design, line in candidates:
        unit = space.to_unit(design)
        several = sum(not result.set.is_empty for result, _ in found.values())
        if several < 4 and all(np.abs(unit - other).max() > 1e-2 for other in seen):
            seen.append(unit)
            found[_title(run, label, design)] = (run.sets.result(design), line)
    return found


def _title(run: FinishedRun, label: str, design: Array) -> str:
    return f"{label}: {run.describe(design)}"


def _nearest(space: DesignSpace, design: Array) -> Array | None:
    try:
        return space.project(design)
    except InputError:
        return None


def _draw_sets(
    ax: style.Axes, sets: dict[str, Polytope], lines: dict[str, _Line], frame: Polytope, *, filled: str
) -> list[Any]:
    """Draw planar sets by name over their frame X (dashed), one of them shaded."""
    bound = {"facecolor": "none", "edgecolor": style.BOUND["color"], "linestyle": style.BOUND["ls"]}
    artists = [plot_polytope(frame, ax=ax, **bound, label="X", zorder=4)]
    for name, shown in sets.items():
        if not shown.is_empty:  # a slice can miss its set
            colour, dashes = lines[name]
            face = f"{colour}22" if name == filled else "none"
            artists.append(
                plot_polytope(shown, ax=ax, facecolor=face, edgecolor=colour, linestyle=dashes, lw=1.8, label=name)
            )
    lower, upper = frame.bounding_box()
    room = 0.06 * (upper - lower)
    ax.set(xlim=(lower[0] - room[0], upper[0] + room[0]), ylim=(lower[1] - room[1], upper[1] + room[1]))
    return artists


def _most_different_pairs(sets: dict[str, Polytope], nx: int) -> list[tuple[int, int]]:
    pairs = list(combinations(range(nx), 2)) if nx <= 4 else [(i, i + 1) for i in range(0, nx - 1, 2)]

    def spread(pair: tuple[int, int]) -> float:
        total = 0.0
        for cut, _ in _cuts(nx):
            areas = [cut(S, pair).volume for S in sets.values()]
            total += (max(areas) - min(areas)) / max(max(areas), 1e-300)
        return total

    return sorted(sorted(pairs, key=spread)[-2:])


def _cuts(nx: int) -> list[_Cut]:
    """Cuts drawn of sets of `nx` states; no projections beyond four."""
    projected: _Cut = (lambda S, pair: S if S.dim == 2 else S.projection(pair), "" if nx == 2 else "projection")
    sliced: _Cut = (_sliced, "slice, other states 0")
    if nx == 2:
        return [projected]
    return [projected, sliced] if nx <= 4 else [sliced]  # projections take hours beyond four


def _sliced(S: Polytope, pair: tuple[int, int]) -> Polytope:
    """Slice of a set in two states, the others zero."""
    others = [i for i in range(S.dim) if i not in pair]
    return S.slice(others, np.zeros(len(others)))
