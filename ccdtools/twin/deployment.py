"""Step 2: a policy on the real plant, with what it logs and how it is updated on the way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.reinforcement.ppo import CoDesignConfig, codesign_ppo
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.exceptions import InputError
from ccdtools.simulation import Simulable, Trajectory, simulate
from ccdtools.statistics import PairedDifference, paired_difference
from ccdtools.twin.twin import Residuals, residuals
from learning.networks import ActorCritic
from learning.ppo import PPOConfig

ONLINE_TRAINING = CoDesignConfig(
    iterations=20, runs=64, pathwise_runs=64, design_rate=0.0, policy_rate=3e-4, evaluate_every=5,
    evaluation_runs=200, ppo=PPOConfig(learning_rate=1e-4, kl_limit=0.005, passes=2, critic_only=3),
)  # fmt: skip


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
        Last fraction of the stretch just logged, on which a candidate is judged.
    judged : int
        Most replayed episodes of that judgement; they share no sample, so that their interval can be trusted.
    training : CoDesignConfig
        Of the candidate; the design is always frozen.
    """

    updates: int = 4
    window: int = 100
    held_out: float = 0.3
    judged: int = 400
    training: CoDesignConfig = field(default_factory=lambda: ONLINE_TRAINING)

    def __post_init__(self) -> None:
        for name, least in (("updates", 0), ("window", 1), ("judged", 2)):
            if getattr(self, name) < least:
                raise InputError(f"{name}: got {getattr(self, name)}, expected at least {least}.")
        if not 0 < self.held_out < 1:
            raise InputError(f"held_out: got {self.held_out}, expected a fraction between 0 and 1.")


@dataclass(frozen=True, eq=False)
class OnlineUpdate:
    """One attempt to improve the policy in service.

    Attributes
    ----------
    after : int
        Samples logged before it.
    gain : PairedDifference
        Candidate minus policy in service, on replays of the held-out stretch.
    accepted : bool
        Whether the interval of the gain lies above zero.
    """

    after: int
    gain: PairedDifference
    accepted: bool


@dataclass(frozen=True, eq=False)
class Deployment:
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


@dataclass(frozen=True, eq=False)
class Replay:
    """Scenarios from logged errors: each episode starts where the log was, and meets the errors it met.

    Parameters
    ----------
    stretches : sequence of Residuals
        Drawn from in proportion to the windows they hold.
    """

    stretches: Sequence[Residuals]

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Initial states (runs, nx) and errors (runs, steps, nx).

        Raises
        ------
        InputError
            If no logged run is as long as `steps`.
        """
        self._require(steps)
        windows = np.array([len(e.x) * max(e.x.shape[1] - steps + 1, 0) for e in self.stretches])
        draw = np.sort(rng.integers(0, windows.sum(), runs))
        edges = np.concatenate([[0], np.cumsum(windows)])
        x0, w = [], []
        for errors, first, last in zip(self.stretches, edges[:-1], edges[1:]):
            chosen = draw[(draw >= first) & (draw < last)] - first
            run, start = np.divmod(chosen, max(errors.x.shape[1] - steps + 1, 1))
            x0.append(errors.x[run, start])
            w.append(errors.e_next[run[:, None], start[:, None] + np.arange(steps)])
        return np.concatenate(x0), np.concatenate(w)

    def disjoint(self, steps: int) -> tuple[Array, Array]:
        """Initial states (n, nx) and errors (n, steps, nx) of windows that share no sample: independent evidence.

        Raises
        ------
        InputError
            If no logged run is as long as `steps`.
        """
        self._require(steps)
        x0, w = [], []
        for errors in self.stretches:
            length, nx = errors.e_next.shape[1:]
            whole = length // steps * steps
            x0.append(errors.x[:, :whole:steps].reshape(-1, nx))
            w.append(errors.e_next[:, :whole].reshape(-1, steps, nx))
        return np.concatenate(x0), np.concatenate(w)

    def _require(self, steps: int) -> None:
        longest = max(errors.x.shape[1] for errors in self.stretches)
        if longest < steps:
            raise InputError(f"log: got runs of {longest} samples, expected at least {steps} for a replay.")


def deploy(
    plant: Simulable,
    controller: Controller,
    design: ArrayLike,
    disturbance: ArrayLike,
    *,
    x0: ArrayLike,
    limit: ArrayLike | None = None,
    progress: bool = False,
) -> Trajectory:
    """The log of `controller` on a real plant under a recorded disturbance.

    Parameters
    ----------
    disturbance : (T, nw) or (n, T, nw) array_like
        Its length is that of the deployment.
    x0 : (nx,) or (n, nx) array_like
    """
    w = np.asarray(disturbance, dtype=float)
    steps = w.shape[-2] if w.ndim > 1 else len(w)
    return simulate(plant, controller, x0=x0, steps=steps, disturbance=w, design=design, limit=limit, progress=progress)


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
    progress: bool = False,
) -> Deployment:
    """A deployment in stretches, with an update of the policy after each but the last.

    After a stretch, the errors of the nominal model along all stretches so far are replayed as disturbances. A
    candidate is trained on the first part of every stretch and goes into service only if its paired return on the
    rest is better: the interval of the difference excludes zero.

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
    """
    config = config or OnlineConfig()
    design = problem.design.check(design)
    pieces: list[Trajectory] = []
    updates: list[OnlineUpdate] = []
    train: list[Residuals] = []
    test: list[Residuals] = []
    count = _possible_updates(len(x0), disturbance.shape[1], config)
    for stretch in _stretches(len(x0), disturbance.shape[1], count + 1):
        runs, steps = stretch
        start = pieces[-1].states[:, -1] if pieces and steps.start > 0 else x0[runs]
        policy = LearnedPolicy(agent, design)
        piece = deploy(
            plant, policy, design, disturbance[runs, steps], x0=start, limit=problem.limit, progress=progress
        )
        pieces.append(piece)
        if len(pieces) <= count and not piece.diverged.all():
            after = sum(p.inputs.shape[0] * p.inputs.shape[1] for p in pieces)
            first, rest = _split(residuals(problem.model, piece), config.held_out)
            if min(first.x.shape[1], rest.x.shape[1]) < config.window:
                continue  # too few runs of this stretch survived
            train.append(first)
            test.append(rest)
            agent, update = _update(problem, agent, design, (train, test), after, rng, config)
            updates.append(update)
    return Deployment(_joined(pieces, len(x0)), agent, tuple(updates))


def _update(problem, agent, design, errors, after: int, rng, config) -> tuple[ActorCritic, OnlineUpdate]:
    train, test = errors
    candidate = codesign_ppo(
        replay_problem(problem, train, config.window), agent=agent, design=design, rng=rng, config=config.training
    ).agent
    judge = replay_problem(problem, test, config.window)
    x0, w = Replay(tuple(test)).disjoint(config.window)
    chosen = rng.permutation(len(x0))[: config.judged]
    x0, w = x0[chosen], w[chosen]
    returns = [
        simulate(
            judge.model, LearnedPolicy(a, design), x0=x0, steps=config.window, disturbance=w, design=design,
            limit=problem.limit,
        ).returns(problem.objective)
        for a in (candidate, agent)
    ]  # fmt: skip
    gain = paired_difference(*returns)
    accepted = gain.ci95[0] > 0
    return (candidate if accepted else agent), OnlineUpdate(after, gain, accepted)


def replay_problem(problem: CoDesignProblem, errors: Sequence[Residuals], window: int) -> CoDesignProblem:
    """The nominal model driven by logged errors, which enter as they are (E = I)."""
    model = replace(problem.model, E=ca.SX.eye(problem.model.nx))
    return replace(problem, model=model, scenarios=Replay(tuple(errors)), steps=window, discrepancy=None)


def _split(errors: Residuals, held_out: float) -> tuple[Residuals, Residuals]:
    runs, steps = errors.x.shape[:2]
    if runs > 1:
        cut = max(1, runs - max(1, round(held_out * runs)))
        return errors.part(slice(None, cut), slice(None)), errors.part(slice(cut, None), slice(None))
    cut = steps - round(held_out * steps)
    return errors.part(slice(None), slice(None, cut)), errors.part(slice(None), slice(cut, None))


def _possible_updates(runs: int, steps: int, config: OnlineConfig) -> int:
    """As many updates as leave every stretch a window to be judged on, at most `config.updates`."""
    stretches = runs // 2 if runs > 1 else int(steps * config.held_out // config.window)
    return min(config.updates, max(0, stretches - 1))


def _stretches(runs: int, steps: int, pieces: int) -> list[tuple[slice, slice]]:
    """(runs, steps) of each stretch: groups of runs, or parts of the only run."""
    if runs > 1:
        edges = np.unique(np.linspace(0, runs, pieces + 1).round().astype(int))
        return [(slice(a, b), slice(0, steps)) for a, b in pairwise(edges)]
    edges = np.unique(np.linspace(0, steps, pieces + 1).round().astype(int))
    return [(slice(0, 1), slice(a, b)) for a, b in pairwise(edges)]


def _joined(pieces: Sequence[Trajectory], runs: int) -> Trajectory:
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
        states[:, lost[0] + 1 :], inputs[:, lost[0] + 1 :] = states[:, lost[0] + 1, None], 0.0
    return Trajectory(states, inputs, disturbances, np.array([lost[0] if lost else -1]), first.design, first.dt)
