"""X_fea at different designs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from ccdtools import figure_style as style
from ccdtools.arrays import Array
from ccdtools.design_limits import DesignLimits
from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import DesignSpace
from ccdtools.studies.report import plotting
from ccdtools.studies.report.finished_run import SET_SECONDS, FinishedRun
from ccdtools.studies.report.formatting import generation_name
from ccdtools.studies.report.report_figure import ReportFigure
from invariant_sets import Polytope
from invariant_sets.results import Status

_Cut = tuple[Callable[[Polytope, tuple[int, int]], Polytope], str]  # the planar set of a pair of states, its title
NEAR = "near the "  # begins the label of the nearest design to one that cannot be built


def feasible_set_figure(run: FinishedRun) -> list[ReportFigure]:
    """Figure of X_fea at different designs."""
    nx = run.study.plant.nx
    if nx < 2 or run.results["configuration"]["sets"] != "auto":
        return []
    shown = _shown_sets(run)
    if not shown.sets:
        return []
    caption = (
        "X_fea(p), the largest set of states from which the limits can be kept for ever, at different designs; "
        "shaded: the final design. "
    )
    local = not run.study.plant.linear
    if local:
        caption += "They are those of the linearisation at rest, which the plant itself may leave. "
    if any(label.startswith(NEAR) for label in (*shown.sets, *shown.missing)):
        caption += "Where a design of the box cannot be built, the nearest that can stands for it. "
    if shown.inner:
        caption += (
            f"Not the largest, but a part of it that the limits can be kept in, as far as {SET_SECONDS:g} s went: "
            f"{'; '.join(shown.inner)}. "
        )
    if shown.missing:
        caption += f"There is none to show at {'; '.join(shown.missing)}. "
    pairs = [(0, 1)] if nx == 2 else _most_different_pairs(shown.sets, nx)
    cuts = _cuts(nx)
    figure = style.blank(7, 5.2, quick=run.quick) if nx == 2 else style.blank(9, 4.1 * len(cuts), quick=run.quick)
    grid = figure.subplots(len(cuts), len(pairs), squeeze=False)
    names = run.study.plant.state_names
    X = run.problem.state_limits(run.designs[-1])
    for c, pair in enumerate(pairs):
        frame = X if nx == 2 else X.projection(pair)
        for r, (cut, title) in enumerate(cuts):
            flat = {label: cut(S, pair) for label, S in shown.sets.items()}
            artists = plotting.plot_sets(
                grid[r, c], flat, shown.lines, frame=frame, labels=(names[pair[0]], names[pair[1]]), filled=shown.final
            )
            grid[r, c].set_title(title)
            if (r, c) == (0, 0):
                figure.legend(handles=artists, loc="outside lower center", ncols=2, frameon=False)
    heading = "Feasible sets of the linearisation" if local else "Feasible sets"
    if nx > 2:
        drawn = "above the projections, below the slices through zero" if len(cuts) > 1 else "slices through zero"
        caption += f"The sets have {nx} dimensions; shown are the pairs of states on which they differ most: {drawn}. "
    of_final = " of the final design" if isinstance(run.study.X, DesignLimits) else ""
    return [ReportFigure("feasible_sets", heading, caption + f"The dashed frame is X{of_final}.", figure)]


@dataclass(frozen=True, eq=False)
class _ShownSets:
    """Sets by label with their (colour, line style).

    `final` is the label of the final design; `missing` have no set, `inner` one that is not the largest.
    """

    sets: dict[str, Polytope]
    lines: dict[str, tuple[str, Any]]
    final: str
    missing: list[str]
    inner: list[str]


def _shown_sets(run: FinishedRun) -> _ShownSets:
    """Sets X_fea of up to four designs."""
    space = run.problem.design
    places = {"lower corner": 0.0, "upper corner": 1.0, "centre": 0.5, "between": 0.25}
    candidates = [(generation_name(run.last), run.designs[-1]), (generation_name(0), run.designs[0])]
    for place, v in places.items():
        design = space.from_unit(np.full(space.dim, v))
        if space.feasible(design):
            candidates.append((place, design))
        elif (nearest := _nearest(space, design)) is not None:
            candidates.append((f"{NEAR}{place}", nearest))
    lines = {generation_name(g): (style.generation_colour(g), "-") for g in (0, run.last)}
    lines |= dict(zip(places, style.OTHER_DESIGNS))
    seen: list[Array] = []
    shown = _ShownSets({}, {}, f"{generation_name(run.last)}: {run.describe(run.designs[-1])}", [], [])
    for label, design in candidates:
        unit = space.to_unit(design)
        title = f"{label}: {run.describe(design)}"
        if len(shown.sets) == 4 or any(np.abs(unit - other).max() <= 1e-2 for other in seen):
            continue
        seen.append(unit)
        result = run.sets.result(design)
        if result.set.is_empty:
            shown.missing.append(f"{title} ({result.status.name.lower().replace('_', ' ')})")
        else:
            shown.sets[title] = result.set
            shown.lines[title] = lines[label.removeprefix(NEAR)]
            if result.status is not Status.CONVERGED:
                shown.inner.append(title)
    return shown


def _nearest(space: DesignSpace, design: Array) -> Array | None:
    """Nearest design that can be built; None if none is found."""
    try:
        return space.project(design)
    except InputError:
        return None


def _most_different_pairs(sets: dict[str, Polytope], nx: int) -> list[tuple[int, int]]:
    """Two pairs of states on which the areas of the sets differ most."""
    pairs = list(combinations(range(nx), 2)) if nx <= 4 else [(i, i + 1) for i in range(0, nx - 1, 2)]

    def spread(pair: tuple[int, int]) -> float:
        """Relative difference of the areas of projected and sliced sets."""
        total = 0.0
        for cut, _ in _cuts(nx):
            areas = [cut(S, pair).volume for S in sets.values()]
            total += (max(areas) - min(areas)) / max(max(areas), 1e-300)
        return total

    return sorted(sorted(pairs, key=spread)[-2:])


def _cuts(nx: int) -> list[_Cut]:
    """Cuts drawn of sets of `nx` states; no projections beyond four."""
    projected: _Cut = (_projected, "" if nx == 2 else "projection")
    sliced: _Cut = (_sliced, "slice, other states 0")
    if nx == 2:
        return [projected]
    return [projected, sliced] if nx <= 4 else [sliced]  # projections take hours beyond four


def _projected(S: Polytope, pair: tuple[int, int]) -> Polytope:
    """Projection of a set on two states."""
    return S if S.dim == 2 else S.projection(pair)


def _sliced(S: Polytope, pair: tuple[int, int]) -> Polytope:
    """Slice of a set in two states, the others zero."""
    others = [i for i in range(S.dim) if i not in pair]
    return S.slice(others, np.zeros(len(others)))
