"""Switchback trial on a real plant."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, Immutable
from ccdtools.co_design.problem import CoDesignProblem, as_seen_problem
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.excited import Excited
from ccdtools.evidence.switchback import Trial, TrialStatus
from ccdtools.exceptions import CCDError, InputError
from ccdtools.plants.models import Simulable
from ccdtools.scenario import Scenario
from ccdtools.simulation import simulate
from ccdtools.tolerances import FEWEST_PAIRS, NOT_WORSE
from ccdtools.trajectory import Trajectory
from ccdtools.twin.identified import identified_plant
from ccdtools.twin.pieces import joined
from ccdtools_ground.door import as_count, as_generator, as_instance, as_number, as_share


@dataclass(frozen=True)
class TrialConfig:
    """Settings of a switchback trial.

    Attributes
    ----------
    block, washout : int
        Samples of a block that count, and those after each switch that do not, so that the state forgets the other law;
        of several runs each is a block of its own, all of which counts.
    margin : float
        Gain that is worth an update, as a part of the return of a block.
    level : float
        Probability of ever adopting a candidate that is not better.
    excitation : float
        Standard deviation of noise on the inputs of both laws, as a part of half the range of each input.
    """

    block: int = 100
    washout: int = 20
    margin: float = NOT_WORSE
    level: float = 0.05
    excitation: float = 0.0

    def __post_init__(self) -> None:
        as_count("block", self.block)
        as_count("washout", self.washout, least=0)
        as_share("margin", self.margin)
        as_share("level", self.level)
        as_number("excitation", self.excitation, expected="a fraction from 0 to 1", low=0.0, high=1.0)

    def pairs(self, runs: int, steps: int) -> int:
        """Pairs of blocks that a deployment has room for."""
        return (runs if runs > 1 else steps // (self.block + self.washout)) // 2


@dataclass(frozen=True, eq=False)
class TriedDeployment(Immutable):
    """Deployment that begins with a trial."""

    trial: Trial
    log: Trajectory
    samples: int  # of all runs, that the trial took
    model: Simulable | None = None  # what foretold beside the nominal model


def switchback_on(
    problem: CoDesignProblem, plant: Simulable, current: Controller, candidate: Controller, design: ArrayLike, *,
    x0: ArrayLike, disturbance: ArrayLike, rng: np.random.Generator, config: TrialConfig | None = None,
    before: Trial | None = None, model: Simulable | None = None,
) -> TriedDeployment:  # fmt: skip
    """Deployment on a real plant with the trial of a candidate.

    Both take turns over the blocks of a single run, or over several runs, and a coin draws who begins each pair. What
    the best of several models predicts of a pair, the mean under both laws on the same disturbance, is taken out of its
    gain, or a share of it; which is best, or none, the other pairs tell. So a trial ends the sooner the better a model
    is, and one that is wrong may leave it undecided. For the level see `switchback`: what a candidate does in a gust
    that it never drove through is not known. The margin is a part of the returns of the first 20 pairs, which are
    driven to their end, however much a candidate costs, unless a run is lost. A law with memory begins afresh in every
    block. A candidate that loses a run is rejected, unless both lose theirs; a run that the law in service alone loses
    speaks for the candidate, and ends a trial of a single run.

    Parameters
    ----------
    problem : CoDesignProblem
        Gives the nominal model, the objective, and when a run is lost.
    plant : Plant, or anything else that `simulate` takes
        The real one.
    design : (np,) array_like
    x0 : (nx,) or (n, nx) array_like
    disturbance : (T, nw) or (n, T, nw) array_like
        As recorded: the model meets it, too.
    before : Trial, optional
        An undecided trial that goes on, with the `model` of its deployment.
    model : Plant, or anything else that `simulate` takes, optional
        What predicts the returns beside the nominal model, such as `identified_plant` of a former log; by default that
        of the first 20 pairs.

    Raises
    ------
    InputError
        If a new trial has room for fewer than 20 pairs of blocks, or the plant has another sampling time; else as
        `simulate`.
    """
    config = TrialConfig() if config is None else as_instance("config", config, TrialConfig, "a TrialConfig")
    as_seen_problem(problem)
    as_generator("rng", rng)
    blocks = _Blocks(problem, Scenario(plant, x0, disturbance), problem.design.check_one(design), config, rng)
    pairs, rate = config.pairs(*blocks.whole.disturbance.shape[:2]), getattr(plant, "dt", problem.model.dt)
    if not np.isclose(rate, problem.model.dt):
        raise InputError("plant", f"dt = {rate:g} s", f"dt = {problem.model.dt:g} s of the model")
    if before is None and pairs < FEWEST_PAIRS:
        raise InputError("disturbance", f"room for {pairs} pairs of blocks", f"at least {FEWEST_PAIRS}")
    laws = (current, candidate)
    foretold = [blocks.predicted(one, laws) for one in (problem.model, model) if one is not None]
    trial = before
    if trial is None:
        trial = Trial([], config.margin * (blocks.size(np.nan_to_num(foretold[0]).mean()) or 1.0), config.level)
    _check_begun_with(trial, foretold, model)
    earlier, known = trial.gains, trial.told
    driven: list[tuple[int, int, list[float]]] = []  # first block of a pair, whose it is, and returns
    pieces: list[Trajectory] = []
    while len(pieces) < 2 * pairs and trial.status is TrialStatus.UNDECIDED:
        order = rng.permutation(2)
        for law in order:
            pieces.append(blocks.drive(laws[law], pieces))
        lost = [int(law) for law, piece in zip(order, pieces[-2:]) if piece.diverged.any()]
        if lost:  # in a single run the first one, as nothing goes on from there
            by = lost[:1] if not blocks.several else lost if len(lost) == 1 else []
            trial = replace(trial, lost=by == [1], lost_before=trial.lost_before + (by == [0]))
            if blocks.several:
                continue
            break
        driven.append((len(pieces) - 2, order[1] - order[0], [blocks.returned(piece) for piece in pieces[-2:]]))
        firsts, turns, returns = (np.array(one) for one in zip(*driven))
        undecided = not len(earlier) and len(driven) <= FEWEST_PAIRS
        if undecided and model is None and len(driven) == FEWEST_PAIRS:
            with suppress(CCDError, RuntimeError):  # of a model that gives no number at a state of the real plant
                own = identified_plant(problem, [piece for piece in pieces if not piece.diverged.any()])
                foretold.append(blocks.predicted(own, laws))
                model = own
        if undecided:
            trial = replace(trial, margin=config.margin * blocks.size(returns.mean()) or trial.margin)
        told = np.column_stack([np.diff(returns)[:, 0], *[one[firsts + 1] - one[firsts] for one in foretold]])
        told = np.vstack([known, np.nan_to_num(told)]) if len(known) else np.nan_to_num(told)
        left = told[:, 0] - _taken_out(told, max(FEWEST_PAIRS - len(earlier) + len(known), 0))
        trial = replace(trial, gains=np.append(earlier, turns * left[len(known) :]), told=told)
    samples = len(pieces) * blocks.length
    stays = candidate if trial.status is TrialStatus.ADOPTED else current
    log = joined([*pieces, *blocks.rest(stays, pieces)], len(blocks.whole.x0))
    return TriedDeployment(trial, log, samples, model)


def _taken_out(told: Array, together: int) -> Array:
    """What is taken out of the change within each pair (n,).

    Of nothing, what a model foretells and a share of it, for every model, that which fits best the pairs before it; one
    for the first ones, which are judged together. Shares are those by least squares of the other pairs.
    """
    changes, expected, n = told[:, :1], told[:, 1:], np.arange(len(told))
    seen = n < np.maximum(n, together)[:, None]
    others = seen & (n != n[:, None])
    size = others @ expected**2
    share = np.divide(others @ (changes * expected), size, out=np.zeros_like(size), where=size > 0)
    ways = np.column_stack([np.zeros(len(n)), expected, share * expected])
    return np.asarray(ways[n, np.argmin(seen @ (changes - ways) ** 2, axis=1)])


def _check_begun_with(trial: Trial, foretold: Sequence[Array], model: Simulable | None) -> None:
    """Raise unless a trial began with as many models."""
    if len(trial.told) and trial.told.shape[1] != 1 + len(foretold):
        got, began = ("none", "the model that") if model is None else ("one", "none, as")
        raise InputError("model", got, f"{began} the trial began with", "See `TriedDeployment.model`.")


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Blocks of a deployment, driven one after the other."""

    problem: CoDesignProblem
    whole: Scenario
    design: Array
    config: TrialConfig
    rng: np.random.Generator

    @property
    def several(self) -> bool:
        """Whether each run is a block."""
        return len(self.whole.x0) > 1

    @property
    def counted(self) -> int:
        """Last steps of a block, which count."""
        return self.whole.steps if self.several else self.config.block

    @property
    def length(self) -> int:
        """Steps of a block with its washout."""
        return self.whole.steps if self.several else self.config.block + self.config.washout

    def size(self, value: float) -> float:
        """Size of a block's return, without the design cost."""
        return float(self.problem.objective.made_by_control(value, self.design, self.counted))

    def predicted(self, model: Simulable, laws: Sequence[Controller]) -> Array:
        """Mean returns (blocks,) of laws; NaN once one is lost."""
        whole = replace(self.whole, plant=model)
        runs = [whole.run(law, design=self.design, limit=self.problem.limit) for law in laws]
        rewards = np.mean([run.rewards(self.problem.objective) for run in runs], axis=0)
        steps = np.arange(rewards.shape[1])
        lost = np.any([run.diverged[:, None] & (steps >= run.diverged_at[:, None]) for run in runs], axis=0)
        rewards[lost] = np.nan
        blocks = rewards[:, : rewards.shape[1] // self.length * self.length].reshape(-1, self.length)
        returns = blocks[:, -self.counted :].sum(axis=1)
        with np.errstate(over="ignore"):
            return np.where(np.isfinite(returns**2), returns, np.nan)

    def returned(self, piece: Trajectory) -> float:
        """Return of a block, without its washout."""
        return float(piece.rewards(self.problem.objective)[0, -self.counted :].sum())

    def drive(self, law: Controller, pieces: list[Trajectory]) -> Trajectory:
        """Log of a law over the next block."""
        if self.config.excitation:
            lower, upper = (np.asarray(bound) for bound in self.problem.input_bounds_at(self.design))
            noise = self.rng.standard_normal((self.length, len(lower)))
            law = Excited(law, self.config.excitation * (upper - lower) / 2 * noise, lower, upper)
        return self._driven(law, pieces, slice(len(pieces), len(pieces) + 1), self.length)

    def rest(self, law: Controller, pieces: list[Trajectory]) -> list[Trajectory]:
        """Log of a law after the blocks, if anything is left."""
        runs, steps = self.whole.disturbance.shape[:2]
        left = runs - len(pieces) if self.several else steps - len(pieces) * self.length
        return [self._driven(law, pieces, slice(len(pieces), runs), steps if self.several else left)] if left else []

    def _driven(self, law: Controller, pieces: list[Trajectory], runs: slice, steps: int) -> Trajectory:
        """Log of some of several runs, or of next steps."""
        x0 = self.whole.x0[runs] if self.several else pieces[-1].states[:, -1] if pieces else self.whole.x0
        w = self.whole.disturbance[runs] if self.several else self.whole.disturbance[:, len(pieces) * self.length :]
        return simulate(
            self.whole.plant, law, x0=x0, steps=steps, disturbance=w, design=self.design, limit=self.problem.limit
        )
