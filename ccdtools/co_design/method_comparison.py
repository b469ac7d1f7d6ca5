"""Comparison of methods: designs, closed-loop returns and reasons."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ccdtools.arrays import Immutable
from ccdtools.checks import writable_path
from ccdtools.co_design.method_pairs import MethodRow
from ccdtools.co_design.method_verdicts import leaves_limits, method_verdicts, signed
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import ClosedLoopReturns, CoDesignResult
from ccdtools.co_design.tolerances import MORE_LOST
from ccdtools.exceptions import InputError
from ccdtools.table import Table, csv_text

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
        """Sentences on equal methods, the winner and why."""
        return method_verdicts(self)

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
        found = row.result
        nothing = (np.nan, np.nan)
        loop = None if found is None else row.closed_loop
        mean, ends, runs = (np.nan, nothing, 0) if loop is None else _summary(loop)
        gap = row.difference
        low, high = nothing if gap is None else gap.ci95
        parts = [np.nan if part is None else self.percent(part.mean) for part in (row.from_design, row.from_control)]
        design = np.full(space.dim, np.nan) if found is None else found.design
        return {
            "method": row.name, **{name: float(value) for name, value in zip(space.names, design)},
            "return": mean, "return_low95": ends[0], "return_high95": ends[1], "runs": runs,
            "lost": np.nan if loop is None else loop.lost_share,
            "outside": np.nan if loop is None else loop.outside, "depth": np.nan if loop is None else loop.depth,
            "difference": np.nan if gap is None else gap.mean, "difference_low95": low, "difference_high95": high,
            "difference_percent": np.nan if gap is None else self.percent(gap.mean), "common_runs": row.runs,
            "from_design_percent": parts[0], "from_control_percent": parts[1],
            "objective": np.nan if found is None else found.objective,
            "criterion": "" if found is None else found.criterion,
            "evaluations": 0 if found is None else found.evaluations,
            "seconds": np.nan if found is None else found.seconds,
            "status": "refused" if found is None else found.status.name,
            "held_by": "" if found is None else held(found),
            "violation": np.nan if found is None else row.violation, "refused": row.refused,
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
        mean, (low, high), _ = _summary(row.closed_loop)
        lost = row.closed_loop.lost_share
        runs = len(row.closed_loop.values)
        fewer = any(other.result is not None and len(other.closed_loop.values) > runs for other in self.rows)
        of = f" ({runs} runs)" if fewer else ""
        return (
            row.name, self.problem.design.describe(found.design), f"{mean:.5g}{of}", f"[{low:.5g}, {high:.5g}]",
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


def _summary(loop: ClosedLoopReturns) -> tuple[float, tuple[float, float], int]:
    """Mean, interval and number of the kept runs."""
    summary = loop.summary
    return summary.mean, summary.ci95, summary.n
