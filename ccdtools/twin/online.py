"""How a policy is updated while it is deployed."""

from __future__ import annotations

from dataclasses import dataclass, field

from ccdtools.arrays import Immutable
from ccdtools.checks import as_count, as_flag, as_instance, as_number, as_share
from ccdtools.co_design.configuration import CoDesignConfig
from ccdtools.statistics import PairedDifference

ONLINE_TRAINING = CoDesignConfig(
    iterations=20, pathwise_runs=256, design_rate=0.0, policy_rate=3e-4, evaluate_every=5, evaluation_runs=200
)


@dataclass(frozen=True)
class OnlineConfig:
    """How a policy is updated while it is deployed.

    Attributes
    ----------
    updates : int
        Updates, evenly spread over the deployment; 0 keeps the policy as it is.
    window : int
        Length of a replayed episode.
    held_out : float
        Last fraction of every part of the log, on which a candidate is judged.
    judged : int
        Largest number of runs of that judgement, where several are deployed; where runs are recombined, about their
        number.
    least : float
        Part of the return in service, without the cost of the design, that an update has to bring; 0 for any gain
        beyond chance.
    recombine : bool
        Whether runs are recombined step by step where their errors do not depend on each other in time.
    training : CoDesignConfig
        Of the candidate; the design is frozen, whatever its `design_rate`, as the plant is built.
    """

    updates: int = 4
    window: int = 100
    held_out: float = 0.3
    judged: int = 400
    least: float = 0.001
    recombine: bool = True
    training: CoDesignConfig = field(default_factory=lambda: ONLINE_TRAINING)

    def __post_init__(self) -> None:
        for name, least in (("updates", 0), ("window", 1), ("judged", 2)):
            as_count(name, getattr(self, name), least=least)
        as_share("held_out", self.held_out)
        as_number("least", self.least, expected="a fraction from 0 to 1", low=0.0, high=1.0)
        as_flag("recombine", self.recombine)
        as_instance("training", self.training, CoDesignConfig, "a CoDesignConfig")


@dataclass(frozen=True, eq=False)
class OnlineUpdate(Immutable):
    """One attempt to improve the policy in service.

    Attributes
    ----------
    after : int
        Samples logged before it.
    gain : PairedDifference
        Return of the candidate minus that of the policy in service, in the problem's risk, on the held-out parts: of
        all held-out stretches of a single run (the interval is of their series); of a run where several are deployed
        (of the mean over the runs, or over blocks of them where they were recombined).
    accepted : bool
        Whether the interval of the gain lies above zero, on the updated model too, the gain matters, and the limits are
        kept as far as is granted.
    updated_gain : PairedDifference or None
        The same on the model that former deployments have taught, with what it leaves unexplained replayed; NaN where
        more runs of the candidate diverge. None where there is no such model, or the update is not accepted anyway.
    breach : str
        How the candidate breaks the limits on the logged errors where what is in service keeps them; empty where it
        does not, or the update is not accepted anyway.
    """

    after: int
    gain: PairedDifference
    accepted: bool
    updated_gain: PairedDifference | None = None
    breach: str = ""
