"""Names of a program's constraints and unknowns."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mpc.checks import Array
from mpc.optimal_control.pieces import Numbers
from mpc.optimal_control.program import NonlinearProgram, Rows
from mpc.tolerances import IN_THE_WAY, NAMED_ROWS, SAME_BOUND


def rows_of(program: NonlinearProgram, row: int) -> Rows:
    """Constraints of one kind that a row belongs to."""
    return next(rows for rows in program.rows if rows.first <= row < rows.last)


def of_phase(program: NonlinearProgram, phase: int) -> str:
    """Text such as " of phase 2", where there are several."""
    return f" of phase {phase + 1}" if len(program.parts) > 1 and phase >= 0 else ""


def of_linked_phase(program: NonlinearProgram, phase: int) -> str:
    """Text such as " of phase 2", where phases follow one another."""
    return of_phase(program, phase) if program.problem.linked else ""


def limit_of_row(program: NonlinearProgram, row: int) -> str:
    """Name of the limit of a row: "path 2"."""
    rows = rows_of(program, row)
    return f"{rows.entries[(row - rows.first) % len(rows.entries)]}{of_linked_phase(program, rows.phase)}"


def name_of_row(program: NonlinearProgram, row: int) -> str:
    """Name of a constraint: "path 2 of phase 3"."""
    rows = rows_of(program, row)
    return f"{rows.entries[(row - rows.first) % len(rows.entries)]}{of_phase(program, rows.phase)}"


def describe_row(program: NonlinearProgram, row: int, v: Array) -> str:
    """Name and time of a constraint: "path 2 at t = 0.31"."""
    rows = rows_of(program, row)
    if rows.phase < 0:
        return name_of_row(program, row)
    start, length = program.times(v)[rows.phase]
    return f"{name_of_row(program, row)} at t = {start + length * rows.fractions[row - rows.first]:.6g}"


def describe_unknown(program: NonlinearProgram, index: int, v: Array) -> str:
    """Name and time of an unknown: "bound of u1 at t = 0.31"."""
    for k, (part, (start, length)) in enumerate(zip(program.parts, program.times(v))):
        if index == part.duration:
            return f"bound of the duration{of_phase(program, k)}"
        if not part.first <= index < part.last:
            continue
        own = index - part.first
        numbers, fraction = part.coordinates
        name = (*part.phase.state_names, *part.phase.input_names)[numbers[own]]
        return f"bound of {name}{of_phase(program, k)} at t = {start + length * fraction[own]:.6g}"
    own = index - program.parameters.start
    return f"bound of {program.problem.p_names[own]}" if 0 <= own < program.problem.parameters else "cost of a scenario"


def violated(program: NonlinearProgram, v: Array, violations: Array, feasible: float) -> tuple[str, ...]:
    """Violated constraints in words, the worst first.

    Each is named once for all times and scenarios, where it is violated most, with the amount in its own unit.
    """
    broken = violations > feasible
    groups = {name: rows[broken[rows]] for name, rows in _limits(program).items() if broken[rows].any()}
    worst = {name: int(rows[np.argmax(violations[rows])]) for name, rows in groups.items()}
    order = sorted(groups, key=lambda name: -violations[worst[name]])
    found = []
    for name in order[:NAMED_ROWS]:
        row = worst[name]
        more = len(groups[name]) - 1
        points = f" (and at {more} more point{'s' * (more > 1)})" if more else ""
        found.append(f"{describe_row(program, row, v)}, by {violations[row] * program.row_scale[row]:.3g}{points}")
    return _shortened(found, len(order), "constraint")


def contradiction(program: NonlinearProgram, v: Array, on_rows: Array, on_bounds: Array, violations: Array,
                  feasible: float) -> tuple[str, ...]:  # fmt: skip
    """Names of what cannot hold together, at the least violations.

    First the constraints that are violated, then those and the bounds whose multipliers hold against them.
    """
    pushing = np.abs(on_rows * program.row_scale)
    strong = IN_THE_WAY * pushing.max(initial=0.0)
    others = [
        int(rows[pushing[rows].argmax()])
        for rows in _limits(program, without=("dynamics",)).values()
        if pushing[rows].max() > strong and not (violations[rows] > feasible).any()
    ]
    others.sort(key=lambda i: -pushing[i])
    named = [describe_row(program, i, v) for i in others[:NAMED_ROWS]]
    return (
        *violated(program, v, violations, feasible), *_shortened(named, len(others), "constraint"),
        *_bounds_in_the_way(program, v, on_bounds),
    )  # fmt: skip


def _limits(program: NonlinearProgram, without: tuple[str, ...] = ()) -> dict[str, Numbers]:
    """Rows of every limit by its name."""
    found: dict[str, list[Numbers]] = {}
    for rows in program.rows:
        if rows.name in without:
            continue
        for first in range(rows.first, rows.first + len(rows.entries)):
            own = np.arange(first, rows.last, len(rows.entries))
            found.setdefault(limit_of_row(program, first), []).append(own)
    return {name: np.concatenate(each) for name, each in found.items()}


def _bounds_in_the_way(program: NonlinearProgram, v: Array, on_bounds: Array) -> tuple[str, ...]:
    """Bounds with large multipliers, in words, the heaviest first."""
    weights = on_bounds[: len(v)] * program.scale
    groups: dict[str, float] = {}
    for i, text in _texts(program, v, weights):
        groups[text] = groups.get(text, 0.0) + abs(weights[i])
    largest = max(groups.values(), default=0.0)
    held = [text for text, weight in groups.items() if weight > IN_THE_WAY * largest]
    held.sort(key=lambda text: -round(np.log10(groups[text])))
    return _shortened(held[:10], len(held), "bound")


def _shortened(named: list[str], count: int, what: str) -> tuple[str, ...]:
    """Names, and how many more there are."""
    more = count - len(named)
    return (*named, f"and {more} more {what}{'s' * (more > 1)}") if more else tuple(named)


def _texts(program: NonlinearProgram, v: Array, weights: Array) -> Iterator[tuple[int, str]]:
    """Names of the bounds of unknowns with a multiplier."""
    for k, part in enumerate(program.parts):
        phase = of_linked_phase(program, k)
        numbers, _ = part.coordinates
        names = (*part.phase.state_names, *part.phase.input_names)
        ends = {part.first: "start of ", part.last - part.layout.node: "end of "}
        whole = part.phase.x_bounds
        for i in range(part.first, part.last):
            entry = numbers[i - part.first]
            where = next((ends[i - n] for n in (entry,) if i - n in ends and entry < part.layout.nx), "")
            if where and (program.lower[i], program.upper[i]) == (whole[0][entry], whole[1][entry]):
                where = ""
            if weights[i]:
                yield i, f"{where}{names[entry]} {_side(program, i, weights[i], v[i])}{phase}"
        if part.duration >= 0:
            i = part.duration
            yield i, f"duration {_side(program, i, weights[i], v[i])}{phase}"
    for number, i in enumerate(range(program.parameters.start, program.parameters.stop)):
        yield i, f"{program.problem.p_names[number]} {_side(program, i, weights[i], v[i])}"


def _side(program: NonlinearProgram, i: int, weight: float, value: float) -> str:
    """Side and value of the bound that a multiplier belongs to."""
    low, high = program.lower[i], program.upper[i]
    if high - low <= SAME_BOUND * program.scale[i]:
        return f"= {high:.6g}"
    bound = high if weight > 0 else low
    if abs(bound - value) > IN_THE_WAY * program.scale[i]:
        return f"= {value:.6g}"
    return f"{'≤' if weight > 0 else '≥'} {bound:.6g}"
