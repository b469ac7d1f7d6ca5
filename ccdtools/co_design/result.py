"""What a co-design returns: the design and policy found, and how they came about."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from ccdtools.arrays import Array, Immutable, frozen
from ccdtools.co_design.limits import LimitsOutcome
from ccdtools.controllers.learned import LearnedPolicy
from learning.networks import ActorCritic


@dataclass(frozen=True, eq=False, repr=False)
class GradientCheck(Immutable):
    """The design gradient of the mean return by each method, at one design, (np,) per unit-box length.

    Attributes
    ----------
    names : tuple of str
    finite_difference : array
        Central differences under common random numbers: the reference.
    pathwise : array
        Backpropagation through dynamics, policy and reward.
    network_input : array
        The paper's: through the networks' inputs of the PPO loss, the states taken as constants.
    """

    names: tuple[str, ...]
    finite_difference: Array
    pathwise: Array
    network_input: Array

    def __post_init__(self) -> None:
        for name in ("finite_difference", "pathwise", "network_input"):
            object.__setattr__(self, name, frozen(np.array(getattr(self, name), dtype=float)))

    def __repr__(self) -> str:
        cosines = (f"{method} {self.cosine(method):.3f}" for method in ("pathwise", "network_input"))
        return f"GradientCheck(cosine with finite differences: {', '.join(cosines)})"

    def cosine(self, method: str) -> float:
        """Cosine of the angle between a method's gradient and the finite differences."""
        a = getattr(self, method)
        b = self.finite_difference
        return float(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-300))

    def __str__(self) -> str:
        rows = [f"{'design gradient (unit box)':<28}" + "".join(f"{name:>14}" for name in self.names) + "     cosine"]
        for label, method in (
            ("finite differences", "finite_difference"),
            ("pathwise", "pathwise"),
            ("network input (paper)", "network_input"),
        ):
            values = "".join(f"{value:14.5g}" for value in getattr(self, method))
            rows.append(f"{label:<28}{values}{self.cosine(method):11.3f}")
        return "\n".join(rows)


@dataclass(frozen=True, eq=False, repr=False)
class History(Immutable):
    """The course of a co-design, one row per evaluation.

    Attributes
    ----------
    iteration, env_steps : (k,) arrays
    design : (k, np) array
    model_return, std, diverged : (k,) arrays
        Of the mean policy on the evaluation scenarios; mean over the runs that did not diverge.
    """

    iteration: Array
    env_steps: Array
    design: Array
    model_return: Array
    std: Array
    diverged: Array

    def __post_init__(self) -> None:
        for column in fields(self):
            object.__setattr__(self, column.name, frozen(np.array(getattr(self, column.name))))

    def __repr__(self) -> str:
        first = self.model_return[0]
        last = self.model_return[-1]
        return f"History({len(self.iteration)} evaluations, return {first:.4g} → {last:.4g})"


@dataclass(frozen=True, eq=False, repr=False)
class CoDesignResult(Immutable):
    """The best evaluated iterate, and how it came about.

    Attributes
    ----------
    design : (np,) array
    agent : ActorCritic
    active_bounds : dict
        Design parameters at a bound, with "lower" or "upper".
    history : History
    gradients : GradientCheck or None
        Before the first move; None when the design is frozen.
    limits : LimitsOutcome or None
        How often and how far X is left, beside what was granted; None where the limits were switched off.
    """

    design: Array
    agent: ActorCritic
    active_bounds: dict[str, str]
    history: History
    gradients: GradientCheck | None
    limits: LimitsOutcome | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "design", frozen(np.array(self.design, dtype=float)))

    def __repr__(self) -> str:
        bounds = ", ".join(f"{name} at its {side} bound" for name, side in self.active_bounds.items()) or "none"
        return f"CoDesignResult(design {self.design.tolist()}, active bounds: {bounds}, {self.history!r})"

    @cached_property
    def policy(self) -> LearnedPolicy:
        """The policy at the design found, as a controller."""
        return LearnedPolicy(self.agent, self.design)
