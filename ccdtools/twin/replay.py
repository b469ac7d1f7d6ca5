"""Logged errors replayed as disturbances, for a redesign."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ccdtools.arrays import Array, ArrayField, Immutable, Indices
from ccdtools.co_design.problem import CoDesignProblem, as_seen_problem
from ccdtools.co_design.risk import of_logged_runs
from ccdtools.exceptions import InputError
from ccdtools.trajectory import Trajectory
from ccdtools.twin.residuals import Residuals, errors_in, groups
from ccdtools.twin.transport import ErrorSplit
from ccdtools.twin.twin import DigitalTwin
from ccdtools_ground.door import as_count, as_generator, as_instance, shown

if TYPE_CHECKING:
    from ccdtools.twin.identified import IdentifiedChange
    from ccdtools.twin.plant_fit import PlantFit


@dataclass(frozen=True, eq=False, repr=False)
class Replay(Immutable):
    """Episodes from logged states that meet the errors logged there.

    Parameters
    ----------
    logs : sequence of Residuals
        Drawn from in proportion to the windows they hold.
    split : ErrorSplit, optional
        Of every error into (ŵ, r), for the model that these drive at any design; without it errors are as logged.
    starts : (m, nx) array, optional
        States that half of the windows begin in, in the place of logged ones: a policy that is trained where the log
        was, and nowhere else, is changed everywhere.
    """

    logs: Sequence[Residuals]
    split: ErrorSplit | None = None
    starts: ArrayField = None

    def __post_init__(self) -> None:
        logs = tuple(self.logs) if isinstance(self.logs, list | tuple) else (self.logs,)
        if not logs or not all(isinstance(log, Residuals) for log in logs):
            raise InputError("logs", shown(self.logs), "at least one Residuals")
        object.__setattr__(self, "logs", logs)
        if self.split is not None:
            as_instance("split", self.split, ErrorSplit, "an ErrorSplit or None")

    @cached_property
    def _entering(self) -> tuple[Array, ...]:
        """What drives the model along every log."""
        split = self.split
        return tuple(log.e_next if split is None else split.disturbances(log) for log in self.logs)

    def __repr__(self) -> str:
        return f"Replay({', '.join(map(repr, self.logs))})"

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Initial states (runs, nx) and errors (runs, steps, nx), or split (runs, steps, nw + nx).

        Raises
        ------
        InputError
            If no logged run is as long as `steps`.
        """
        x0, w, _ = self.windows(runs, steps, rng)
        if self.starts is not None and len(self.starts):
            other = rng.random(runs) < 0.5  # the other half begins where the log was
            x0[other] = self.starts[rng.integers(0, len(self.starts), int(other.sum()))]
        return x0, w

    def stretches(self, runs: int, steps: int, rng: np.random.Generator) -> Indices:
        """Logged stretch (runs,) of every sample that the generator, left as it is, would draw."""
        return self.windows(runs, steps, copy.deepcopy(rng))[2]

    def windows(self, runs: int, steps: int, rng: np.random.Generator) -> tuple[Array, Array, Indices]:
        """Samples from logged states, with one group per logged stretch."""
        as_count("runs", runs)
        as_generator("rng", rng)
        longest = max(errors.steps for errors in self.logs)
        if longest < as_count("steps", steps):
            raise InputError("steps", steps, f"at most {longest}, the length of the longest logged run")
        windows = np.array([len(e.x) * max(e.x.shape[1] - steps + 1, 0) for e in self.logs])
        drawn = rng.integers(0, windows.sum(), runs)
        order = np.argsort(drawn, kind="stable")
        draw, back = drawn[order], np.argsort(order)  # the first of many are as good as any
        edges = np.concatenate([[0], np.cumsum(windows)])
        apart = longest  # more than any log has stretches
        own = np.split(groups(self.logs), np.cumsum([log.runs for log in self.logs])[:-1])
        x0 = []
        w = []
        labels = []
        for errors, entering, alike, first, last in zip(self.logs, self._entering, own, edges[:-1], edges[1:]):
            chosen = draw[(draw >= first) & (draw < last)] - first
            run, start = np.divmod(chosen, max(errors.x.shape[1] - steps + 1, 1))
            x0.append(errors.x[run, start])
            w.append(entering[run[:, None], start[:, None] + np.arange(steps)])
            labels.append(alike[run] * apart + start // steps)
        return np.concatenate(x0)[back], np.concatenate(w)[back], np.concatenate(labels)[back]

    def whole(self) -> tuple[Array, Array]:
        """First states (n, nx) and errors (n, T, ·) of every run, for judging.

        From there on a loop goes through states of its own. A window within a run would start where another loop was,
        and what that start costs is no part of what a design earns.

        Raises
        ------
        InputError
            If the logs are not equally long.
        """
        lengths = {errors.steps for errors in self.logs}
        if len(lengths) > 1:
            raise InputError("logs", f"runs of {min(lengths)} to {max(lengths)} steps", "logs of one length")
        return np.concatenate([errors.x[:, 0] for errors in self.logs]), np.concatenate(self._entering)


def replay_problem(
    problem: CoDesignProblem, errors: Trajectory | Residuals | Sequence[Trajectory | Residuals], window: int, *,
    warm_up: int = 0, starts: ArrayField = None,
) -> CoDesignProblem:  # fmt: skip
    """Problem on the nominal model, driven by logged errors at any design.

    An error logged at p is split into E(p) ŵ and a rest r; at a design q it is E(q) ŵ + r, so that the scenarios are
    (ŵ, r) and the model has [E(q) I] in the place of E(q).

    Parameters
    ----------
    problem : CoDesignProblem
    errors : Trajectory or Residuals, or a sequence of them
        A log, as `deploy` returns it, or what a `DigitalTwin` keeps of its logs: `twin.logs`.
    window : int
        Steps that count in an episode; with `warm_up` at most those of the longest logged run.
    warm_up : int
        Steps before them that do not count: an episode starts where the log was, and these bring each design and
        policy to a state of its own.
    starts : (m, nx) array, optional
        States that half of the episodes begin in.

    Raises
    ------
    InputError
        If an argument is of another kind, or no logged run is as long as `window` and `warm_up`.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    steps = as_count("window", window) + as_count("warm_up", warm_up, least=0)
    split = ErrorSplit(problem.model, problem.state_scale)
    scenarios = Replay(errors_in(problem, errors), split, starts)
    return replace(
        problem, model=split.replayed_model, scenarios=scenarios, steps=steps, warm_up=warm_up, discrepancy=None,
        risk=of_logged_runs(problem.risk),
    )  # fmt: skip


def updated_problem(
    problem: CoDesignProblem, twin: DigitalTwin | PlantFit | IdentifiedChange, window: int | None = None, *,
    warm_up: int = 0, starts: ArrayField = None,
) -> CoDesignProblem:  # fmt: skip
    """Problem on the nominal model plus median, with the logged rest replayed.

    Episodes start where the log was; the width of the quantiles is penalised. `window`, `warm_up` and `starts` as for
    `replay_problem`; by default an episode is that of the problem, or as long as the shortest log.
    By `fit_plant`: the problem with its model at the likeliest parameters, and a constant part of w. By
    `identified_change`: with its model changed so.

    Raises
    ------
    InputError
        If the twin has learned nothing yet, the problem has sensors but the twin is no `PlantFit`, or one that leaves
        something open or was not solved, or no logged run is as long as `window` and `warm_up`.
    """
    if hasattr(twin, "updated"):  # a fit of the model, whose import takes long
        return twin.updated(as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem"))
    as_seen_problem(problem)
    as_instance("twin", twin, DigitalTwin, "a DigitalTwin")
    if twin.discrepancy is None:
        raise InputError("twin", "one without a discrepancy", "one after `update`")
    errors_in(problem, twin.logs)
    logs = twin.innovations()
    window = min(problem.steps, min(log.steps for log in logs)) if window is None else as_count("window", window)
    steps = window + as_count("warm_up", warm_up, least=0)
    discrepancy = replace(twin.discrepancy, noise="replayed")
    scenarios = Replay(logs, starts=starts)
    return replace(problem, discrepancy=discrepancy, scenarios=scenarios, steps=steps, warm_up=warm_up)
