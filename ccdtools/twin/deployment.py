"""A policy on the real plant, with what it logs and how it is updated on the way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, Immutable
from ccdtools.checks import as_floats, as_generator, as_instance, shown
from ccdtools.co_design.codesign import codesign
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.signals import Reference
from ccdtools.estimation.measurement import Measurement
from ccdtools.exceptions import InputError
from ccdtools.progress import at
from ccdtools.scenario import Scenario
from ccdtools.simulation import Simulable, simulate
from ccdtools.trajectory import Trajectory
from ccdtools.twin.common_runs import is_common
from ccdtools.twin.online import OnlineConfig, OnlineUpdate
from ccdtools.twin.replay import replay_problem
from ccdtools.twin.residuals import Residuals, check_errors, residuals
from ccdtools.twin.twin import DigitalTwin
from ccdtools.twin.update_judge import UpdateJudge, served
from invariant_sets import AdmissibleInputs
from learning.networks import ActorCritic


@dataclass(frozen=True, eq=False, repr=False)
class Deployment(Immutable):
    """What came of a deployment.

    Attributes
    ----------
    log : Trajectory
        All runs as they happened, under the policies then in service.
    agent : ActorCritic
        In service at the end.
    updates : tuple of OnlineUpdate
    """

    log: Trajectory
    agent: ActorCritic
    updates: tuple[OnlineUpdate, ...]

    @property
    def changed(self) -> bool:
        """Whether any update was accepted."""
        return any(update.accepted for update in self.updates)

    def __repr__(self) -> str:
        accepted = sum(update.accepted for update in self.updates)
        return f"Deployment({self.log!r}, {accepted} of {len(self.updates)} updates accepted)"


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
    """The log of `controller` on a real plant under a recorded disturbance.

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
    former: Sequence[Residuals] = (),
    twin: DigitalTwin | None = None,
    progress: bool = False,
) -> Deployment:
    """A deployment in stretches, with an update of the policy after each but the last.

    After a stretch, the errors of the nominal model along all stretches so far are replayed as disturbances. A
    candidate is trained on the first part of every stretch and goes into service only if its paired return on the
    rest is better: the interval of the difference excludes zero, and it is worth a change. Returns are compared in
    `problem.risk`; a candidate must keep the limits as far as `problem.limit_tolerance` grants, where the policy in
    service does. Of a single run both are replayed from the start of every stretch, so that what is judged begins in
    states of their own; several runs are judged from their own starts; where the errors logged so far do not depend on
    each other in time, on runs recombined of them step by step (see `independence`).

    Parameters
    ----------
    problem : CoDesignProblem
        Gives the nominal model and the objective.
    plant : Plant, or anything else that `simulate` takes
        The real one.
    x0 : (n, nx) array
        Initial states of the runs.
    disturbance : (n, T, nw) array
        One long run is cut in time, several are dealt out in groups. A deployment too short to judge so many
        updates gets fewer, or none.
    admissible : AdmissibleInputs, optional
        A filter behind the policy in service, see `Filtered`; it is judged with the filter, too.
    former : sequence of Residuals
        Errors along former deployments of several runs, as long as these: candidates, which are not trained on them,
        are judged on them, too. Each is met through E(p) of this design. Every second run, from the first on, counts
        as one that met the same disturbance in every deployment: together these are one piece of evidence, and those
        of a disturbance that a candidate was trained on are left out.
    twin : DigitalTwin, optional
        What former deployments of several runs have taught: a candidate must be better on its updated model, too, and
        beyond chance. There errors follow the state and the input, while logged ones stay those of another policy.
    """
    config = OnlineConfig() if config is None else config
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    as_instance("agent", agent, ActorCritic, "an ActorCritic")
    as_instance("config", config, OnlineConfig, "an OnlineConfig")
    as_generator("rng", rng)
    design = problem.design.check_one(design)
    whole = Scenario(plant, x0, disturbance)
    if admissible is not None:
        as_instance("admissible", admissible, AdmissibleInputs, "an AdmissibleInputs or None")
    if not isinstance(former, list | tuple) or not all(isinstance(log, Residuals) for log in former):
        raise InputError("former", shown(former), "a sequence of Residuals")
    for k, log in enumerate(former):
        check_errors(f"former[{k}]", problem.model, log)
    if twin is not None:
        as_instance("twin", twin, DigitalTwin, "a DigitalTwin or None")
    several = len(whole.x0) > 1
    alike = [log for log in former if log.runs > 1 and log.steps == whole.steps and several]
    taught = twin if twin is not None and {log.steps for log in twin.logs} == {whole.steps} and several else None
    return _Service(problem, whole, design, agent, rng, config, admissible, alike, taught).run(progress)


class _Service:
    """A policy in service: its log so far, and the updates it has had.

    Attributes
    ----------
    former : sequence of Residuals
        Errors of other deployments, which candidates are judged on, too.
    logs, train, test : list of Residuals
        Errors of every part of the log: all of them, what candidates are trained on, and what they are judged on. Of a
        single run, `test` holds whole stretches, of which only the last part is judged.
    """

    def __init__(
        self, problem: CoDesignProblem, whole: Scenario, design: Array, agent: ActorCritic, rng: np.random.Generator,
        config: OnlineConfig, admissible: AdmissibleInputs | None, former: Sequence[Residuals],
        twin: DigitalTwin | None,
    ) -> None:  # fmt: skip
        self.problem = problem
        self.whole = whole
        self.design = design
        self.agent = agent
        self.rng = rng
        self.config = config
        self.admissible = admissible
        self.former = former
        self.pieces: list[Trajectory] = []
        self.updates: list[OnlineUpdate] = []
        self.judge = UpdateJudge(problem, design, config, len(whole.x0), rng.spawn(1)[0], rng, admissible, twin)
        self.logs: list[Residuals] = []
        self.train: list[Residuals] = []
        self.test: list[Residuals] = []

    def run(self, progress: bool) -> Deployment:
        """The whole deployment."""
        runs, steps = self.whole.disturbance.shape[:2]
        count = possible_updates(runs, steps, self.config)
        for k, part in enumerate(deployment_parts(runs, steps, count + 1)):
            at(f"part {k + 1} of {count + 1}")
            piece = self._serve(*part, progress)
            self.pieces.append(piece)
            if len(self.pieces) <= count and self._learn(piece, part[0].start):
                at(f"update {k + 1} of {count}")
                self._update()
        return Deployment(joined(self.pieces, runs), self.agent, tuple(self.updates))

    def _serve(self, runs: slice, steps: slice, progress: bool) -> Trajectory:
        """The log of the policy in service on one part of the deployment, from where the last one ended."""
        x0 = self.pieces[-1].states[:, -1] if self.pieces and steps.start > 0 else self.whole.x0[runs]
        controller = served(self.agent, self.design, self.admissible)
        return deploy(
            self.whole.plant, controller, self.design, self.whole.disturbance[runs, steps],
            x0=x0, limit=self.problem.limit, progress=progress,
        )  # fmt: skip

    def _learn(self, piece: Trajectory, before: int) -> bool:
        """Add the errors along a piece of the log, after so many runs; False where too little is left to learn from."""
        left = int((~piece.diverged).sum())
        if left < (2 if self._several else 1):
            return False
        errors = residuals(self.problem.model, piece)
        errors = replace(errors, numbers=before + errors.numbers)
        first, rest = _split(errors, self.config.held_out)
        if min(first.steps, rest.steps) < self.config.window:
            return False
        self.logs.append(errors)
        self.train.append(first)
        self.test.append(rest if self._several else errors)
        return True

    @property
    def _several(self) -> bool:
        """Whether more than one run is deployed."""
        return len(self.whole.x0) > 1

    def _update(self) -> None:
        """Train a candidate, and put it into service if it is better on what it was not trained on."""
        config = self.config
        training = replace(config.training, design_rate=0.0)
        told = self.judge.told(self.logs, self.agent)
        trained = [replace(log, independent=told.possible) for log in self.train]  # what it finds there is judged
        problem = replay_problem(self.problem, trained, self.config.window)
        candidate = codesign(problem, agent=self.agent, design=self.design, rng=self.rng, config=training).agent
        evidence = [replace(log, independent=told.independent and log.independent) for log in self._unseen()]
        evidence += [replace(log, independent=told.independent) for log in self.test]
        gain, size = self.judge.gain(candidate, self.agent, evidence, self.logs, told)
        accepted = gain.ci95[0] > 0 and gain.mean > config.least * size
        updated = self.judge.updated_gain(candidate, self.agent) if accepted else None
        accepted = bool(accepted and (updated is None or updated.ci95[0] > 0))
        broken = self.judge.breach(candidate, self.agent, self.logs, self.whole.plant) if accepted else None
        accepted = accepted and broken is None
        after = sum(piece.inputs.shape[0] * piece.inputs.shape[1] for piece in self.pieces)
        self.updates.append(OnlineUpdate(after, gain, accepted, updated, str(broken or "")))
        self.agent = candidate if accepted else self.agent

    def _unseen(self) -> list[Residuals]:
        """Former runs without those of a disturbance that candidates are trained on."""
        trained = np.concatenate([log.numbers for log in self.train])
        kept = [~(is_common(log.numbers) & np.isin(log.numbers, trained)) for log in self.former]
        return [log.part(own, slice(None)) for log, own in zip(self.former, kept) if own.any()]


def _split(errors: Residuals, held_out: float) -> tuple[Residuals, Residuals]:
    """The part to train on and the part to judge on: the last runs, or the end of the only one."""
    runs = errors.runs
    steps = errors.steps
    if runs > 1:
        cut = max(1, runs - max(1, round(held_out * runs)))
        return errors.part(slice(None, cut), slice(None)), errors.part(slice(cut, None), slice(None))
    cut = steps - round(held_out * steps)
    return errors.part(slice(None), slice(None, cut)), errors.part(slice(None), slice(cut, None))


def possible_updates(runs: int, steps: int, config: OnlineConfig) -> int:
    """As many updates as leave every part a window to be judged on, at most `config.updates`."""
    parts = runs // 2 if runs > 1 else int(steps * config.held_out // config.window)
    return min(config.updates, max(0, parts - 1))


def deployment_parts(runs: int, steps: int, pieces: int) -> list[tuple[slice, slice]]:
    """(runs, steps) of each part: groups of runs, or pieces in time of the only run."""
    if runs > 1:
        edges = np.unique(np.linspace(0, runs, pieces + 1).round().astype(int))
        return [(slice(a, b), slice(0, steps)) for a, b in pairwise(edges)]
    edges = np.unique(np.linspace(0, steps, pieces + 1).round().astype(int))
    return [(slice(0, 1), slice(a, b)) for a, b in pairwise(edges)]


def joined(pieces: Sequence[Trajectory], runs: int) -> Trajectory:
    """One log of all parts."""
    if len(pieces) == 1:
        return pieces[0]
    first = pieces[0]
    if runs > 1:
        return replace(
            first,
            states=np.concatenate([p.states for p in pieces]),
            inputs=np.concatenate([p.inputs for p in pieces]),
            disturbances=np.concatenate([p.disturbances for p in pieces]),
            diverged_at=np.concatenate([p.diverged_at for p in pieces]),
        )
    states = np.concatenate([first.states, *(p.states[:, 1:] for p in pieces[1:])], axis=1)
    inputs = np.concatenate([p.inputs for p in pieces], axis=1)
    disturbances = np.concatenate([p.disturbances for p in pieces], axis=1)
    starts = np.cumsum([0, *(p.inputs.shape[1] for p in pieces)])
    lost = [start + int(p.diverged_at[0]) for start, p in zip(starts, pieces) if p.diverged_at[0] >= 0]
    if lost:  # a stretch after the loss started afresh from where the run was stopped
        states[:, lost[0] + 1 :] = states[:, lost[0] + 1, None]
        inputs[:, lost[0] + 1 :] = 0.0
    return Trajectory(states, inputs, disturbances, np.array([lost[0] if lost else -1]), first.design, first.dt)
