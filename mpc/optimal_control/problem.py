"""Optimal control problem: phases, links and shared parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools_ground.door import as_choice, as_number, as_vector
from mpc.checks import Array, as_array
from mpc.exceptions import InputError
from mpc.optimal_control.bounds import Bounds, as_bounds, as_names, check_within, middle
from mpc.optimal_control.functions import Statement, brief, compiled
from mpc.optimal_control.phase import Phase, PhaseFunctions

RISKS = ("sum", "worst", "spread")


@dataclass(frozen=True, eq=False)
class OptimalControlProblem:
    """Linked phases or parallel scenarios with shared parameters.

    Parameters
    ----------
    phases : Phase or sequence of Phase
    p_bounds : (lower, upper), optional
        Of the shared parameters p, each (np,); no parameters by default. Equal bounds give one.
    p_guess : (np,) array, optional
    p_cost : function of p, optional
        What parameters cost, beside the phases.
    p_constraints : function of p, optional
        g(p) ≤ 0.
    linked : bool
        Whether each phase begins where and when the one before it ends; if not they are scenarios.
    link : function of x, p, t, or a list of them, optional
        The state that a phase begins with, of the one that the phase before ended with, and when; the same by default.
        A list has one for each phase but the first; None in it is the default.
    weights : sequence of float, optional
        Of the costs of the phases; 1 each by default when linked, else equal parts of 1.
    risk : "sum", "worst" or "spread"
        Whether costs of scenarios are summed with their weights, or the largest counts; or their mean and `spread`
        times their standard deviation. Where a cheap scenario would be made dearer to bring it nearer to the others, it
        counts as dear as that would be, and is left alone (the monotone hull of the measure). It is the worst case, and
        solved as such, where w (1 + spread²) ≥ 1 for the least part w that a weight has in their sum.
    spread : float
    p_names, p_constraint_names : sequence of str, optional
        What conflicts and advice call the parameters and the values of `p_constraints`: "p1", "p_constraints 1", …

    Raises
    ------
    InputError
        If a function of any phase or of the parameters cannot be meant, or bounds cross, or sizes do not fit.
    """

    phases: Any
    p_bounds: Bounds = None
    p_guess: ArrayLike | None = None
    p_cost: Statement | None = None
    p_constraints: Statement | None = None
    linked: bool = True
    link: Any = None
    weights: Any = None
    risk: str = "sum"
    spread: float = 1.0
    p_names: Sequence[str] = ()
    p_constraint_names: Sequence[str] = ()

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        given = [self.phases] if isinstance(self.phases, Phase) else self.phases
        if not isinstance(given, list | tuple) or not given or not all(isinstance(phase, Phase) for phase in given):
            raise InputError("phases", brief(repr(self.phases)), "a Phase, or a list of them")
        set_(self, "phases", _on_one_clock(given) if self.linked else tuple(given))
        set_(self, "p_bounds", as_bounds("p_bounds", self.p_bounds, None))
        set_(self, "p_guess", self._as_guess())
        count = len(self.phases)
        usual = np.ones(count) if self.linked else np.full(count, 1 / count)
        weights = as_array("weights", usual if self.weights is None else self.weights, (count,))
        if (weights < 0).any():
            raise InputError("weights", brief(repr(self.weights)), f"{count} numbers ≥ 0, one a phase")
        if self.risk == "worst" and np.ptp(weights) > 0:
            raise InputError("weights", weights, 'none with risk="worst": the largest cost counts, whatever its weight')
        set_(self, "weights", weights)
        as_choice("risk", self.risk, RISKS)
        if self.risk != "sum" and self.linked and count > 1:
            raise InputError("risk", f'"{self.risk}" of phases that are linked', '"sum", or linked=False')
        if self.risk == "spread" and not weights.any():
            raise InputError("weights", weights, "numbers ≥ 0, not all of them 0")
        set_(self, "spread", as_number("spread", self.spread, expected="a number ≥ 0", low=0.0))
        sizes = [phase.states for phase in self.phases]
        links = list(self.link) if isinstance(self.link, list | tuple) else [self.link] * (count - 1)
        if any(link is not None for link in links) and not self.linked:
            raise InputError("link", "a function, with linked=False", "none: scenarios run side by side")
        if len(links) != count - 1:
            raise InputError("link", f"{len(links)} functions for {count} phases", "one for each phase but the first")
        set_(self, "link", tuple(links))
        if self.linked and any(link is None and a != b for link, a, b in zip(links, sizes, sizes[1:])):
            raise InputError(
                "link", f"phases of {sizes} states", "a link function from one phase's end to the next start"
            )
        _ = self.functions, self.link_functions
        constraints = self.of_parameters[1]
        set_(self, "p_names", as_names("p_names", self.p_names, "p", self.parameters))
        rows = 0 if constraints is None else constraints.numel_out(0)
        names = as_names("p_constraint_names", self.p_constraint_names, "p_constraints ", rows)
        set_(self, "p_constraint_names", names)

    def _as_guess(self) -> Array:
        """First guess of the parameters, within their bounds."""
        low, high = self.p_bounds
        if self.p_guess is None:
            return np.asarray(np.clip(np.nan_to_num(middle(low, high)), low, high))
        guess = as_vector("p_guess", self.p_guess, len(low))
        check_within("p_guess", guess, "p_bounds", self.p_bounds)
        return np.asarray(np.clip(guess, low, high))

    @property
    def parameters(self) -> int:
        """Number np of parameters."""
        return len(self.p_bounds[0])

    @cached_property
    def functions(self) -> tuple[PhaseFunctions, ...]:
        """Functions of every phase, checked."""
        found = []
        for k, phase in enumerate(self.phases):
            try:
                found.append(PhaseFunctions(phase, self.parameters))
            except InputError as error:
                if len(self.phases) == 1:
                    raise
                argument = f"{error.argument} of phase {k + 1}"
                raise InputError(argument, error.got, error.expected, error.cure) from error
        return tuple(found)

    @cached_property
    def of_parameters(self) -> tuple[ca.Function | None, ca.Function | None]:
        """Functions p → cost and p → constraints."""
        sizes = {"p": self.parameters}
        cost = None if self.p_cost is None else compiled("p_cost", self.p_cost, sizes, 1)
        return cost, None if self.p_constraints is None else compiled("p_constraints", self.p_constraints, sizes)

    @cached_property
    def link_functions(self) -> tuple[ca.Function | None, ...]:
        """Functions (x, p, t) → first state of each later phase, or None."""
        pairs = zip(self.link, self.phases, self.phases[1:])
        return tuple(
            None if link is None else compiled("link", link, {"x": a.states, "p": self.parameters, "t": 1}, b.states)
            for link, a, b in pairs
        )


def _on_one_clock(phases: Sequence[Phase]) -> tuple[Phase, ...]:
    """Linked phases, each with its start time where known."""
    found = list(phases)
    free = False
    for k in range(1, len(found)):
        before = found[k - 1]
        free = free or before.free_duration
        if not free:
            found[k] = replace(found[k], start_time=before.start_time + before.duration[0])
        elif found[k].signal is not None:
            raise InputError(
                "signal", f"one of phase {k + 1}, whose start is free", "one of a phase whose start is known"
            )
    return tuple(found)
