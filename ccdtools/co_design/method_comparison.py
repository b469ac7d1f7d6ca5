"""Comparison of methods: designs, closed-loop returns and reasons."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ccdtools.arrays import Immutable
from ccdtools.co_design.closed_loop import ClosedLoopReturns
from ccdtools.co_design.design_controllers import tangent_note
from ccdtools.co_design.method_pairs import MethodRow
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import CoDesignResult
from ccdtools.co_design.tolerances import MORE_LOST, NOT_WORSE_PERCENT, OUTSIDE_SHARE, OWN_OBJECTIVE, SAME_PLACE
from ccdtools.exceptions import InputError
from ccdtools.statistics import PairedDifference
from ccdtools.table import Table, csv_text
from ccdtools_ground.door import writable_path

HEAD = (
    "method", "design", "return", "95 % interval", "lost", "difference", "own objective", "evals", "time", "status",
    "held by",
)  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class MethodComparison(Immutable):
    """Comparison of methods, with one row per method and a verdict.

    It is iterated like a list of `MethodRow`, and indexed by number or by the name of a method.

    Attributes
    ----------
    rows : tuple of MethodRow
    reference : str
        The method that differences are to.
    size : float
        How large the reference's return is without the cost of its design: what per cent are of.
    problem : CoDesignProblem
    seed : int
    """

    rows: tuple[MethodRow, ...]
    reference: str
    size: float
    problem: CoDesignProblem
    seed: int

    def __iter__(self) -> Iterator[MethodRow]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, key: int | str) -> MethodRow:
        if isinstance(key, int):
            return self.rows[key]
        for row in self.rows:
            if row.name == key:
                return row
        raise KeyError(f"{key!r}; the methods are {', '.join(row.name for row in self.rows)}")

    def __repr__(self) -> str:
        return f"MethodComparison({', '.join(row.name for row in self.rows)}; reference {self.reference})"

    @property
    def best(self) -> MethodRow:
        """Best method of those that keep limits and lose fewest runs.

        As far as limits are left by all, those that leave them as the reference does.
        """
        found = [row for row in self.rows if row.result is not None]
        if not found:
            raise InputError("methods", "none that did not refuse", "a method that can treat this problem")
        sound = [row for row in found if row.sound] or found
        fewest = min(row.closed_loop.lost_share for row in sound)
        kept = [row for row in sound if row.closed_loop.lost_share <= fewest + MORE_LOST]
        kept = [row for row in kept if not leaves_limits(self, row)] or kept
        return max(kept, key=lambda row: -np.inf if row.difference is None else row.difference.mean)

    @property
    def verdict(self) -> list[str]:
        """Sentences on methods that are equal, win, lose or refused, with measured parts."""
        rows: list[Any] = [row for row in self.rows if row.result is not None]
        refused = [f"{row.name} refused: {row.refused}" for row in self.rows if row.result is None]
        if not rows:
            return ["No method could treat this problem.", *refused]
        lines = [_equal(self, rows), _winner(self, rows)]
        for row in rows:
            if row.name == self.reference or row is self.best or not _differs(self, row):
                continue
            only = ", in return only" if leaves_limits(self, row) and _percent(self, row)[0] > 0 else ""
            lines.append(f"{row.name}: {_said(self, row, only)}.")
        lines += _unsound(self, rows)
        return [line for line in (*lines, tangent_note(self.problem)) if line] + refused

    def percent(self, difference: float) -> float:
        """Difference in per cent of `size`."""
        return 100 * difference / self.size

    def table(self) -> list[dict[str, Any]]:
        """One dictionary of plain values per method; NaN or "" for nothing."""
        return [self._cells(row) for row in self.rows]

    def to_csv(self, path: str | Path) -> Path:
        """Write the table as CSV and return its path."""
        target = writable_path("path", path)
        target.write_text(csv_text(self.table()), encoding="utf-8", newline="")
        return target

    def plot(self) -> Any:
        """Figure of return against time, and of designs on the landscape.

        Of more than two parameters the designs are shown in parts of their ranges.
        """
        from ccdtools.co_design.method_plots import plot_methods

        return plot_methods(self)

    def _cells(self, row: MethodRow) -> dict[str, Any]:
        """Values of a row."""
        space = self.problem.design
        found = row.result or CoDesignResult(design=np.full(space.dim, np.nan))
        loop = found.closed_loop or ClosedLoopReturns(np.zeros(0), np.zeros(0, dtype=bool), np.nan, np.nan)
        mean, ends = loop.summary.mean, loop.summary.ci95
        gap, by_design, by_control = (
            part or PairedDifference(np.nan, (np.nan, np.nan))
            for part in (row.difference, row.from_design, row.from_control)
        )
        return {
            "method": row.name, **dict(zip(space.names, found.design.tolist())), "return": mean,
            "return_low95": ends[0], "return_high95": ends[1], "runs": loop.summary.n, "lost": loop.lost_share,
            "outside": loop.outside, "depth": loop.depth, "difference": gap.mean, "difference_low95": gap.ci95[0],
            "difference_high95": gap.ci95[1], "difference_percent": self.percent(gap.mean), "common_runs": row.runs,
            "from_design_percent": self.percent(by_design.mean),
            "from_control_percent": self.percent(by_control.mean), "objective": found.objective,
            "criterion": found.criterion, "evaluations": found.evaluations, "seconds": found.seconds,
            "status": "refused" if row.result is None else found.status.name, "held_by": held(found),
            "violation": np.nan if row.result is None else row.violation, "refused": row.refused,
        }  # fmt: skip

    def __str__(self) -> str:
        """Table in aligned columns, with the verdict below."""
        return "\n".join([*self.printed.aligned(), "", *self.verdict])

    def markdown(self) -> str:
        """Printed table in Markdown."""
        return self.printed.markdown

    @property
    def printed(self) -> Table:
        """Table as it is printed."""
        head = (*HEAD[:5], f"to {self.reference}", *HEAD[6:])
        return Table(head, [self._texts(row) for row in self.rows], right=frozenset({2, 4, 6, 7, 8}))

    def _texts(self, row: MethodRow) -> tuple[str, ...]:
        """Cells of a printed row, two if the method refused."""
        if row.result is None:
            return row.name, f"refused: {row.refused}"
        found = row.result
        summary = row.closed_loop.summary
        low, high = summary.ci95
        lost = row.closed_loop.lost_share
        runs = len(row.closed_loop.values)
        fewer = any(other.result is not None and len(other.closed_loop.values) > runs for other in self.rows)
        of = f" ({runs} runs)" if fewer else ""
        return (
            row.name, self.problem.design.describe(found.design), f"{summary.mean:.5g}{of}", f"[{low:.5g}, {high:.5g}]",
            f"{lost:.2%}" if lost else "0", self.difference_text(row), f"{found.objective:.5g}",
            str(found.evaluations), f"{found.seconds:.3g} s", found.status.name.lower().replace("_", " "),
            held(found) or "–",
        )  # fmt: skip

    def difference_text(self, row: MethodRow) -> str:
        """Difference to the reference in per cent, with its interval."""
        if row.name == self.reference:
            return "reference"
        if row.difference is None:
            return "no pairs"
        mean, *ends = (self.percent(value) for value in (row.difference.mean, *row.difference.ci95))
        return f"{signed(mean)} % [{signed(ends[0])}, {signed(ends[1])}]"


def held(result: CoDesignResult) -> str:
    """Active bounds and constraints of a design as text, maybe empty."""
    bounds = [f"{name} {side}" for name, side in result.active_bounds.items()]
    return ", ".join([*bounds, *result.active_constraints])


def leaves_limits(comparison: MethodComparison, row: Any) -> bool:
    """Whether a method leaves limits more often than the reference may."""
    return bool(row.closed_loop.outside > 2 * comparison[comparison.reference].closed_loop.outside + OUTSIDE_SHARE)


def signed(percent: float) -> str:
    """Signed number with two decimals, 0 if rounded away."""
    return f"{percent:+.2f}" if abs(percent) >= 0.005 else "0"


def _percent(comparison: MethodComparison, row: Any) -> tuple[float, float, float]:
    """Difference to the reference with interval [%], NaN without pairs."""
    if row.difference is None:
        return (np.nan, np.nan, np.nan)
    low, high = row.difference.ci95
    return comparison.percent(row.difference.mean), comparison.percent(low), comparison.percent(high)


def _differs(comparison: MethodComparison, row: Any) -> bool:
    """Whether a method and the reference are not equal."""
    return not abs(_percent(comparison, row)[0]) <= NOT_WORSE_PERCENT


def _equal(comparison: MethodComparison, rows: list[Any]) -> str:
    """Methods as good as the reference."""
    if comparison[comparison.reference].closed_loop.lost.all():
        return f"Every run of {comparison.reference} is lost: there is nothing to compare with."
    same = [row for row in rows if not _differs(comparison, row)]
    names = ", ".join(row.name for row in same)
    if len(rows) == 1:
        return ""
    if len(same) < 2:
        return f"No other method is within {NOT_WORSE_PERCENT:g} % of {comparison.reference}."
    space = comparison.problem.design
    points = space.to_unit(np.array([row.result.design for row in same]))
    spread = float(np.ptp(points, axis=0).max())
    first: Any = comparison[comparison.reference].result
    if spread <= SAME_PLACE:
        where = f"at one design, {space.describe(first.design)}"
    else:
        where = f"at designs up to {spread:.0%} of the box apart: the return is flat there"
    return f"Equal within {NOT_WORSE_PERCENT:g} % of the return of {comparison.reference}: {names}; {where}."


def _winner(comparison: MethodComparison, rows: list[Any]) -> str:
    """Best method and its lead, if better than the reference."""
    best = comparison.best
    if len(rows) == 1 or comparison[comparison.reference].closed_loop.lost.all():
        return ""
    mean, low, _ = _percent(comparison, best)
    if best.name == comparison.reference or not mean > NOT_WORSE_PERCENT:
        better = (row for row in rows if _percent(comparison, row)[0] > NOT_WORSE_PERCENT)
        kept = " that keeps the limits" if any(leaves_limits(comparison, row) for row in better) else ""
        return f"No method{kept} is better than {comparison.reference} by more than {NOT_WORSE_PERCENT:g} %."
    certain = "" if low > 0 else " (the interval holds 0)"
    return f"{best.name} wins: {_said(comparison, best, certain)}."


def _said(comparison: MethodComparison, row: Any, added: str) -> str:
    """Difference in words with an addition, and its parts."""
    return "; ".join(part for part in (f"{_difference(comparison, row)}{added}", _parts(comparison, row)) if part)


def _difference(comparison: MethodComparison, row: Any) -> str:
    """Difference in words."""
    mean, low, high = _percent(comparison, row)
    if np.isnan(mean):
        return f"no run in common with {comparison.reference} that is not lost"
    better = "better" if mean > 0 else "worse"
    ends = sorted((abs(low), abs(high))) if low * high > 0 else (np.sign(mean) * low, np.sign(mean) * high)
    first, last = sorted(ends)
    return f"{abs(mean):.2f} % [{first:.2f}, {last:.2f}] {better} than {comparison.reference}"


def _parts(comparison: MethodComparison, row: Any) -> str:
    """Measured parts of a difference: design, controller and objective; no cause, which would take a test."""
    result = row.result
    made_for = f"its criterion is the {result.criterion}" if result.criterion else ""
    loop = row.closed_loop.summary.mean
    if made_for and abs(comparison.percent(result.objective - loop)) > OWN_OBJECTIVE:
        made_for += f", {result.objective:.5g}, beside {loop:.5g} in closed loop"
    if row.from_design is None or row.from_control is None:
        return made_for
    by_design, by_control = (comparison.percent(part.mean) for part in (row.from_design, row.from_control))
    measured = f"{signed(by_design)} % by its design, {signed(by_control)} % by its controller"
    if abs(by_design) > NOT_WORSE_PERCENT / 2:
        measured += f" at {comparison.problem.design.describe(result.design)}"
    ended = "" if result.status.settled else result.status.value
    return "; ".join(part for part in (measured, made_for, ended) if part)


def _unsound(comparison: MethodComparison, rows: list[Any]) -> list[str]:
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
