"""Closed-loop returns of controllers, and of methods in pairs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ccdtools.arrays import Array, Immutable
from ccdtools.checks import as_count, as_generator, as_instance
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.co_design.differentiable_model import Stepper, in_double, scenario_tensors
from ccdtools.co_design.episodes import fewer_runs, simulated
from ccdtools.co_design.limit_tolerance import measured, measurement_errors
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import ClosedLoopReturns, CoDesignResult
from ccdtools.co_design.risk import fewest_runs
from ccdtools.co_design.risk_intervals import difference_of_parts
from ccdtools.co_design.status import CoDesignStatus
from ccdtools.controllers.signals import Driver
from ccdtools.exceptions import InputError
from ccdtools.statistics import PairedDifference
from mpc import MPCError

RUNS = 1000  # So many scenarios of 100 steps are taken, of longer ones fewer.
ONLINE_RUNS = 200  # A controller that plans ahead at every sample has so many.
UNSOUND = (CoDesignStatus.DIVERGING, CoDesignStatus.INFEASIBLE, CoDesignStatus.LIMITS_BROKEN)


def closed_loop_returns(
    problem: CoDesignProblem, controller: Any, design: ArrayLike, rng: np.random.Generator, *, runs: int | None = None
) -> ClosedLoopReturns:
    """Returns of a controller at a design, with learned errors included.

    Two controllers with generators of the same seed meet the same scenarios, the one with fewer runs the first of them.

    Parameters
    ----------
    problem : CoDesignProblem
    controller : callable
        Of the state; it may have memory.
    design : (np,) array_like
    rng : numpy.random.Generator
    runs : int, optional
        At most, and by default, as many as 1000 of 100 steps; by default 200 of a controller with a horizon. Of a worst
        case at least one of every case.

    Raises
    ------
    InputError
        If the design is outside its bounds, or the controller returns the wrong shape or asks for unknown signals.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    as_generator("rng", rng)
    p = torch.tensor(problem.design.check_one(design))
    all_runs = fewer_runs(RUNS, problem.steps)
    x0, w = (part.double() for part in scenario_tensors(problem, all_runs, rng))
    chosen = ONLINE_RUNS if hasattr(controller, "horizon") else RUNS
    n = fewer_runs(chosen, problem.steps) if runs is None else as_count("runs", runs)
    n = min(max(n, fewest_runs(problem.risk)), len(x0))
    x0, w = x0[:n], w[:n]
    if (x0 == x0[0]).all() and (w == w[0]).all():  # all runs are one
        x0, w = x0[:1], w[:1]
    driver = Driver(controller, len(x0), problem.model.nu, disturbances=np.zeros((len(x0), 0, 0)), recorded=False)
    sample = iter(range(problem.steps * 2))
    least, most = problem.input_bounds_at(p.numpy())
    beyond: list[float] = []

    def law(x: Tensor) -> Tensor:
        """Inputs (n, nu)."""
        u = np.asarray(driver(next(sample), x.numpy()), dtype=float)
        if u.shape != (len(x), len(least)):
            raise InputError("controller", f"inputs of shape {u.shape}", f"({len(x)}, {len(least)})")
        driver.remember(u)
        excess = np.maximum(least - u, u - most) / (most - least) * 2
        beyond.append(float(np.max(excess, initial=0.0, where=np.isfinite(excess))))
        return x.new_tensor(u)

    with torch.no_grad():
        seen = simulated(Stepper.at(in_double(problem), p), law, (x0, w), depths=True)
    limits = measured(seen)
    total, lost = (np.repeat(value.numpy(), n // len(x0)) for value in (seen.total, seen.diverged))
    errors = measurement_errors(seen).values()
    return ClosedLoopReturns(total, lost, limits.fraction, limits.depth, problem.risk, errors, max(beyond))


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


class Pairs:
    """Differences of results to the reference on shared scenarios."""

    def __init__(self, problem: CoDesignProblem, seed: int, reference: CoDesignResult) -> None:
        self.problem = problem
        self.seed = seed
        self.reference = reference
        assert reference.closed_loop is not None
        mean = reference.closed_loop.summary.mean
        self.size = float(problem.made_by_control(mean, reference.design)) or 1.0
        self._seen: dict[Any, ClosedLoopReturns] = {}

    def row(self, name: str, result: CoDesignResult) -> MethodRow:
        """Row of a result."""
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
        """Closed-loop returns of a result on its first `runs` scenarios."""
        assert result.closed_loop is not None
        if len(result.closed_loop.values) == runs:
            return result.closed_loop
        return self._measured((id(result), runs), result.controller, result.design, runs)

    def _lqr(self, design: Array, runs: int) -> ClosedLoopReturns | None:
        """Returns of a design's saturated LQR, None without one."""
        try:
            controller = saturated_lqr(self.problem, design)
        except MPCError:
            return None
        return self._measured((tuple(design), runs), controller, design, runs)

    def _measured(self, key: Any, controller: Any, design: Array, runs: int) -> ClosedLoopReturns:
        """Returns on the scenarios of `codesign`, measured once each."""
        if key not in self._seen:
            drawn = scenarios_of(self.seed)
            self._seen[key] = closed_loop_returns(self.problem, controller, design, drawn, runs=runs)
        return self._seen[key]


def scenarios_of(seed: int) -> np.random.Generator:
    """Generator of the scenarios that `codesign` measures on."""
    return np.random.default_rng(seed).spawn(1)[0]
