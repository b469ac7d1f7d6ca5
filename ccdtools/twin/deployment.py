"""Deployment on the real plant, with log and updates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, Immutable
from ccdtools.co_design.codesign import codesign
from ccdtools.co_design.problem import CoDesignProblem, as_seen_problem
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.signals import Reference
from ccdtools.estimation.measurement import Measurement
from ccdtools.evidence.switchback import TrialStatus
from ccdtools.exceptions import SimulatorError
from ccdtools.plants.models import Simulable
from ccdtools.progress import at
from ccdtools.scenario import Scenario
from ccdtools.simulation import simulate
from ccdtools.tolerances import FEWEST_PAIRS
from ccdtools.trajectory import Trajectory
from ccdtools.twin.deployable import Deployable
from ccdtools.twin.distributions import Distribution, ServedDistributions, logged
from ccdtools.twin.identified import identified_plant
from ccdtools.twin.judge import Judge
from ccdtools.twin.online import OnlineConfig, OnlineUpdate
from ccdtools.twin.pieces import joined
from ccdtools.twin.replay import replay_problem
from ccdtools.twin.residuals import Residuals, block_parts, errors_of, is_common, residuals
from ccdtools.twin.transport import ErrorSplit
from ccdtools.twin.trial import switchback_on
from ccdtools.twin.updated_plant import UpdatedPlant
from ccdtools_ground.door import as_floats, as_generator, as_instance
from invariant_sets import AdmissibleInputs
from learning.networks import ActorCritic


@dataclass(frozen=True, eq=False, repr=False)
class Deployment(Immutable):
    """Outcome of a deployment."""

    log: Trajectory  # all runs as they happened, under the policies then deployed
    agent: ActorCritic  # deployed at the end
    updates: tuple[OnlineUpdate, ...]

    @property
    def changes(self) -> tuple[int, ...]:
        """Samples logged before every accepted update, and before and after every trial."""
        return tuple(change for update in self.updates for change in update.changes)

    def __repr__(self) -> str:
        return f"Deployment({self.log!r}, {len(self.changes)} of {len(self.updates)} updates accepted)"


def deploy(
    plant: Simulable,
    controller: Controller,
    design: ArrayLike,
    disturbance: ArrayLike,
    *,
    x0: ArrayLike,
    limit: ArrayLike | None = None,
    reference: Reference | ArrayLike | None = None,
    output: Measurement | Any = None,
    rng: np.random.Generator | None = None,
    progress: bool = False,
) -> Trajectory:
    """Log of `controller` on a real plant under a recorded disturbance.

    Parameters
    ----------
    disturbance : (T, nw) or (n, T, nw) array_like
        Its length is that of the deployment.
    x0 : (nx,) or (n, nx) array_like
    limit : (nx,) array_like, optional
        Divergence limit on |x|, see `simulate`.
    reference, output : optional
        What a controller is to follow, and what is measured, see `simulate`.
    rng : numpy.random.Generator, optional
        Required by random noise of the measurement.

    Raises
    ------
    InputError
        As `simulate`; also if a policy was made for another design.
    """
    w = as_floats("disturbance", disturbance)
    steps = w.shape[-2] if w.ndim > 1 else w.size
    return simulate(
        plant, controller, x0=x0, steps=steps, disturbance=w, design=design, limit=limit, reference=reference,
        output=output, rng=rng, progress=progress,
    )  # fmt: skip


def deploy_and_update(
    problem: CoDesignProblem,
    plant: Simulable,
    agent: ActorCritic,
    design: ArrayLike,
    *,
    x0: Array,
    disturbance: Array,
    rng: np.random.Generator,
    config: OnlineConfig | None = None,
    admissible: AdmissibleInputs | None = None,
    former: Sequence[Trajectory | Residuals] = (),
    served: ServedDistributions | None = None,
    progress: bool = False,
) -> Deployment:
    """Deployment in stretches, with a policy update between them.

    After a stretch, the errors of the nominal model along all stretches so far are replayed as disturbances. A
    candidate is trained on the first part of every stretch, and from the starts that it will serve. It is deployed only
    if its paired return on the rest is better, and if it loses no more than is accepted on every other distribution:
    see `Judge` and `ServedDistributions`. Of a single run both are replayed from the start of every stretch, so that
    what is judged begins in states of their own; several runs are judged from their own starts. A trial on the real
    plant predicts with what has been logged so far, see `identified_plant`, too: `switchback_on`.

    Parameters
    ----------
    problem : CoDesignProblem
        Gives the nominal model, the objective, the risk, and how far limits may be left.
    plant : Plant, or anything else that `simulate` takes
        The real one.
    x0 : (n, nx) array
        Initial states of the runs.
    disturbance : (n, T, nw) array
        One long run is cut in time, several are dealt out in groups. A deployment too short to judge so many
        updates gets fewer, or none.
    admissible : AdmissibleInputs, optional
        A filter behind the deployed policy, see `Filtered`; it is judged with the filter, too.
    former : sequence of Trajectory or Residuals
        Former deployments, or the errors along them, from which the model is updated, too. On those of several runs as
        long as these candidates, which are not trained on them, are judged besides. Every second run, from the first
        on, counts as one that met the same disturbance in every deployment: together these are one piece of evidence,
        and those of a disturbance that a candidate was trained on are left out.
    served : ServedDistributions, optional
        The other starts and disturbances that the policy will serve; by default the problem's, and its box of starts.
    """
    config = OnlineConfig() if config is None else config
    as_seen_problem(problem)
    as_instance("agent", agent, ActorCritic, "an ActorCritic")
    as_instance("config", config, OnlineConfig, "an OnlineConfig")
    as_generator("rng", rng)
    design = problem.design.check_one(design)
    whole = Scenario(plant, x0, disturbance)
    if admissible is not None:
        as_instance("admissible", admissible, AdmissibleInputs, "an AdmissibleInputs or None")
    known = errors_of(former, problem.model, "former") if former else []
    served = ServedDistributions(problem, whole.x0[0], runs=config.judged) if served is None else served
    as_instance("served", served, ServedDistributions, "a ServedDistributions or None")
    deployed = Deployable(agent, design, "the deployed policy")
    return _DeployedPolicy(served, whole, deployed, rng, rng.spawn(1)[0], config, admissible, known).run(progress)


@dataclass(eq=False)
class _DeployedPolicy:
    """Deployed policy with its log and updates so far."""

    served: ServedDistributions
    whole: Scenario
    deployed: Deployable
    rng: np.random.Generator
    judged_by: np.random.Generator
    config: OnlineConfig
    admissible: AdmissibleInputs | None
    former: Sequence[Residuals]
    pieces: list[Trajectory] = field(default_factory=list)
    updates: list[OnlineUpdate] = field(default_factory=list)
    logs: list[Residuals] = field(default_factory=list)  # errors of every part of the log
    train: list[Residuals] = field(default_factory=list)  # what candidates are trained on
    test: list[Residuals] = field(default_factory=list)  # what they are judged on; the last part of a single run's

    def __post_init__(self) -> None:
        config = self.config
        self.candidate: Deployable | None = None  # on trial
        self.model: Simulable | None = None  # which foretells in that trial
        self.coins = self.rng if config.trial is None else self.rng.spawn(1)[0]
        self.problem = self.served.problem
        self.split = ErrorSplit(self.problem.model, self.problem.state_scale)
        self.judge = Judge(self.problem, self.whole.plant, lambda _: self.admissible, config.window, config.accept_loss)

    def run(self, progress: bool) -> Deployment:
        """Result of the whole deployment."""
        runs, steps = self.whole.disturbance.shape[:2]
        trial = self.config.trial
        parts = runs // 2 if runs > 1 else int(steps * self.config.held_out // self.config.window)
        parts = parts if trial is None else min(parts, trial.pairs(runs, steps) // FEWEST_PAIRS)
        count = min(self.config.updates, max(0, parts - 1))  # a window to judge on in each, or room for a trial
        for k, part in enumerate(deployment_parts(runs, steps, count + 1)):
            at(f"part {k + 1} of {count + 1}")
            try:
                piece = self._run_part(*part, progress)
            except SimulatorError as error:
                error.kept = self._so_far() if self.pieces else error.kept
                raise
            self.pieces.append(piece)
            if len(self.pieces) <= count and self._learn(piece, part[0].start) and self.candidate is None:
                at(f"update {k + 1} of {count}")
                self._update()
        return self._so_far()

    def _so_far(self) -> Deployment:
        """Parts that have ended, and what is deployed now."""
        return Deployment(joined(self.pieces, len(self.whole.x0)), self.deployed.agent, tuple(self.updates))

    @property
    def _logged(self) -> int:
        """Samples of all runs so far."""
        return sum(piece.inputs.shape[0] * piece.inputs.shape[1] for piece in self.pieces)

    def _run_part(self, runs: slice, steps: slice, progress: bool) -> Trajectory:
        """Log of one part, begun where the last ended."""
        x0 = self.pieces[-1].states[:, -1] if self.pieces and steps.start > 0 else self.whole.x0[runs]
        law = self.deployed.controller(self.admissible)
        w = self.whole.disturbance[runs, steps]
        if self.candidate is None:
            return deploy(
                self.whole.plant, law, self.deployed.design, w, x0=x0, limit=self.problem.limit, progress=progress
            )
        update = self.updates[-1]
        if update.trial is None:  # one that goes on keeps its model
            logged = [piece for piece in self.pieces if not piece.diverged.all()]
            self.model = identified_plant(self.problem, logged)
        tried = switchback_on(
            self.problem, self.whole.plant, law, self.candidate.controller(self.admissible), self.deployed.design,
            x0=x0, disturbance=w, rng=self.coins, config=self.config.trial, before=update.trial,
            model=self.model,
        )  # fmt: skip
        self.updates[-1] = replace(update, trial=tried.trial, ended=self._logged + tried.samples)
        if tried.trial.status is not TrialStatus.UNDECIDED:
            self.deployed = self.candidate if self.updates[-1].accepted else self.deployed
            self.candidate = None
        return tried.log

    def _learn(self, piece: Trajectory, before: int) -> bool:
        """Add the errors of a piece after so many runs; False if too little is left."""
        left = int((~piece.diverged).sum())
        if left < (2 if self._several else 1):
            return False
        errors = residuals(self.problem.model, piece)
        errors = replace(errors, numbers=before + errors.numbers)
        most = 1 - 1 / errors.runs if self._several else 1.0  # one run is left to train on
        share = min(self.config.held_out, most)
        first, rest = (block_parts(errors, share, 1, last=last) for last in (False, True))
        if not (first and rest) or min(part.steps for part in first + rest) < self.config.window:
            return False
        self.logs.append(errors)
        self.train += first
        self.test += rest if self._several else [errors]
        return True

    @property
    def _several(self) -> bool:
        return len(self.whole.x0) > 1

    @cached_property
    def _starts(self) -> Array:
        """Training starts beside the states of the log."""
        return self.served.trained_from(self.deployed.design, self.judged_by)

    def _update(self) -> None:
        config = self.config
        problem = replay_problem(self.problem, self.train, config.window, starts=self._starts)
        agent = codesign(
            problem, agent=self.deployed.agent, design=self.deployed.design, rng=self.rng,
            config=replace(config.training, design_rate=0.0),
        ).agent  # fmt: skip
        candidate = replace(self.deployed, agent=agent, name=f"update {len(self.updates) + 1}")
        verdict = self.judge.verdict(
            candidate, self.deployed, self._held_out(), self.served.nominal(self.judged_by),
            lambda size, _: config.least * size, self._other_distributions,
        )  # fmt: skip
        self.updates.append(OnlineUpdate(self._logged, verdict, agent))
        if verdict.replaces and self.config.trial is not None:
            self.candidate = candidate
        elif verdict.replaces:
            self.deployed = candidate

    def _held_out(self) -> Distribution:
        """Held-out parts of the log, and former runs not trained on."""
        several = self._several
        return logged(
            self.split, [*self._unseen(), *self.test] if several else _equally_long(self.test), series=not several,
            most=self.config.judged, rng=self.judged_by, held_out=None if several else self.config.held_out,
        )  # fmt: skip

    def _other_distributions(self) -> list[Distribution]:
        """Other distributions that the policy serves, on the updated model."""
        logs = [*self.former, *self.logs]
        plant = UpdatedPlant.from_logs(self.split, logs, rng=self.judged_by, config=self.config.quantile)
        whole = [log for log in logs if log.steps == self.whole.steps] if self._several else _equally_long(self.logs)
        again = logged(plant, whole, series=not self._several, most=self.config.judged, rng=self.judged_by)
        return [again, *self.served.on(logs, plant, self.deployed.design, self.judged_by)]

    def _unseen(self) -> list[Residuals]:
        """Former runs whose disturbance no candidate was trained on."""
        trained = np.concatenate([log.numbers for log in self.train])
        former = [log for log in self.former if log.runs > 1 and log.steps == self.whole.steps]
        kept = [~(is_common(log.numbers) & np.isin(log.numbers, trained)) for log in former]
        return [log.part(own, slice(None)) for log, own in zip(former, kept) if own.any()]


def _equally_long(logs: Sequence[Residuals]) -> list[Residuals]:
    """Last steps of the logs, cut to equal length by one step at most."""
    shortest = min(log.steps for log in logs)
    return [log.part(slice(None), slice(log.steps - shortest, None)) for log in logs]


def deployment_parts(runs: int, steps: int, pieces: int) -> list[tuple[slice, slice]]:
    """Runs and steps of each part: groups of runs, or pieces of the only one."""
    edges = np.unique(np.linspace(0, runs if runs > 1 else steps, pieces + 1).round().astype(int))
    parts = [slice(a, b) for a, b in pairwise(edges)]
    return [(part, slice(0, steps)) if runs > 1 else (slice(0, 1), part) for part in parts]
