"""Whether an update of the policy in service is better on what it was not trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.risk import of_logged_runs
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.filtered import Filtered
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.scenario import Scenario
from ccdtools.statistics import PairedDifference
from ccdtools.trajectory import Trajectory
from ccdtools.twin.common_runs import groups
from ccdtools.twin.discrepancy import TwinPlant
from ccdtools.twin.limits_kept import Breach, breach
from ccdtools.twin.online import OnlineConfig
from ccdtools.twin.paired_risk import paired_in_risk
from ccdtools.twin.recombined_returns import (
    NOT_ASKED,
    Drive,
    Independence,
    LoggedGain,
    independence,
    recombined_gain,
)  # fmt: skip
from ccdtools.twin.replay import Replay
from ccdtools.twin.residuals import Residuals
from ccdtools.twin.transport import ErrorSplit
from ccdtools.twin.twin import DigitalTwin
from invariant_sets import AdmissibleInputs
from learning.networks import ActorCritic


@dataclass(frozen=True, eq=False)
class UpdateJudge:
    """Compares policies at the deployed design on logged errors.

    Attributes
    ----------
    problem : CoDesignProblem
    design : (np,) array
    config : OnlineConfig
    runs : int
        That are deployed.
    rng, rng_of_runs : numpy.random.Generator
        For recombined and nominal runs, and for the choice of logged ones.
    admissible : AdmissibleInputs or None
        The filter behind every policy.
    twin : DigitalTwin, optional
        What former deployments have taught, if there were any.
    """

    problem: CoDesignProblem
    design: Array
    config: OnlineConfig
    runs: int
    rng: np.random.Generator
    rng_of_runs: np.random.Generator
    admissible: AdmissibleInputs | None
    twin: DigitalTwin | None = None

    @property
    def split(self) -> ErrorSplit:
        """Of errors into what enters through E(p), and the rest."""
        return ErrorSplit(self.problem.model, self.problem.state_scale)

    def told(self, logs: Sequence[Residuals], agent: ActorCritic) -> Independence:
        """Whether the runs logged so far may be recombined: told by all of them, the held-out ones are few."""
        if self.runs == 1 or not self.config.recombine:
            return NOT_ASKED
        replay = Replay(tuple(logs), self.split)
        return independence(replay, self._drive(agent), self.problem.objective, self.rng)

    def gain(
        self, candidate: ActorCritic, agent: ActorCritic, held_out: Sequence[Residuals], logs: Sequence[Residuals],
        told: Independence,
    ) -> tuple[PairedDifference, float]:  # fmt: skip
        """Candidate minus policy in service on held-out parts and runs, and the size of the latter's return.

        The size is that of its return, without the cost of the design, on the held-out parts or on the nominal model,
        whichever is larger: errors of hardly any size say little. NaN where more of the candidate's runs diverge.

        Held-out runs are recombined where all of them are `independent`. Runs that met the same disturbance, in this
        and in former deployments, are one piece of evidence.

        Where all runs so far may be recombined, the interval reaches down to that of theirs: a dozen held-out runs may
        know nothing of the few that decide, and those that the candidate was trained on would rather flatter it.
        """
        several = self.runs > 1
        parts = held_out if several else _equally_long(held_out)
        replay = Replay(tuple(parts), self.split)
        if replay.recombines:
            found = self._recombined_gain(candidate, agent, replay)
        else:
            found = self._logged_gain(candidate, agent, replay)
        everywhere = found
        if told.possible:
            everywhere = self._recombined_gain(candidate, agent, Replay(tuple(logs), self.split))
        if found.more_lost or everywhere.more_lost:
            return PairedDifference(np.nan, (np.nan, np.nan)), np.nan
        counted = parts[0].steps if several else len(parts) * self._counted(parts[0].steps)
        nominal = self._nominal_size(agent) * counted / self.problem.steps
        low, high = found.gain.ci95
        gain = PairedDifference(found.gain.mean, (min(low, everywhere.gain.ci95[0]), high))
        return gain, float(np.fmax(found.size, nominal))

    def updated_gain(self, candidate: ActorCritic, agent: ActorCritic) -> PairedDifference | None:
        """Candidate minus policy in service on the updated model with its innovations replayed; None without one.

        Replayed as they are, errors that are consequences of the state or input stay those of another policy: the
        updated model lets them follow.
        """
        if self.twin is None or self.twin.discrepancy is None:
            return None
        plant = TwinPlant(self.problem.model, replace(self.twin.discrepancy, noise="replayed"))
        replay = Replay(self.twin.innovations())
        x0, w = replay.whole()
        chosen = self.rng.permutation(len(x0))[: self.config.judged]
        after, before = self._driven(Scenario(plant, x0[chosen], w[chosen]), candidate, agent)
        kept = ~(after.diverged | before.diverged)
        if after.diverged.sum() > before.diverged.sum() or not kept.any():
            return PairedDifference(np.nan, (np.nan, np.nan))
        rewards = [run.rewards(self.problem.objective)[kept] for run in (after, before)]
        return paired_in_risk(
            of_logged_runs(self.problem.risk), rewards[0], rewards[1], groups(replay.logs)[chosen][kept], runs=len(x0),
            stretch=self.config.window,
        )  # fmt: skip

    def breach(
        self, candidate: ActorCritic, agent: ActorCritic, logs: Sequence[Residuals], plant: Any
    ) -> Breach | None:
        """How a candidate breaks limits on all errors logged so far that the policy in service keeps."""
        parts = logs if self.runs > 1 else _equally_long(logs)
        x0, w = Replay(tuple(parts), self.split).whole()
        chosen = slice(self.config.judged if self.runs > 1 else None)
        scenario = Scenario(self.split.replayed_model, x0[chosen], w[chosen])
        after, before = self._driven(scenario, candidate, agent)
        return breach(self.problem, scenario, after, before, plant)

    def _recombined_gain(self, candidate: ActorCritic, agent: ActorCritic, replay: Replay) -> LoggedGain:
        """Candidate minus policy in service on recombined runs."""
        drive = self._drive(candidate, agent)
        risk = of_logged_runs(self.problem.risk)
        return recombined_gain(replay, drive, self.problem.objective, self.config.judged, self.rng, risk)

    def _counted(self, steps: int) -> int:
        """The held-out last steps of a stretch of a single run."""
        return round(self.config.held_out * steps)

    def _logged_gain(self, candidate: ActorCritic, agent: ActorCritic, replay: Replay) -> LoggedGain:
        """Candidate minus policy in service on logged runs, of a single one on the ends of its stretches."""
        x0, w = replay.whole()
        several = self.runs > 1
        chosen = self.rng_of_runs.permutation(len(x0))[: self.config.judged] if several else np.arange(len(x0))
        after, before = self._drive(candidate, agent)(x0[chosen], w[chosen])
        if after.diverged.mean() > before.diverged.mean():
            return LoggedGain(PairedDifference(np.nan, (np.nan, np.nan)), np.nan, True)
        kept = ~(after.diverged | before.diverged)
        rewards = [run.rewards(self.problem.objective)[kept] for run in (after, before)]
        labels = groups(replay.logs)[chosen][kept]
        if not several:
            rewards = [own[:, -self._counted(w.shape[1]) :] for own in rewards]
        risk = of_logged_runs(self.problem.risk)
        made, met = rewards
        gain = paired_in_risk(risk, made, met, labels, runs=self.runs, stretch=self.config.window)
        return LoggedGain(gain, self._size(met) if kept.any() else np.nan, False)

    def _size(self, rewards: Array) -> float:
        """How large the mean return of runs, or of the parts of one, is without the cost of the design."""
        steps = rewards.size // (len(rewards) if self.runs > 1 else 1)
        mean = float(rewards.sum()) * steps / rewards.size
        return float(self.problem.objective.made_by_control(mean, self.design, steps))

    def _nominal_size(self, agent: ActorCritic) -> float:
        """Size of a policy's return on the nominal model, without the cost of the design; NaN where every run diverges,
        or the model is another.
        """
        if self.problem.discrepancy is not None:
            return np.nan
        x0, w = self.problem.scenarios.sample(self.config.judged, self.problem.steps, self.rng)
        (run,) = self._driven(Scenario(self.problem.model, x0, w), agent)
        returns = run.returns(self.problem.objective)[~run.diverged]
        return run.size_of(float(returns.mean()), self.problem.objective) if len(returns) else np.nan

    def _drive(self, *agents: ActorCritic) -> Drive:
        """What runs policies over initial states and errors."""
        model = self.split.replayed_model
        return lambda x0, w: self._driven(Scenario(model, x0, w), *agents)

    def _driven(self, scenario: Scenario, *agents: ActorCritic) -> tuple[Trajectory, ...]:
        """The runs of every policy as it would be in service."""
        controllers = (served(agent, self.design, self.admissible) for agent in agents)
        return tuple(
            scenario.run(controller, design=self.design, limit=self.problem.limit) for controller in controllers
        )


def served(agent: ActorCritic, design: Array, admissible: AdmissibleInputs | None) -> Controller:
    """The policy as it is in service: behind the filter, if there is one."""
    policy = LearnedPolicy(agent, design)
    return policy if admissible is None else Filtered(policy, admissible)


def _equally_long(logs: Sequence[Residuals]) -> list[Residuals]:
    """The logs without their first steps, as long as the shortest: stretches of a run differ by one step at most."""
    shortest = min(log.steps for log in logs)
    return [log.part(slice(None), slice(log.steps - shortest, None)) for log in logs]
