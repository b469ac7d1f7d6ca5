"""Logged errors replayed as disturbances: the problems that a redesign is trained and judged on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from ccdtools.arrays import Array, Immutable
from ccdtools.checks import as_count, as_generator, as_instance, shown
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.exceptions import InputError
from ccdtools.twin.residuals import Residuals
from ccdtools.twin.twin import DigitalTwin


@dataclass(frozen=True, eq=False, repr=False)
class Replay(Immutable):
    """Scenarios from logged errors: each episode starts where the log was, and meets the errors it met.

    Parameters
    ----------
    logs : sequence of Residuals
        Drawn from in proportion to the windows they hold.
    """

    logs: Sequence[Residuals]

    def __post_init__(self) -> None:
        logs = tuple(self.logs) if isinstance(self.logs, list | tuple) else (self.logs,)
        if not logs or not all(isinstance(log, Residuals) for log in logs):
            raise InputError("logs", shown(self.logs), "at least one Residuals")
        object.__setattr__(self, "logs", logs)

    def __repr__(self) -> str:
        return f"Replay({', '.join(map(repr, self.logs))})"

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Initial states (runs, nx) and errors (runs, steps, nx).

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
        for errors, first, last in zip(self.logs, edges[:-1], edges[1:]):
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
        x0 = []
        w = []
        for errors in self.logs:
            length, nx = errors.e_next.shape[1:]
            whole = length // steps * steps
            x0.append(errors.x[:, :whole:steps].reshape(-1, nx))
            w.append(errors.e_next[:, :whole].reshape(-1, steps, nx))
        return np.concatenate(x0), np.concatenate(w)

    def _require(self, steps: int) -> None:
        """Raise an `InputError` unless some logged run is as long as `steps`."""
        as_count("steps", steps)
        longest = max(errors.x.shape[1] for errors in self.logs)
        if longest < steps:
            raise InputError("steps", steps, f"at most {longest}, the length of the longest logged run")


def replay_problem(problem: CoDesignProblem, errors: Sequence[Residuals], window: int) -> CoDesignProblem:
    """The nominal model driven by logged errors, which enter as they are (E = I).

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
    model = replace(problem.model, E=ca.SX.eye(problem.model.nx))
    return replace(problem, model=model, scenarios=Replay(errors), steps=window, discrepancy=None)


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
