"""Cost of the design alone, and ends of its searches."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.limits import LimitsOutcome
from ccdtools.co_design.methods.descent import Descent, descend, value_of
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import CoDesignResult, History
from ccdtools.controllers.controllers import Controller
from ccdtools.exceptions import InputError

HistoryRow = tuple[int, int, Array, float, float, float]


@dataclass(frozen=True, eq=False)
class End:
    """End of the search from one start.

    Attributes
    ----------
    cost : DesignCost
    found : Descent
    size : float
        Part of the return that control makes: what gains are compared with.
    violation : float
        Excess over the tolerance of the limits.
    limits : LimitsOutcome or None
    active : mapping
        Slopes (np,) of the violations of active limits, by name.
    """

    cost: DesignCost
    found: Descent
    size: float
    violation: float = 0.0
    limits: LimitsOutcome | None = None
    active: Mapping[str, Array] = field(default_factory=dict)

    @property
    def order(self) -> tuple[float, float]:
        """Violation, then cost; the best end has least."""
        return (self.violation, self.found.cost)


class DesignCost(ABC):
    """Cost (minus a return) over the unit box, with slope and controller.

    Attributes
    ----------
    problem : CoDesignProblem
    rows : list
        Row of the history for every evaluation.
    slope_is_expensive : bool
        Whether a value alone costs much less than a value with its slope; then `value` and `slope` give either.
    repeatable : bool
        Whether the same point has the same cost again.
    """

    problem: CoDesignProblem
    rows: list[HistoryRow]
    slope_is_expensive = False
    repeatable = True

    @property
    @abstractmethod
    def words(self) -> str:
        """Name of the cost in tables."""

    @abstractmethod
    def __call__(self, v: Array) -> tuple[float, Array]:
        """Cost and slope (np,) at a point (np,); infinite without a controller."""

    @abstractmethod
    def controller(self, p: Array) -> Controller:
        """Controller of a design, for use."""

    @property
    def evaluations(self) -> int:
        """Number of evaluations."""
        return len(self.rows)

    def worth_a_start(self, v: Array) -> bool:
        """True if a cheap evaluation allows a search from a point."""
        return True

    def first_point(self, v: Array) -> tuple[Array, float]:
        """Point to search from, and its cost."""
        return v, value_of(self, v)

    def least(self, v: Array, *, size: float, evaluations: int) -> End:
        """End of a search from a point."""
        return End(self, descend(self, self.problem.design, v, size=size, evaluations=evaluations), size)

    def examined(self, end: End) -> End:
        """Best end with its limits, once known."""
        return end

    def without_design(self, name: str, v: Array) -> CoDesignResult:
        """Explanation where no start has a cost."""
        space = self.problem.design
        got = f"{space.describe(space.settled(v))} to start from, where there is nothing to search by: {self.words}"
        cure = "Start from a design that can be stabilised and whose runs keep the limits, or check the weights."
        raise InputError("design", got, "a design with a controller", cure)

    def history(self) -> History:
        """Record of all evaluations so far."""
        return History(*(np.array(column) for column in zip(*self.rows)))
