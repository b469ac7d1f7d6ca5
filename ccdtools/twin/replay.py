"""Logged errors replayed as disturbances: the problems that a redesign is trained and judged on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ccdtools.arrays import Array, Immutable, frozen
from ccdtools.checks import as_count, as_generator, as_instance, shown
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.risk import of_logged_runs
from ccdtools.exceptions import InputError
from ccdtools.twin.recombination import Indices, dealt, drawn, shuffled
from ccdtools.twin.residuals import Residuals
from ccdtools.twin.transport import ErrorSplit
from ccdtools.twin.twin import DigitalTwin

FEWEST_ROUNDS = 2  # in which every logged error is met: with one there are no more runs than were logged
NUMBERS_AT_ONCE = 4_000_000  # errors of recombined runs that are in memory


@dataclass(frozen=True, eq=False, repr=False)
class Replay(Immutable):
    """Scenarios from logged errors: each episode starts where the log was, and meets the errors it met.

    Parameters
    ----------
    logs : sequence of Residuals
        Drawn from in proportion to the windows they hold.
    split : ErrorSplit, optional
        Of every error into (ŵ, r), for the model that these drive at any design; without it errors are as logged.

    Where runs are recombined, every step of an episode is of another run of its log, drawn at the same time.
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
        recombines = self.recombines
        draw = np.sort(rng.integers(0, windows.sum(), runs))
        edges = np.concatenate([[0], np.cumsum(windows)])
        x0 = []
        w = []
        for errors, entering, first, last in zip(self.logs, self._entering, edges[:-1], edges[1:]):
            chosen = draw[(draw >= first) & (draw < last)] - first
            run, start = np.divmod(chosen, max(errors.x.shape[1] - steps + 1, 1))
            source = drawn(run, errors.runs, steps, rng) if recombines else run[:, None]
            x0.append(errors.x[run, start])
            w.append(entering[source, start[:, None] + np.arange(steps)])
        return np.concatenate(x0), np.concatenate(w)

    def whole(self) -> tuple[Array, Array]:
        """First states (n, nx) and all errors (n, T, ·) of every run: what a controller is judged on.

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

    def blocks(self) -> Indices | None:
        """The block of every run, in the order of `whole`; None where there are too few runs."""
        return dealt(np.concatenate([errors.numbers for errors in self.logs]))

    def rounds(self, count: int) -> int:
        """How often every logged error is met in about so many recombined runs, twice at least."""
        return max(count // sum(errors.runs for errors in self.logs), FEWEST_ROUNDS)

    @property
    def recombines(self) -> bool:
        """Whether runs are recombined, to train and to judge: all logs are `independent`, and hold enough runs."""
        return all(errors.independent for errors in self.logs) and self.blocks() is not None

    def recombined(self, rounds: int, rng: np.random.Generator) -> Iterator[tuple[Array, Array, Indices]]:
        """First states, errors and blocks of recombined runs, in parts that fit into memory.

        The runs of a block of one log are recombined. In every round each of its errors is met once.

        Raises
        ------
        InputError
            If the logs are not equally long.
        """
        x0, w = self.whole()
        blocks = self.blocks()
        assert blocks is not None
        logs = np.repeat(np.arange(len(self.logs)), [errors.runs for errors in self.logs])
        own = logs * (blocks.max() + 1) + blocks
        steps = np.arange(w.shape[1])
        at_once = int(np.clip(NUMBERS_AT_ONCE // w.size, 1, rounds))
        for begun in range(0, rounds, at_once):
            n = min(at_once, rounds - begun)
            source = np.concatenate([shuffled(own, len(steps), rng) for _ in range(n)])
            yield np.tile(x0, (n, 1)), w[source, steps], np.tile(blocks, n)

    def _require(self, steps: int) -> None:
        """Raise an `InputError` unless some logged run is as long as `steps`."""
        as_count("steps", steps)
        longest = max(errors.x.shape[1] for errors in self.logs)
        if longest < steps:
            raise InputError("steps", steps, f"at most {longest}, the length of the longest logged run")


def replay_problem(
    problem: CoDesignProblem, errors: Sequence[Residuals], window: int, *, warm_up: int = 0
) -> CoDesignProblem:
    """The nominal model driven by logged errors, as they would be at whichever design.

    An error logged at p is split into E(p) ŵ and a rest r; at a design q it is E(q) ŵ + r, so that the scenarios are
    (ŵ, r) and the model has [E(q) I] in the place of E(q).

    Parameters
    ----------
    problem : CoDesignProblem
    errors : Residuals, or a sequence of them
        What a `DigitalTwin` keeps of its logs: `twin.logs`.
    window : int
        Steps that count in an episode; with `warm_up` at most those of the longest logged run.
    warm_up : int
        Steps before them that do not count: an episode starts where the log was, and these bring each design and
        policy to a state of its own.

    Raises
    ------
    InputError
        If an argument is of another kind, or no logged run is as long as `window` and `warm_up`.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    steps = as_count("window", window) + as_count("warm_up", warm_up, least=0)
    split = ErrorSplit(problem.model, problem.state_scale)
    return replace(
        problem, model=split.replayed_model, scenarios=Replay(errors, split), steps=steps, warm_up=warm_up,
        discrepancy=None, risk=of_logged_runs(problem.risk),
    )  # fmt: skip


def updated_problem(
    problem: CoDesignProblem, twin: DigitalTwin, window: int | None = None, *, warm_up: int = 0
) -> CoDesignProblem:
    """`problem` on the updated model: nominal + median, its unexplained rest replayed from the logs.

    Episodes start where the log was; the width of the quantiles is penalised. `window` and `warm_up` as for
    `replay_problem`; by default an episode is that of the problem, or as long as the shortest log.

    Raises
    ------
    InputError
        If the twin has learned nothing yet, or no logged run is as long as `window` and `warm_up`.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    as_instance("twin", twin, DigitalTwin, "a DigitalTwin")
    if twin.discrepancy is None:
        raise InputError("twin", "one without a discrepancy", "one after `update`")
    logs = twin.innovations()
    window = min(problem.steps, min(log.steps for log in logs)) if window is None else as_count("window", window)
    steps = window + as_count("warm_up", warm_up, least=0)
    discrepancy = replace(twin.discrepancy, noise="replayed")
    return replace(problem, discrepancy=discrepancy, scenarios=Replay(logs), steps=steps, warm_up=warm_up)
