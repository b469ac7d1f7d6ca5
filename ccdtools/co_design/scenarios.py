"""Starts of runs with their disturbances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ccdtools.arrays import Array, ArrayField, Immutable
from ccdtools.design_limits import DesignLimits, widest
from ccdtools.disturbances.disturbance import NO_DISTURBANCE, Disturbance
from ccdtools.exceptions import InputError
from ccdtools_ground.door import as_vector, has_method
from invariant_sets import Polytope


class Scenarios(Protocol):
    """Anything that draws initial states with their disturbances.

    Where runs have a disturbance of any length that does not depend on their starts, it is an attribute `disturbance`.
    """

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Initial states (runs, nx) and disturbances (runs, steps, nw)."""
        ...


@dataclass(frozen=True, eq=False)
class FixedStart(Immutable):
    """Starts from one state `x0` (nx,), with fresh disturbances; none of a plant without w."""

    x0: ArrayField
    disturbance: Disturbance = NO_DISTURBANCE

    def __post_init__(self) -> None:
        self._set(x0=as_vector("x0", self.x0))
        has_method("disturbance", self.disturbance, "sample", "a disturbance, such as Gaussian([0.1])")

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Initial states (runs, nx) and disturbances (runs, steps, nw)."""
        return np.tile(self.x0, (runs, 1)), self.disturbance.sample(runs, steps, rng)

    def check_within(self, X: Polytope) -> None:
        """Raise an `InputError` if the start lies outside X."""
        if not X.contains(self.x0):
            raise InputError("scenarios.x0", f"{self.x0.tolist()}, which is outside X", "a state within X")

    def check_for(self, problem: Any) -> None:
        """Raise an `InputError` if no design has the start within X(p) and the limits of outputs."""
        self.check_within(widest(problem.X))
        designs = problem.design.spread()
        starts = np.tile(self.x0, (len(designs), 1))
        if isinstance(problem.X, DesignLimits) and not problem.X.contains(starts, designs).any():
            got = f"{self.x0.tolist()}, which is outside X at every design"
            raise InputError("scenarios.x0", got, "a state within X at some design")
        if problem.output_limits is not None:
            broken = problem.output_limits.broken_at(self.x0, problem.model.nu, designs)
            if all(broken):
                got = f"{self.x0.tolist()}, where {broken[0]} whatever the input and the design"
                raise InputError("scenarios.x0", got, "a state within the limits of the outputs")
