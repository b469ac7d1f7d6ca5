"""Paths by quadratic programs, each from the one before."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from mpc.budgets import PROGRAMS_TO_GO
from mpc.checks import Array
from mpc.optimal_control.local_statement import Local, Multipliers
from mpc.optimal_control.planning import Clock
from mpc.optimal_control.sqp import Step, next_step
from mpc.tolerances import KKT, OPTIMAL, VIOLATION_PRICE

REAL_TIME, CONVERGING = "real-time iteration", "SQP"


@dataclass(frozen=True, eq=False)
class Path:
    """States (N + 1, nx) and inputs (N, nu), with the program there."""

    states: Array
    inputs: Array
    gains: Array | None = None  # (N, nu, nx): of a feedback along it
    name: str = CONVERGING
    multipliers: Multipliers | None = None  # for the Hessian of the program
    last: Step | None = None

    @property
    def error(self) -> float:
        """Larger of gaps and stationarity, infinite without a program."""
        return np.inf if self.last is None else self.last.error

    @property
    def newton(self) -> bool:
        """Whether the Hessian of its program is the Lagrangian's."""
        return self.last is not None and self.last.program.of is not None

    @property
    def balanced(self) -> Multipliers | None:
        """Multipliers after its program; a real-time iteration has no use for them."""
        return None if self.last is None or self.name == REAL_TIME else self.last.multipliers

    @property
    def solved(self) -> bool:
        """Whether the optimality conditions hold."""
        return self.error <= OPTIMAL

    @property
    def falls(self) -> bool:
        """Whether its program tells of a saddle."""
        return self.last is not None and self.last.falls

    @property
    def falling(self) -> tuple[Array, Array]:
        """Moves along which the cost falls at a saddle."""
        return (0 * self.states, 0 * self.inputs) if self.last is None else self.last.falling

    @property
    def moved(self) -> Path:
        """Path after the step of its program."""
        if self.last is None:
            return self
        states = self.states + self.last.states[:, : self.states.shape[1]]
        return replace(self, states=states, inputs=self.inputs + self.last.inputs, multipliers=self.balanced)


def programs(at: Path, stated: Callable[[Array, Array], Local], clock: Clock, *, dear: float | None = None,
             times: float = 1.0) -> Iterator[Path]:  # fmt: skip
    """Paths, each moved by the program at the one before, in time.

    `stated` is the statement at states and inputs. For `dear` and `times` see `next_step`; by default violations are
    priced by the largest slope of the cost at the first path.
    """
    while at.last is None or not clock.up:
        local = stated(at.states, at.inputs)
        dear = VIOLATION_PRICE * local.force if dear is None else dear
        relaxed = at.last is not None and at.last.relaxed
        step = next_step(local, dear, relaxed=relaxed, times=times, multipliers=at.multipliers, last=at.last)
        if step is None or not (np.isfinite(step.inputs).all() and np.isfinite(step.states).all()):
            return
        at = replace(at, gains=step.gains, last=step)
        yield at
        at = at.moved


def while_newton(paths: Iterator[Path]) -> Iterator[Path]:
    """Paths until `PROGRAMS_TO_GO` had other Hessians, by which errors fall linearly at best."""
    left = PROGRAMS_TO_GO
    for one in paths:
        left -= not one.newton
        if left < 0:
            return
        yield one


def contracted(paths: Iterator[Path], most: int) -> Path | None:
    """Best of so many paths by programs with full steps, None without any.

    They end at the optimum, or where their error is not halved within `PROGRAMS_TO_GO`.
    """
    best: Path | None = None
    half, left = np.inf, PROGRAMS_TO_GO
    for one in islice(paths, most):
        best = one if best is None or one.error < best.error else best
        nearer = one.error <= half
        half, left = (one.error / 2, PROGRAMS_TO_GO) if nearer else (half, left - 1)
        if one.error <= KKT or not left:
            break
    return best
