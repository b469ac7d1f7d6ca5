"""Task and iterates of a co-design."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.co_design.configuration import CoDesignConfig
from ccdtools.co_design.limits import LimitsOutcome, StateLimitPenalty
from ccdtools.co_design.problem import CoDesignProblem
from learning.networks import ActorCritic


@dataclass(frozen=True, eq=False)
class Task:
    """Objective of a co-design, with its settings."""

    problem: CoDesignProblem  # what the gradients come from
    judge: CoDesignProblem  # what iterates are scored on
    method: str  # "pathwise", "ppo" or "pathwise+ppo"
    config: CoDesignConfig
    limits: StateLimitPenalty | None = None
    begun: str = ""  # what is to be said of the policy that it begins with

    @property
    def pathwise(self) -> bool:
        """Whether the policy follows its gradient through the model."""
        return "pathwise" in self.method and self.config.policy_rate > 0

    @property
    def ppo(self) -> bool:
        """Whether the policy follows PPO."""
        return "ppo" in self.method

    @property
    def moves_policy(self) -> bool:
        """Whether anything moves the policy."""
        return self.pathwise or self.ppo

    @property
    def smooth(self) -> bool:
        """True if policy or design moves, by gradients through the model alone."""
        alone = self.method == "pathwise" and self.config.design_gradient == "pathwise"
        return alone and (self.pathwise or self.moving)

    @property
    def designing(self) -> bool:
        """Whether a design other than the given may be found."""
        return self.config.design_rate > 0 and bool(self.problem.design.free.any())

    @property
    def moving(self) -> bool:
        """Whether any entry of a start's design moves, apart from whole numbers."""
        return self.designing and bool(self.problem.design.allowed.free.any())


@dataclass(frozen=True, eq=False)
class Iterate:
    """Design and policy, with their results on the fixed scenarios."""

    v: Tensor
    agent: ActorCritic
    returns: Array  # (n,): of every evaluation run; a diverged one with its whole, huge cost
    violation: float  # by how much the tolerance of the state limits is exceeded
    lost: float  # fraction of the runs that diverged
    limits: LimitsOutcome | None = None  # how it keeps the state limits

    @property
    def score(self) -> float:
        """Mean return over the evaluation runs."""
        return float(self.returns.mean())

    def beats(self, other: Iterate) -> bool:
        """True if this iterate is preferred, by violation, then return."""
        if self.violation > 0 or other.violation > 0:
            return self.violation < other.violation
        return self.score > other.score
