"""Result of a co-design by learning, with agent and history."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np

from ccdtools.arrays import Array, ArrayField, Immutable, frozen
from ccdtools.co_design.result import CoDesignResult
from ccdtools.co_design.tolerances import BLIND_SHARE, LEVEL_SLOPE, SIGNIFICANT, TRUSTED_SLOPE
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.statistics import PairedDifference
from ccdtools_ground.door import as_vector
from learning.networks import ActorCritic

ROWS = (
    ("finite differences", "finite_difference"), ("pathwise", "pathwise"), ("network input (paper)", "network_input"),
)  # fmt: skip
EARNED = {"design": "by moving the design under the first policy", "policy": "by learning"}


@dataclass(frozen=True, eq=False, repr=False)
class GradientCheck(Immutable):
    """Design gradients (np,) of the mean return, per unit-box length.

    Attributes
    ----------
    names : tuple of str
    finite_difference : array
        Central differences under common random numbers: the reference.
    pathwise : array
        Backpropagation through dynamics, policy and reward.
    network_input : array
        The paper's: through the networks' inputs of the PPO loss, the states taken as constants; NaN where it was not
        asked for.
    finite_difference_error, pathwise_error : array
        Standard errors over the runs.
    deviation_error : array
        Standard error of the difference between pathwise and finite differences, run by run.
    scale : float
        |mean return| without the cost of the design.
    blind : float
        Share of the runs without any pathwise gradient, where it is one of a policy.
    """

    names: tuple[str, ...]
    finite_difference: Array
    pathwise: Array
    network_input: ArrayField = np.nan
    finite_difference_error: ArrayField = 0.0
    pathwise_error: ArrayField = 0.0
    deviation_error: ArrayField = 0.0
    scale: float = 0.0
    blind: float = 0.0

    def __post_init__(self) -> None:
        size = len(self.names)
        for column in fields(self)[1:-2]:
            value = np.broadcast_to(np.asarray(getattr(self, column.name), dtype=float), (size,)).copy()
            object.__setattr__(self, column.name, frozen(value))

    def __repr__(self) -> str:
        known = (method for _, method in ROWS[1:] if np.isfinite(getattr(self, method)).all())
        cosines = (f"{method} {self.cosine(method):.3f}" for method in known)
        verdict = "trusted" if self.trusted else "not trusted"
        return f"GradientCheck(cosine with finite differences: {', '.join(cosines)}; pathwise {verdict})"

    def cosine(self, method: str) -> float:
        """Cosine between a method's gradient and the finite differences."""
        a = getattr(self, method)
        b = self.finite_difference
        return float(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), np.finfo(float).tiny))

    def length(self, method: str) -> float:
        """Length of a method's gradient relative to the finite differences'."""
        reference = max(float(np.linalg.norm(self.finite_difference)), np.finfo(float).tiny)
        return float(np.linalg.norm(getattr(self, method))) / reference

    @property
    def trusted(self) -> bool:
        """Whether pathwise gradient and finite differences agree in length and direction.

        The difference of the two vectors is at most a fifth of the reference's length, beyond three standard errors and
        a slope that does not matter. With one parameter, that is length and sign.
        """
        if not (np.isfinite(self.pathwise).all() and np.isfinite(self.finite_difference).all()):
            return False
        deviation = np.linalg.norm(self.pathwise - self.finite_difference)
        errors = (np.linalg.norm(self.deviation_error), np.linalg.norm(self.finite_difference_error))
        length = np.linalg.norm(self.finite_difference)
        allowed = TRUSTED_SLOPE * length + SIGNIFICANT * min(errors) + LEVEL_SLOPE * self.scale
        return bool(deviation <= allowed)

    @property
    def astray(self) -> str:
        """Why the gradient of a policy does not lead; empty where it may."""
        if self.blind > BLIND_SHARE:
            return f"the policy has no gradient in {self.blind:.0%} of the runs"
        return "" if self.trusted else "the gradient of the policy is not that of its return, beyond chance"

    def __str__(self) -> str:
        rows = [f"{'design gradient (unit box)':<28}" + "".join(f"{name:>24}" for name in self.names)
                + "     cosine     length"]  # fmt: skip
        for label, method in ROWS:
            if np.isnan(getattr(self, method)).all():
                continue
            errors = getattr(self, f"{method}_error", None)
            columns = [f"{value:.5g}" for value in getattr(self, method)]
            if errors is not None:
                columns = [f"{value} ± {error:.2g}" for value, error in zip(columns, errors)]
            values = "".join(f"{value:>24}" for value in columns)
            rows.append(f"{label:<28}{values}{self.cosine(method):11.3f}{self.length(method):11.3g}")
        if not self.trusted:
            rows.append("the pathwise gradient differs from finite differences by more than chance")
        return "\n".join(rows)


@dataclass(frozen=True, eq=False, repr=False)
class Convergence(Immutable):
    """Evidence that a status rests on.

    Attributes
    ----------
    gain : PairedDifference
        Of the last block, on the fixed evaluation scenarios.
    slope, slope_error : (np,) arrays
        Projected design gradient at the end by finite differences per unit-box length, and its standard error; zero
        where the design is frozen, or at a bound that the return rises across.
    by_differences : bool
        Whether the design moved along finite differences, because the gradient through the model was wrong.
    blocks, iterations : int
        Of the start that won.
    """

    gain: PairedDifference
    slope: Array
    slope_error: Array
    by_differences: bool
    blocks: int
    iterations: int

    def __post_init__(self) -> None:
        for name in ("slope", "slope_error"):
            self._set(**{name: as_vector(name, np.nan_to_num(getattr(self, name)))})

    def __repr__(self) -> str:
        return f"Convergence({self.iterations} iterations, last block {self.gain.mean:+.3g})"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class LearnedCoDesign(CoDesignResult):
    """Best iterate of the best start of a co-design by learning.

    Attributes
    ----------
    agent : ActorCritic
    gradients : GradientCheck or None
        Before its first move; None when the design is frozen.
    policy_gradients, first_policy_gradients : GradientCheck or None
        Slopes of the policy handed out, and of the one that it began with, along a few random changes of the last
        layer; None where nothing was settled, or the policy does not follow them.
    gains : dict
        What did the work, in units of the return: "design" is the gain of the first policy from the given design to the
        one found, where it may move, "policy" the gain of the policy found over the first one there.
    convergence : Convergence or None
    memory : callable, optional
        What stands around a policy of measured outputs, a `History` or `Observed`; None where it sees the state.
    """

    agent: ActorCritic
    gradients: GradientCheck | None = None
    policy_gradients: GradientCheck | None = None
    first_policy_gradients: GradientCheck | None = None
    gains: dict[str, float] = field(default_factory=dict)
    convergence: Convergence | None = None
    memory: Callable[[LearnedPolicy], Any] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        policy = LearnedPolicy(self.agent, self.design)
        self._set(controller=policy if self.memory is None else self.memory(policy))

    @property
    def policy(self) -> LearnedPolicy:
        """Policy at the design found, as a controller."""
        policy = self.controller if self.memory is None else getattr(self.controller, "controller", None)
        assert isinstance(policy, LearnedPolicy)
        return policy

    def _values(self) -> dict[str, Any]:
        """Status and its evidence as plain values."""
        convergence = None if self.convergence is None else asdict(self.convergence)
        return super()._values() | {"gains": dict(self.gains), "convergence": convergence}

    def _ended(self) -> list[str]:
        """Status and gains of each part, one line each."""
        ended = "" if self.convergence is None else f" after {self.convergence.iterations} iterations"
        lines = [f"{self.method}: {self.status.value}{ended}. {self.status.advice}"]
        if self.gains:
            parts = (f"{gain:+.4g} {EARNED[part]}" for part, gain in self.gains.items())
            lines.append(f"gain on the model: {', '.join(parts)}")
        return lines + self._of_loop()

    def _remarks(self) -> list[str]:
        """Other remarks, one line each."""
        first, told = self.first_policy_gradients, []
        if first is not None and first.astray:
            told.append(f"at the first design {first.astray}")
        if self.convergence is not None and self.convergence.by_differences:
            told.append("the design followed finite differences: the gradient through the model was wrong")
        return told + super()._remarks()
