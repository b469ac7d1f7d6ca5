"""Settings and results of policy updates during deployment."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from ccdtools.arrays import Immutable
from ccdtools.co_design.configuration import CoDesignConfig
from ccdtools.evidence.switchback import Trial, TrialStatus
from ccdtools.evidence.verdict import Verdict
from ccdtools.statistics import PairedDifference
from ccdtools.tolerances import NOT_WORSE
from ccdtools.twin.distributions import UPDATED
from ccdtools.twin.trial import TrialConfig
from ccdtools_ground.door import as_count, as_instance, as_number, as_share
from learning.networks import ActorCritic
from learning.quantile import QuantileConfig

ONLINE_TRAINING = CoDesignConfig(
    iterations=20, pathwise_runs=256, design_rate=0.0, policy_rate=3e-4, evaluate_every=5, evaluation_runs=200
)


@dataclass(frozen=True)
class OnlineConfig:
    """Settings of the policy updates during a deployment.

    Attributes
    ----------
    updates : int
        Updates, evenly spread over the deployment; 0 keeps the policy as it is.
    window : int
        Length of a replayed episode.
    held_out : float
        Last fraction of every part of the log, on which a candidate is judged.
    judged : int
        Largest number of runs of that judgement, where several are deployed.
    least : float
        Part of the deployed return, without the cost of the design, that an update has to bring; 0 for any gain
        beyond chance.
    accept_loss : float
        Part of the return that an update may lose on a distribution that it was not made for.
    training : CoDesignConfig
        Of the candidate; the design is frozen, whatever its `design_rate`, as the plant is built.
    quantile : QuantileConfig
        Of the discrepancy that a candidate is judged on; its median alone is fitted.
    trial : TrialConfig, optional
        A candidate that is accepted on the replayed logs takes turns with the deployed policy on the real plant, and
        replaces it only if that trial adopts it. By default it replaces it at once.
    """

    updates: int = 4
    window: int = 100
    held_out: float = 0.3
    judged: int = 400
    least: float = 0.001
    accept_loss: float = NOT_WORSE
    training: CoDesignConfig = field(default_factory=lambda: ONLINE_TRAINING)
    quantile: QuantileConfig = field(default_factory=QuantileConfig)
    trial: TrialConfig | None = None

    def __post_init__(self) -> None:
        for name, least in (("updates", 0), ("window", 1), ("judged", 2)):
            as_count(name, getattr(self, name), least=least)
        as_share("held_out", self.held_out)
        for name in ("least", "accept_loss"):
            as_number(name, getattr(self, name), expected="a fraction from 0 to 1", low=0.0, high=1.0)
        as_instance("training", self.training, CoDesignConfig, "a CoDesignConfig")
        as_instance("quantile", self.quantile, QuantileConfig, "a QuantileConfig")
        if self.trial is not None:
            as_instance("trial", self.trial, TrialConfig, "a TrialConfig or None")


@dataclass(frozen=True, eq=False)
class OnlineUpdate(Immutable):
    """One attempt to improve the deployed policy.

    Attributes
    ----------
    after : int
        Samples logged before it.
    verdict : Verdict
        On the held-out parts of the log, and on every other distribution that the policy serves.
    agent : ActorCritic
        Candidate.
    trial : Trial, optional
        Of a candidate that the verdict accepts, on the real plant.
    ended : int
        Samples logged before the end of its trial, so far.
    """

    after: int
    verdict: Verdict
    agent: ActorCritic
    trial: Trial | None = None
    ended: int = 0

    @property
    def accepted(self) -> bool:
        """Whether the candidate replaced the policy."""
        return self.verdict.replaces and (self.trial is None or self.trial.status is TrialStatus.ADOPTED)

    @property
    def changes(self) -> tuple[int, ...]:
        """Samples logged before the policy changed: before the update, or before and after its trial."""
        if self.trial is not None:
            return (self.after, self.ended)
        return (self.after,) if self.accepted else ()

    @property
    def gain(self) -> PairedDifference:
        """Return of the candidate minus the deployed policy's, on held-out parts."""
        return self.verdict.gain

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for results.json."""
        updated = self.verdict.on(UPDATED)
        gains = {"gain": vars(self.gain), "updated_gain": None if updated is None else vars(updated.gain)}
        tried = {} if self.trial is None else {"trial": self.trial.as_dict(), "changes": self.changes}
        return {"after": self.after, "accepted": self.accepted} | gains | self.verdict.as_dict() | tried
