"""A co-design problem: a model, its limits, its objective and the scenarios it is judged on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ccdtools.arrays import Array, ArrayField
from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.disturbances.disturbance import Disturbance
from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.discretisation import LinearModel
from ccdtools.twin.twin import Discrepancy
from invariant_sets import Polytope

DIVERGENCE = 1e3  # a run is lost when a state exceeds this many half-widths of X


class Scenarios(Protocol):
    """Anything that draws initial states with their disturbances."""

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Initial states (runs, nx) and disturbances (runs, steps, nw)."""
        ...


@dataclass(frozen=True, eq=False)
class FixedStart:
    """Every run from one state `x0` (nx,), with fresh disturbances."""

    x0: ArrayField
    disturbance: Disturbance

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Initial states (runs, nx) and disturbances (runs, steps, nw)."""
        return np.tile(np.asarray(self.x0, dtype=float), (runs, 1)), self.disturbance.sample(runs, steps, rng)


@dataclass(frozen=True, eq=False)
class CoDesignProblem:
    """What is to be designed, and how a design and its policy are judged.

    Parameters
    ----------
    model : LinearModel
        x⁺ = A(p) x + B(p) u + E(p) w.
    X, U : Polytope
        State and input limits; both bounded, U a box. Leaving X is counted, it does not end an episode.
    objective : QuadraticObjective
    scenarios : Scenarios
        Initial states and disturbances of the episodes.
    steps : int
        Length of an episode.
    discrepancy : Discrepancy, optional
        What a digital twin has learned; it replaces the model's disturbance.

    Raises
    ------
    InputError
        If the dimensions disagree, X or U is unbounded, or U is not a box.
    """

    model: LinearModel
    X: Polytope
    U: Polytope
    objective: QuadraticObjective
    scenarios: Scenarios
    steps: int = 100
    discrepancy: Discrepancy | None = None

    def __post_init__(self) -> None:
        model = self.model
        if model.design is None:
            raise InputError("model: got one without design parameters, expected a plant with a DesignSpace.")
        for name, polytope, n in (("X", self.X, model.nx), ("U", self.U, model.nu)):
            if polytope.dim != n:
                raise InputError(f"{name}: got dimension {polytope.dim}, expected {n}.")
            if not np.isfinite(np.concatenate(polytope.bounding_box())).all():
                raise InputError(f"{name}: got an unbounded set, expected a bounded one.")
        if len(self.U.minimal().b) != 2 * model.nu or (np.count_nonzero(self.U.minimal().A, axis=1) != 1).any():
            raise InputError("U: got a set that is not a box, expected independent bounds on each input.")
        for name, size, n in (("Q", len(self.objective.Q), model.nx), ("R", len(self.objective.R), model.nu)):
            if size != n:
                raise InputError(f"{name}: got shape ({size}, {size}), expected ({n}, {n}).")
        if self.steps < 1:
            raise InputError(f"steps: got {self.steps}, expected at least 1.")

    @property
    def design(self) -> DesignSpace:
        """The box of designs."""
        assert self.model.design is not None
        return self.model.design

    @property
    def input_bounds(self) -> tuple[Array, Array]:
        """Lower and upper input bounds, each (nu,)."""
        return self.U.bounding_box()

    @property
    def state_scale(self) -> Array:
        """Largest |x| per state within X, (nx,)."""
        return np.max(np.abs(self.X.bounding_box()), axis=0)

    @property
    def limit(self) -> Array:
        """Divergence limit on |x|, (nx,)."""
        return DIVERGENCE * self.state_scale

    @property
    def observation_bounds(self) -> tuple[Array, Array]:
        """Range of the observation (x, p), each (nx + np,)."""
        scale = self.state_scale
        return np.r_[-scale, self.design.lower], np.r_[scale, self.design.upper]
