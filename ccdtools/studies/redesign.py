"""Whether a redesign replaces what is in service."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccdtools.arrays import Array
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.plants.design_space import DesignSpace
from ccdtools.scenario import Scenario
from ccdtools.statistics import PairedDifference, paired_difference
from ccdtools.studies.evaluation import Evaluation
from ccdtools.trajectory import Trajectory
from ccdtools.twin.residuals import Residuals
from learning.networks import ActorCritic

WORTH_A_DESIGN = 0.005  # a design is moved for a gain of at least this fraction of the return,
WORTH_A_POLICY = 0.001  # and a policy replaced for this one: it costs nothing to build
SAME_DESIGN = 1e-3  # of the range of each parameter


@dataclass(frozen=True, eq=False)
class InService:
    """A policy together with the design that it controls."""

    agent: ActorCritic
    design: Array


@dataclass(frozen=True)
class RedesignDecision:
    """What a redesign would bring, and whether it is taken.

    Attributes
    ----------
    gain : PairedDifference
        Return of the redesign minus that of what is in service, on windows of the logged errors that share no sample.
    needed : float
        Smallest gain for which it is taken.
    nominal_before, nominal_after : float
        Return on the nominal model of what is in service, and of the redesign.
    moved : bool
        Whether the redesign has another design.
    accepted : bool
        Whether the interval of the gain lies above zero, the gain is worth the change, and no more runs diverge.
    """

    gain: PairedDifference
    needed: float
    nominal_before: float
    nominal_after: float
    moved: bool
    accepted: bool

    def describe(self, proposed: str) -> str:
        """The decision in one sentence; `proposed` says what was judged."""
        low, high = self.gain.ci95
        verdict = "taken" if self.accepted else "not taken, no gain beyond chance" if not low > 0 else "not taken"
        gain = f"gain {self.gain.mean:+.3g} [{low:.3g}, {high:.3g}] on the logged errors, {self.needed:.3g} needed"
        return f"{proposed} {verdict}: {gain}; nominal model {self.nominal_before:.4g} → {self.nominal_after:.4g}"


def judge_redesign(
    evaluation: Evaluation, candidate: InService, current: InService, logs: Sequence[Residuals]
) -> RedesignDecision:
    """The decision between a redesign and what is in service, both on the same windows of the logged errors.

    It is taken only for a gain whose 95 % interval excludes zero and that is worth it: half a per cent of the return if
    the design moves, a tenth if the policy alone changes; of the larger of the returns on the logged errors and on
    the nominal model. A log with hardly any disturbance says little, and the return on it is small: a fraction of that
    alone would move a design for nothing.
    """
    logged = evaluation.on_model(logs)
    nominal = evaluation.on_model(())
    after = _run(evaluation, candidate, logged)
    before = _run(evaluation, current, logged)
    nominal_after = _mean_return(evaluation, candidate, nominal)
    nominal_before = _mean_return(evaluation, current, nominal)
    kept = ~(after.diverged | before.diverged)
    returns_before = before.returns(evaluation.study.objective)[kept]
    gain = paired_difference(after.returns(evaluation.study.objective)[kept], returns_before)
    moved = not same_design(evaluation.problem.design, candidate.design, current.design)
    steps = logged.disturbance.shape[1] / nominal.disturbance.shape[1]
    sizes = [abs(nominal_before) * steps, abs(float(returns_before.mean())) if kept.any() else 0.0]
    needed = (WORTH_A_DESIGN if moved else WORTH_A_POLICY) * max(size for size in sizes if np.isfinite(size))
    safe = after.diverged.mean() <= before.diverged.mean()
    accepted = bool(safe and gain.ci95[0] > 0 and gain.mean >= needed)
    return RedesignDecision(gain, needed, nominal_before, nominal_after, moved, accepted)


def same_design(space: DesignSpace, one: Array, other: Array) -> bool:
    """Whether two designs differ by less than a thousandth of the range of every parameter."""
    return bool(np.abs(space.to_unit(one) - space.to_unit(other)).max() <= SAME_DESIGN)


def _run(evaluation: Evaluation, choice: InService, scenario: Scenario) -> Trajectory:
    """Closed-loop runs of a policy and its design."""
    policy = LearnedPolicy(choice.agent, choice.design)
    return scenario.run(policy, design=choice.design, limit=evaluation.problem.limit)


def _mean_return(evaluation: Evaluation, choice: InService, scenario: Scenario) -> float:
    """Mean return over the runs that do not diverge; NaN if all do."""
    run = _run(evaluation, choice, scenario)
    kept = run.returns(evaluation.study.objective)[~run.diverged]
    return float(kept.mean()) if len(kept) else float("nan")
