"""Logged errors replayed as disturbances: the problems that a redesign is trained and judged on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ccdtools.arrays import Array, Immutable, frozen
from ccdtools.checks import as_count, as_generator, as_instance, shown
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.exceptions import InputError
from ccdtools.twin.residuals import Residuals
from ccdtools.twin.transport import ErrorSplit
from ccdtools.twin.twin import DigitalTwin


@dataclass(frozen=True, eq=False, repr=False)
class Replay(Immutable):
    """Scenarios from logged errors: each episode starts where the log was, and meets the errors it met.

    Parameters
    ----------
    logs : sequence of Residuals
        Drawn from in proportion to the windows they hold.
    split : ErrorSplit, optional
        Of every error into (ŵ, r), for the model that these drive at any design; without it errors are as logged.
    """

    logs: Sequence[Residuals]
    split: ErrorSplit | None = None
    _entering: tuple[Array, ...] = field(init=False)

    def __post_init__(self) -> None:
        logs = tuple(self.logs) if isinstance(self.logs, list | tuple) else (self.logs,)
        if not logs or not all(isinstance(log, Residuals) for log in logs):
            raise InputError("logs", shown(self.logs), "at least one Residuals")
        object.__setattr__(self, "logs", logs)
        if self.split is not None:
            as_instance("split", self.split, ErrorSplit, "an ErrorSplit or None")
        split = self.split
        entering = tuple(frozen(log.e_next if split is None else split.disturbances(log)) for log in logs)
        object.__setattr__(self, "_entering", entering)

    def __repr__(self) -> str:
        return f"Replay({', '.join(map(repr, self.logs))})"

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Initial states (runs, nx) and errors (runs, steps, nx), or (ŵ, r) (runs, steps, nw + nx) if they are split.

        Raises
        ------
        InputError
            If no logged run is as long as `steps`.
        """
        as_count("runs", runs)
        as_generator("rng", rng)
        self._require(steps)
        windows = np.array([len(e.x) * max(e.x.shape[1] - steps + 1, 0) for e in self.logs])
        draw = np.sort(rng.integers(0, windows.sum(), runs))
        edges = np.concatenate([[0], np.cumsum(windows)])
        x0 = []
        w = []
        for errors, entering, first, last in zip(self.logs, self._entering, edges[:-1], edges[1:]):
            chosen = draw[(draw >= first) & (draw < last)] - first
            run, start = np.divmod(chosen, max(errors.x.shape[1] - steps + 1, 1))
            x0.append(errors.x[run, start])
            w.append(entering[run[:, None], start[:, None] + np.arange(steps)])
        return np.concatenate(x0), np.concatenate(w)

    def disjoint(self, steps: int) -> tuple[Array, Array]:
        """Initial states (n, nx) and errors (n, steps, ·) of windows that share no sample: independent evidence.

        Raises
        ------
        InputError
            If no logged run is as long as `steps`.
        """
        self._require(steps)
        x0 = []
        w = []
        for errors, entering in zip(self.logs, self._entering):
            whole = errors.steps // steps * steps
            x0.append(errors.x[:, :whole:steps].reshape(-1, errors.x.shape[2]))
            w.append(entering[:, :whole].reshape(-1, steps, entering.shape[2]))
        return np.concatenate(x0), np.concatenate(w)

    def _require(self, steps: int) -> None:
        """Raise an `InputError` unless some logged run is as long as `steps`."""
        as_count("steps", steps)
        longest = max(errors.x.shape[1] for errors in self.logs)
        if longest < steps:
            raise InputError("steps", steps, f"at most {longest}, the length of the longest logged run")


def replay_problem(problem: CoDesignProblem, errors: Sequence[Residuals], window: int) -> CoDesignProblem:
    """The nominal model driven by logged errors, as they would be at whichever design.

    An error logged at p is split into E(p) ŵ and a rest r; at a design q it is E(q) ŵ + r, so that the scenarios are
    (ŵ, r) and the model has [E(q) I] in the place of E(q).

    Parameters
    ----------
    problem : CoDesignProblem
    errors : Residuals, or a sequence of them
        What a `DigitalTwin` keeps of its logs: `twin.logs`.
    window : int
        Length of an episode; at most that of the longest logged run.

    Raises
    ------
    InputError
        If an argument is of another kind, or no logged run is as long as `window`.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    split = ErrorSplit(problem.model, problem.state_scale)
    return replace(
        problem, model=split.replayed_model, scenarios=Replay(errors, split), steps=window, discrepancy=None
    )  # fmt: skip


def updated_problem(problem: CoDesignProblem, twin: DigitalTwin) -> CoDesignProblem:
    """`problem` on the updated model: nominal + median, its unexplained rest replayed from the logs.

    Episodes start where the log was; the width of the quantiles is penalised.

    Raises
    ------
    InputError
        If the twin has learned nothing yet.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    as_instance("twin", twin, DigitalTwin, "a DigitalTwin")
    if twin.discrepancy is None:
        raise InputError("twin", "one without a discrepancy", "one after `update`")
    logs = twin.innovations()
    steps = min(problem.steps, min(log.steps for log in logs))
    discrepancy = replace(twin.discrepancy, noise="replayed")
    return replace(problem, discrepancy=discrepancy, scenarios=Replay(logs), steps=steps)
