"""Names of a program's constraints and unknowns."""

from __future__ import annotations

import numpy as np

from mpc.budgets import NAMED_ROWS
from mpc.checks import Array
from mpc.optimal_control.pieces import Numbers
from mpc.optimal_control.program import NonlinearProgram
from mpc.tolerances import AT_BOUND, IN_THE_WAY


def of_phase(program: NonlinearProgram, phase: int) -> str:
    """Text such as " of phase 2", where there are several."""
    return f" of phase {phase + 1}" if len(program.parts) > 1 and phase >= 0 else ""


def _of_linked_phase(program: NonlinearProgram, phase: int) -> str:
    """Text such as " of phase 2", where phases follow one another."""
    return of_phase(program, phase) if program.problem.linked else ""


def describe_row(program: NonlinearProgram, row: int, v: Array) -> str:
    """Name and time of a constraint: "path 2 of phase 3 at t = 0.31"."""
    rows = next(rows for rows in program.rows if rows.first <= row < rows.last)
    name = f"{rows.entries[(row - rows.first) % len(rows.entries)]}{of_phase(program, rows.phase)}"
    return f"{name}{_when(program, rows.phase, rows.fractions[row - rows.first], v)}"


def describe_unknown(program: NonlinearProgram, index: int, v: Array) -> str:
    """Name and time of an unknown: "bound of u1 at t = 0.31"."""
    name, phase, _, fraction = _unknown(program, index)
    return f"bound of {name}{of_phase(program, phase)}{_when(program, phase, fraction, v)}"


def _when(program: NonlinearProgram, phase: int, fraction: float, v: Array) -> str:
    """Text such as " at t = 0.31" for a fraction of a phase, where there are both."""
    if phase < 0 or np.isnan(fraction):
        return ""
    start, length = program.times(v)[phase]
    return f" at t = {start + length * fraction:.6g}"


def _unknown(program: NonlinearProgram, index: int) -> tuple[str, int, int, float]:
    """Name of an unknown, with its phase, coordinate and fraction if any."""
    for k, part in enumerate(program.parts):
        if index == part.duration:
            return "the duration", k, -1, np.nan
        if part.first <= index < part.last:
            numbers, fractions = part.coordinates
            number = int(numbers[index - part.first])
            names = (*part.phase.state_names, *part.phase.input_names)
            return names[number], k, number, float(fractions[index - part.first])
    own = index - program.parameters.start
    if 0 <= own < program.problem.parameters:
        return program.problem.p_names[own], -1, -1, np.nan
    return "the cost of a scenario" if index < program.costs.stop else "a violation that has a price", -1, -1, np.nan


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
        for i, entry in enumerate(rows.entries):
            own = np.arange(rows.first + i, rows.last, len(rows.entries))
            found.setdefault(f"{entry}{_of_linked_phase(program, rows.phase)}", []).append(own)
    return {name: np.concatenate(each) for name, each in found.items()}


def _bounds_in_the_way(program: NonlinearProgram, v: Array, on_bounds: Array) -> tuple[str, ...]:
    """Bounds with large multipliers, in words, the heaviest first."""
    weights = on_bounds[: len(v)] * program.scale
    groups: dict[str, float] = {}
    for i in np.flatnonzero(weights).tolist():
        text = _bound(program, i, weights[i], v[i])
        groups[text] = groups.get(text, 0.0) + abs(weights[i])
    largest = max(groups.values(), default=0.0)
    held = [text for text, weight in groups.items() if weight > IN_THE_WAY * largest]
    held.sort(key=lambda text: -round(np.log10(groups[text])))
    return _shortened(held[:10], len(held), "bound")


def _shortened(named: list[str], count: int, what: str) -> tuple[str, ...]:
    """Names, and how many more there are."""
    more = count - len(named)
    return (*named, f"and {more} more {what}{'s' * (more > 1)}") if more else tuple(named)


def _bound(program: NonlinearProgram, i: int, weight: float, value: float) -> str:
    """Bound of an unknown that a multiplier belongs to: "end of x1 = 3 of phase 2"."""
    name, k, number, fraction = _unknown(program, i)
    where = ""
    if 0 <= number < program.parts[k].layout.nx:
        low, high = program.parts[k].phase.x_bounds
        if (program.lower[i], program.upper[i]) != (low[number], high[number]):
            where = {0.0: "start of ", 1.0: "end of "}.get(fraction, "")
    low, high = program.lower[i], program.upper[i]
    bound = high if weight > 0 else low
    side = f"{'≤' if weight > 0 else '≥'} {bound:.6g}"
    if high - low <= AT_BOUND * program.scale[i]:
        side = f"= {high:.6g}"
    elif abs(bound - value) > IN_THE_WAY * program.scale[i]:
        side = f"= {value:.6g}"
    return f"{where}{name.removeprefix('the ')} {side}{_of_linked_phase(program, k)}"
