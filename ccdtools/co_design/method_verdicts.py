"""Verdicts of a comparison of methods, in words."""

from __future__ import annotations

from typing import Any

import numpy as np

from ccdtools.co_design.design_controllers import tangent_note
from ccdtools.co_design.tolerances import OUTSIDE_SHARE, OWN_OBJECTIVE, SAME_PLACE

SAME = 0.5  # Two methods are equal if they differ by at most this part of the reference's return [%].


def method_verdicts(comparison: Any) -> list[str]:
    """Verdicts on methods that are equal, win, lose or refused, and why."""
    rows = [row for row in comparison.rows if row.result is not None]
    refused = [f"{row.name} refused: {row.refused}" for row in comparison.rows if row.result is None]
    if not rows:
        return ["No method could treat this problem.", *refused]
    lines = [_equal(comparison, rows), _winner(comparison)]
    for row in rows:
        if row.name == comparison.reference or row is comparison.best or not _differs(comparison, row):
            continue
        only = ", in return only" if leaves_limits(comparison, row) and _percent(comparison, row)[0] > 0 else ""
        said = [f"{_difference(comparison, row)}{only}", _parts(comparison, row)]
        lines.append(f"{row.name}: {'; '.join(part for part in said if part)}.")
    lines += _unsound(comparison, rows)
    return [line for line in (*lines, tangent_note(comparison.problem)) if line] + refused


def leaves_limits(comparison: Any, row: Any) -> bool:
    """Whether a method leaves limits more often than the reference may."""
    return bool(row.closed_loop.outside > 2 * comparison[comparison.reference].closed_loop.outside + OUTSIDE_SHARE)


def signed(percent: float) -> str:
    """Signed number with two decimals, 0 if rounded away."""
    return f"{percent:+.2f}" if abs(percent) >= 0.005 else "0"


def _percent(comparison: Any, row: Any) -> tuple[float, float, float]:
    """Difference to the reference with interval [%], NaN without pairs."""
    if row.difference is None:
        return (np.nan, np.nan, np.nan)
    low, high = row.difference.ci95
    return comparison.percent(row.difference.mean), comparison.percent(low), comparison.percent(high)


def _differs(comparison: Any, row: Any) -> bool:
    """Whether a method and the reference are not equal."""
    return not abs(_percent(comparison, row)[0]) <= SAME


def _equal(comparison: Any, rows: list[Any]) -> str:
    """Methods as good as the reference."""
    if comparison[comparison.reference].closed_loop.lost.all():
        return f"Every run of {comparison.reference} is lost: there is nothing to compare with."
    same = [row for row in rows if not _differs(comparison, row)]
    names = ", ".join(row.name for row in same)
    if len(rows) == 1:
        return ""
    if len(same) < 2:
        return f"No other method is within {SAME:g} % of {comparison.reference}."
    space = comparison.problem.design
    points = space.to_unit(np.array([row.result.design for row in same]))
    spread = float(np.ptp(points, axis=0).max())
    first = comparison[comparison.reference].result
    if spread <= SAME_PLACE:
        where = f"at one design, {space.describe(first.design)}"
    else:
        where = f"at designs up to {spread:.0%} of the box apart: the return is flat there"
    return f"Equal within {SAME:g} % of the return of {comparison.reference}: {names}; {where}."


def _winner(comparison: Any) -> str:
    """Best method and its lead, if better than the reference."""
    best = comparison.best
    if sum(row.result is not None for row in comparison.rows) == 1:
        return ""
    mean, low, _ = _percent(comparison, best)
    if comparison[comparison.reference].closed_loop.lost.all():
        return ""
    if best.name == comparison.reference or not mean > SAME:
        better = (row for row in comparison.rows if row.result is not None and _percent(comparison, row)[0] > SAME)
        kept = " that keeps the limits" if any(leaves_limits(comparison, row) for row in better) else ""
        return f"No method{kept} is better than {comparison.reference} by more than {SAME:g} %."
    certain = "" if low > 0 else " (the interval holds 0)"
    said = [f"{_difference(comparison, best)}{certain}", _parts(comparison, best)]
    return f"{best.name} wins: {'; '.join(part for part in said if part)}."


def _difference(comparison: Any, row: Any) -> str:
    """Difference in words."""
    mean, low, high = _percent(comparison, row)
    if np.isnan(mean):
        return f"no run in common with {comparison.reference} that is not lost"
    better = "better" if mean > 0 else "worse"
    ends = sorted((abs(low), abs(high))) if low * high > 0 else (np.sign(mean) * low, np.sign(mean) * high)
    first, last = sorted(ends)
    return f"{abs(mean):.2f} % [{first:.2f}, {last:.2f}] {better} than {comparison.reference}"


def _parts(comparison: Any, row: Any) -> str:
    """Measured parts of a difference: design, controller and objective.

    No cause is named: that would take the same method without the supposed cause.
    """
    result = row.result
    made_for = f"its criterion is the {result.criterion}" if result.criterion else ""
    loop = row.closed_loop.summary.mean
    if made_for and abs(comparison.percent(result.objective - loop)) > OWN_OBJECTIVE:
        made_for += f", {result.objective:.5g}, beside {loop:.5g} in closed loop"
    if row.from_design is None or row.from_control is None:
        return made_for
    by_design, by_control = (comparison.percent(part.mean) for part in (row.from_design, row.from_control))
    measured = f"{signed(by_design)} % by its design, {signed(by_control)} % by its controller"
    if abs(by_design) > SAME / 2:
        measured += f" at {comparison.problem.design.describe(result.design)}"
    ended = "" if result.status.settled else result.status.value
    return "; ".join(part for part in (measured, made_for, ended) if part)


def _unsound(comparison: Any, rows: list[Any]) -> list[str]:
    """Methods with lost runs, broken limits or constraints, or a doubtful interval."""
    lines = []
    for row in rows:
        loop = row.closed_loop
        said = [f"{loop.lost_share:.2%} of its runs are lost"] if loop.lost.any() else []
        said += [loop.summary.warning] if loop.summary.warning else []
        if leaves_limits(comparison, row):
            said.append(f"{loop.outside:.2%} of its states are outside the limits, {loop.depth:.2g} half-widths deep")
        if not row.sound:
            said.append(row.result.status.value)
        if row.violation > 1e-6:
            said.append(f"its design breaks a constraint by {row.violation:.2g} of the box")
        if said:
            lines.append(f"{row.name}: {', '.join(said)}.")
    return lines
