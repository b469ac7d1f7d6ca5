"""What methods found, in pairs with one of them: differences of returns on common scenarios."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ccdtools.arrays import Array, Immutable
from ccdtools.co_design.closed_loop import closed_loop_returns
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import ClosedLoopReturns, CoDesignResult
from ccdtools.co_design.risk_intervals import difference_of_parts
from ccdtools.co_design.status import CoDesignStatus
from ccdtools.statistics import PairedDifference
from mpc import MPCError

UNSOUND = (CoDesignStatus.DIVERGING, CoDesignStatus.INFEASIBLE, CoDesignStatus.LIMITS_BROKEN)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class MethodRow(Immutable):
    """What one method came to.

    Attributes
    ----------
    name : str
    result : CoDesignResult or None
        None of a method that refused.
    refused : str
        Why; empty of one that did not.
    difference : PairedDifference or None
        Of its closed-loop return to that of the reference, on the scenarios that both were measured on and where
        neither run is lost.
    from_design, from_control : PairedDifference or None
        The parts of it that are made by its design, as saturated LQR has them at both, and by its controller, beside
        saturated LQR of the same design; None where there is no LQR.
    runs : int
        Scenarios of the differences.
    violation : float
        Of the constraints g(p) ≤ 0 at its design, as `DesignSpace.violation` has it; 0 where there are none.
    """

    name: str
    result: CoDesignResult | None = None
    refused: str = ""
    difference: PairedDifference | None = None
    from_design: PairedDifference | None = None
    from_control: PairedDifference | None = None
    runs: int = 0
    violation: float = 0.0

    def __repr__(self) -> str:
        return f"MethodRow({self.name}: {f'refused: {self.refused}' if self.refused else repr(self.result)})"

    @property
    def closed_loop(self) -> ClosedLoopReturns:
        """What was measured; only of a method that did not refuse."""
        assert self.result is not None
        assert self.result.closed_loop is not None
        return self.result.closed_loop

    @property
    def sound(self) -> bool:
        """Whether it found something, and its own account is not of lost runs, or of limits that are not kept."""
        return self.result is not None and self.result.status not in UNSOUND


class Pairs:
    """Differences of results to that of the reference, on the scenarios that both are measured on."""

    def __init__(self, problem: CoDesignProblem, seed: int, reference: CoDesignResult) -> None:
        self.problem = problem
        self.seed = seed
        self.reference = reference
        assert reference.closed_loop is not None
        mean = reference.closed_loop.summary.mean
        self.size = float(problem.made_by_control(mean, reference.design)) or 1.0
        self._seen: dict[Any, ClosedLoopReturns] = {}

    def row(self, name: str, result: CoDesignResult) -> MethodRow:
        """The row of a result."""
        assert result.closed_loop is not None
        assert self.reference.closed_loop is not None
        runs = min(len(result.closed_loop.values), len(self.reference.closed_loop.values))
        own = self._first(result, runs)
        other = self._first(self.reference, runs)
        here, there = self._lqr(result.design, runs), self._lqr(self.reference.design, runs)
        loops = [own, other, *(loop for loop in (here, there) if loop is not None)]
        kept = np.flatnonzero(~np.logical_or.reduce([loop.lost for loop in loops]))
        pairs = np.flatnonzero(~(own.lost | other.lost))
        risk = self.problem.risk
        by_design = by_control = None
        if here is not None and there is not None and len(kept):
            design = here.parts(kept) - there.parts(kept)
            by_design = difference_of_parts(risk, design, kept)
            by_control = difference_of_parts(risk, own.parts(kept) - other.parts(kept) - design, kept)
        gap = difference_of_parts(risk, own.parts(pairs) - other.parts(pairs), pairs) if len(pairs) else None
        return MethodRow(
            name=name, result=result, difference=gap, from_design=by_design, from_control=by_control, runs=len(pairs),
            violation=float(self.problem.design.violation(result.design)),
        )  # fmt: skip

    def _first(self, result: CoDesignResult, runs: int) -> ClosedLoopReturns:
        """A result on the first so many of its scenarios."""
        assert result.closed_loop is not None
        if len(result.closed_loop.values) == runs:
            return result.closed_loop
        return self._measured((id(result), runs), result.controller, result.design, runs)

    def _lqr(self, design: Array, runs: int) -> ClosedLoopReturns | None:
        """Saturated LQR of a design on them; None where there is none."""
        try:
            controller = saturated_lqr(self.problem, design)
        except MPCError:
            return None
        return self._measured((tuple(design), runs), controller, design, runs)

    def _measured(self, key: Any, controller: Any, design: Array, runs: int) -> ClosedLoopReturns:
        """Returns on the scenarios that `codesign` measures on, once each."""
        if key not in self._seen:
            drawn = scenarios_of(self.seed)
            self._seen[key] = closed_loop_returns(self.problem, controller, design, drawn, runs=runs)
        return self._seen[key]


def scenarios_of(seed: int) -> np.random.Generator:
    """What draws the scenarios of a seed that `codesign` measures on."""
    return np.random.default_rng(seed).spawn(1)[0]
