"""Closed-loop returns of methods in pairs."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from ccdtools.arrays import Array, Immutable
from ccdtools.co_design.closed_loop import ClosedLoopReturns, closed_loop_returns, scenarios_of
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import CoDesignResult, CoDesignStatus
from ccdtools.co_design.risk_intervals import difference_of_parts
from ccdtools.statistics import PairedDifference
from mpc import MPCError

UNSOUND = (CoDesignStatus.DIVERGING, CoDesignStatus.INFEASIBLE, CoDesignStatus.LIMITS_BROKEN)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class MethodRow(Immutable):
    """Outcome of one method.

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
        """Measured returns of a method that did not refuse."""
        assert self.result is not None
        assert self.result.closed_loop is not None
        return self.result.closed_loop

    @property
    def sound(self) -> bool:
        """True if a design was found without lost runs or broken limits."""
        return self.result is not None and self.result.status not in UNSOUND


def paired_row(
    problem: CoDesignProblem, seed: int, name: str, result: CoDesignResult, reference: CoDesignResult,
    seen: dict[Any, ClosedLoopReturns | None],
) -> MethodRow:  # fmt: skip
    """Row of a result beside the reference; `seen` keeps the returns of LQR that were measured."""
    own, other = result.closed_loop, reference.closed_loop
    assert own is not None
    assert other is not None
    runs = min(len(own.values), len(other.values))

    def lqr(design: Array) -> ClosedLoopReturns | None:
        """Returns of a design's saturated LQR on the scenarios of `codesign`; None without one."""
        key = (tuple(design), runs)
        if key not in seen:
            seen[key] = None
            with suppress(MPCError):
                controller = saturated_lqr(problem, design)
                seen[key] = closed_loop_returns(problem, controller, design, scenarios_of(seed), runs=runs)
        return seen[key]

    here, there = lqr(result.design), lqr(reference.design)
    pairs = ~(own.lost[:runs] | other.lost[:runs])
    common = np.flatnonzero(pairs)
    by_design = by_control = None
    if here is not None and there is not None:
        kept = np.flatnonzero(pairs & ~here.lost & ~there.lost)
        if len(kept):
            design = here.parts(kept) - there.parts(kept)
            by_design = difference_of_parts(problem.risk, design, kept)
            by_control = difference_of_parts(problem.risk, own.parts(kept) - other.parts(kept) - design, kept)
    gap = difference_of_parts(problem.risk, own.parts(common) - other.parts(common), common) if len(common) else None
    return MethodRow(
        name=name, result=result, difference=gap, from_design=by_design, from_control=by_control, runs=len(common),
        violation=float(problem.design.violation(result.design)),
    )  # fmt: skip
