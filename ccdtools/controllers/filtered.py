"""Controllers behind a filter that keeps states in a set."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array
from ccdtools.controllers.controllers import Controller, as_states
from ccdtools.controllers.signals import Around, as_controller, needs_of
from ccdtools.exceptions import InputError
from ccdtools.tolerances import CHANGED_INPUT
from ccdtools_ground.door import as_instance
from invariant_sets import AdmissibleInputs


@dataclass
class FilterCounts:
    """Counts of what a filter has done, shared with its copies in simulations.

    Attributes
    ----------
    inputs : int
        Inputs that passed through it.
    changed : int
        Of these, those that it changed.
    helpless : int
        Of these, those for which no input keeps the next state in the set; the least harmful one was taken.
    """

    inputs: int = 0
    changed: int = 0
    helpless: int = 0

    def add(self, changed: Any, admissible: Any) -> None:
        """Count one call."""
        self.inputs += len(changed)
        self.changed += int(changed.sum())
        self.helpless += int((~admissible).sum())

    def __deepcopy__(self, memory: Any) -> FilterCounts:
        return self

    def __str__(self) -> str:
        share = self.changed / self.inputs if self.inputs else 0.0
        return f"{self.changed} of {self.inputs} inputs changed ({share:.1%}), {self.helpless} had no admissible one"


@dataclass(frozen=True, eq=False, repr=False)
class Filtered(Around):
    """Admissible input nearest to another controller's, with counts of the changes.

    It asks for what the other asks for (reference, preview, last input, output) and has its memory and its design, so
    it stands wherever the other does: in `simulate`, `compare` and `deploy`. The last input that the other is told is
    the one that was applied.

    Parameters
    ----------
    controller : callable
        u = controller(x), batched; see `ccdtools.controllers.controllers`.
    admissible : AdmissibleInputs
        Of the model at the same design, for example `admissible_inputs(problem, design)`.

    Raises
    ------
    InputError
        If one is of another kind.

    References
    ----------
    Wabersich, Zeilinger (2018), Linear model predictive safety certification for learning-based control, CDC.

    Examples
    --------
    >>> safe = Filtered(result.policy, admissible_inputs(problem, result.design))
    >>> run = simulate(plant, safe, x0=x0, steps=100, design=result.design)
    >>> print(safe.counts)
    """

    passed_on: ClassVar[tuple[str, ...]] = ("needs", "horizon", "design", "reset", "agent", "loop")
    controller: Controller
    admissible: AdmissibleInputs
    _counts: FilterCounts = field(default_factory=FilterCounts, kw_only=True)

    def __post_init__(self) -> None:
        self._set(controller=as_controller(self.controller))
        needs_of(self.controller)
        cure = "Use admissible_inputs(problem, design)."
        as_instance("admissible", self.admissible, AdmissibleInputs, "an AdmissibleInputs", cure)

    def __repr__(self) -> str:
        return f"Filtered({self.controller!r}, {self.admissible!r})"

    @property
    def counts(self) -> FilterCounts:
        """Counts since the filter was made, over all simulations."""
        return replace(self._counts)

    def uncounted(self) -> Filtered:
        """Copy with counts of its own."""
        return Filtered(copy.deepcopy(self.controller), self.admissible)

    def __call__(self, x: ArrayLike, **signals: Any) -> Array:
        """Admissible inputs (n, nu) or (nu,), NaN where the state is."""
        nx = self.admissible.S.dim
        states = as_states(x, nx)
        proposed = np.asarray(self.controller(states, **signals), dtype=float)
        shape = (*states.shape[:-1], self.admissible.U.dim)
        if proposed.shape != shape:
            raise InputError("controller", f"inputs of shape {proposed.shape}", f"{shape}")
        rows = states.reshape(-1, nx)
        wanted = proposed.reshape(len(rows), -1)
        known = np.isfinite(rows).all(axis=1) & np.isfinite(wanted).all(axis=1)
        u = wanted.copy()
        if known.any():
            u[known], admissible = self.admissible.project(rows[known], wanted[known])
            lower, upper = self.admissible.U.bounding_box()
            changed = (np.abs(u[known] - wanted[known]) > CHANGED_INPUT * (upper - lower)).any(axis=1)
            self._counts.add(changed, admissible)
        return u.reshape(shape)
