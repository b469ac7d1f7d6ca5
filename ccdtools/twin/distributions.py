"""Starts and disturbances that a learned change will serve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ccdtools.arrays import Array, Indices
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.random_starts import RandomStarts, uniform_in
from ccdtools.evidence.evidence import Asked
from ccdtools.scenario import Scenario
from ccdtools.twin.replay import Replay
from ccdtools.twin.residuals import Residuals, groups
from ccdtools.twin.transport import ErrorSplit
from ccdtools.twin.updated_plant import UpdatedPlant
from mpc import MPCError

REPLAY = "the replayed log"
UPDATED = "the log on the updated model"
START = "the study's start"
BOX = "the box of starts"
NOMINAL = "the nominal model"


@dataclass(frozen=True, eq=False)
class Distribution:
    """Named starts and disturbances, with what a candidate must show there.

    `groups` and `series` as for `Pairing.evidence`; of every run the last `counted` steps count, or all.
    """

    name: str
    scenario: Scenario
    asked: Asked
    groups: Indices | None = None
    series: bool = False
    counted: int | None = None


@dataclass(frozen=True, eq=False)
class ServedDistributions:
    """Distributions that a change will serve besides the logged runs."""

    problem: CoDesignProblem  # on the nominal model, with the starts that the study declares
    x0: Array  # (nx,): start of the real plant
    # held-out disturbances by name: draws that no report is measured on
    kinds: Mapping[str, Array] = field(default_factory=dict)  # (n, T, nw)
    runs: int = 400  # from the study's start, and from its box

    def starts(self, rng: np.random.Generator) -> Array:
        """Starts (n, nx) that the study declares: one, or draws."""
        return self.problem.scenarios.sample(self.runs, self.problem.steps, rng)[0]

    def box(self, design: Array, rng: np.random.Generator) -> Array:
        """Starts (n, nx) drawn as the study declares, else those LQR keeps within X.

        Uniform in X, these are the states from which saturated LQR at the design, under the disturbance that the model
        assumes, loses no run and never leaves X. None where there is no such state, or no LQR.
        """
        scenarios = self.problem.scenarios
        if isinstance(scenarios, RandomStarts):
            return scenarios.states(self.runs, rng)
        X = self.problem.state_limits(design)
        x0 = uniform_in(X, 8 * self.runs, rng)  # LQR keeps only some of them within X
        w = self.problem.driving(len(x0), self.problem.steps, rng)
        try:
            run = Scenario(self.problem.model, x0, w).run(
                saturated_lqr(self.problem, design), design=design, limit=self.problem.limit
            )
        except MPCError:
            return x0[:0]
        kept = ~run.diverged & X.contains(run.states.reshape(-1, X.dim)).reshape(run.states.shape[:2]).all(axis=1)
        return np.asarray(x0[kept][: self.runs])

    def trained_from(self, design: Array, rng: np.random.Generator) -> Array:
        """Training starts (n, nx) beside the log: half the study's, half its box's."""
        box = self.box(design, rng)
        starts = self.starts(rng)
        return np.concatenate([starts[: max(len(box), 1)], box])

    def on(
        self, logs: Sequence[Residuals], plant: UpdatedPlant, design: Array, rng: np.random.Generator
    ) -> list[Distribution]:
        """Distributions beside the log that a change will serve, on the updated model."""
        drawn = {name: plant.drawn(logs, w) for name, w in self.kinds.items()}
        found = [Distribution(name, Scenario(plant, np.tile(self.x0, (len(w), 1)), w), Asked.TOLERANCE)
                 for name, w in drawn.items()]  # fmt: skip
        replay = Replay(plant.unexplained(logs), plant.split)
        steps = min(self.problem.steps, max(log.steps for log in replay.logs))
        for name, x0 in ((START, self.starts(rng)), (BOX, self.box(design, rng))):
            if len(x0):
                _, w, labels = replay.windows(len(x0), steps, rng)
                found.append(Distribution(name, Scenario(plant, x0, w), Asked.TOLERANCE, labels))
        return found

    def nominal(self, rng: np.random.Generator) -> Distribution:
        """Nominal model from the study's starts, only shown: correcting a bias loses there."""
        x0, w = self.problem.scenarios.sample(self.runs, self.problem.steps, rng)
        return Distribution(NOMINAL, Scenario(self.problem.model, x0, w), Asked.SHOWN)


def logged(by: ErrorSplit | UpdatedPlant, logs: Sequence[Residuals], *, series: bool, most: int,
           rng: np.random.Generator, held_out: float | None = None) -> Distribution:  # fmt: skip
    """Whole logged runs, at most `most`, on which a change must bring a gain.

    Parameters
    ----------
    by : ErrorSplit or UpdatedPlant
        The nominal model under whole errors, which a change was made for; or the updated one, whose errors follow the
        candidate.
    series : bool
        Whether the logs are consecutive parts of one run, of which the last fraction `held_out` counts, or all of it.
    """
    if isinstance(by, UpdatedPlant):
        name = UPDATED
        plant: Any = by
        replay = Replay(by.unexplained(logs), by.split)
    else:
        name = REPLAY
        plant = by.replayed_model
        replay = Replay(tuple(logs), by)
    x0, w = replay.whole()
    chosen = np.arange(len(x0)) if series or len(x0) <= most else rng.permutation(len(x0))[:most]
    counted = None if held_out is None else round(held_out * w.shape[1])
    scenario = Scenario(plant, x0[chosen], w[chosen])
    return Distribution(name, scenario, Asked.GAIN, groups(replay.logs)[chosen], series, counted)
