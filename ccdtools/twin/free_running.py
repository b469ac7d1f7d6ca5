"""Free-running bands: whether many steps of the updated model cover the log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccdtools.arrays import Array, Immutable, frozen
from ccdtools.checks import as_count, as_generator, as_instance, as_share, shown
from ccdtools.controllers.controllers import Controller
from ccdtools.exceptions import InputError
from ccdtools.simulation import simulate
from ccdtools.trajectory import Trajectory
from ccdtools.twin.budgets import BLOCKS
from ccdtools.twin.discrepancy import TwinPlant
from ccdtools.twin.residuals import Residuals, block_spans, residuals
from ccdtools.twin.tolerances import HELD_OUT, RUNAWAY
from ccdtools.twin.transport import carried
from ccdtools.twin.twin import DigitalTwin


@dataclass(frozen=True, eq=False, repr=False)
class FreeRunningBands(Immutable):
    """Bands of states drawn from a twin, and their coverage of the plant.

    Attributes
    ----------
    steps : (H,) int array
        How many steps after the start.
    lower, upper, actual : (H, n, nx) arrays
        The 10 % and 90 % quantiles of the draws of n windows, and the logged states.
    coverage : (H, nx) array
        Fraction of windows whose logged state lies within the band; 0.8 is right.
    joint : (H,) array
        Fraction of windows with every state within its band. Even right bands cover states that are not fully
        correlated less often together than one by one.
    spread : (H, nx) array
        Root mean square deviation of the draws from their mean over that of the logged states from it; 1 is right.
    """

    steps: NDArray[np.int64]
    lower: Array
    upper: Array
    actual: Array
    coverage: Array
    joint: Array
    spread: Array

    def __post_init__(self) -> None:
        for name in ("steps", "lower", "upper", "actual", "coverage", "joint", "spread"):
            object.__setattr__(self, name, frozen(np.asarray(getattr(self, name))))

    def __repr__(self) -> str:
        covered = "; ".join(
            f"{step} steps {', '.join(f'{c:.0%}' for c in row)}" for step, row in zip(self.steps, self.coverage)
        )
        return f"FreeRunningBands({self.actual.shape[1]} windows, coverage of 80 %: {covered})"

    def summary(self) -> dict[str, Any]:
        """Plain values: the measures without the bands."""
        measures = {name: getattr(self, name).tolist() for name in ("steps", "coverage", "joint", "spread")}
        return measures | {"windows": self.actual.shape[1]}


def free_running_bands(
    twin: DigitalTwin,
    log: Trajectory,
    controller: Controller,
    *,
    rng: np.random.Generator,
    steps: Sequence[int] = (10, 50, 100),
    draws: int = 100,
    windows: int = 200,
    held_out: float | None = None,
    blocks: int = BLOCKS,
    since: int = 0,
) -> FreeRunningBands:
    """Closed-loop bands of `twin` from logged states, compared with what followed.

    The draws know the state and the error at the start of a window, and nothing of what follows.

    Parameters
    ----------
    twin : DigitalTwin
        After `update`.
    log : Trajectory
        Of the plant under `controller`: one that the twin did not learn from, or with `held_out` one that it did.
    controller : Controller
        Closes the loop of the draws, as it did that of the log.
    rng : numpy.random.Generator
    steps : sequence of int
        Those longer than every window that the log offers are left out.
    draws : int
        Per window.
    windows : int
        At most so many, evenly spread over the log.
    held_out : float, optional
        As given to `update` (0.2 by default there): windows then lie within the parts that were held out of it.
    blocks : int
        As given to `update`.
    since : int
        Samples at the start of the log, run after run, to leave out: of a former policy, say.

    Raises
    ------
    InputError
        If the twin has learned nothing, or a median alone, the log is of another plant, or no window is as long as any
        of the steps.
    """
    as_instance("twin", twin, DigitalTwin, "a DigitalTwin")
    if twin.discrepancy is None:
        raise InputError("twin", "one without a discrepancy", "one after `update`")
    if not _drawable(twin):
        got = f"one that has learned {len(twin.discrepancy.network.levels)} quantile, from which nothing can be drawn"
        raise InputError("twin", got, "one of at least three levels", "Set `QuantileConfig(levels=…)`.")
    as_generator("rng", rng)
    draws, windows = as_count("draws", draws, least=2), as_count("windows", windows)
    errors = residuals(twin.model, log)
    since = as_count("since", since, least=0)
    if held_out is not None:
        held_out = as_share("held_out", held_out)
    spans = _spans(log, errors, held_out, as_count("blocks", blocks), since)
    horizons = _fitting(steps, spans)
    starts = _starts(spans, horizons[-1], windows)
    drawn = _draws(twin, errors, controller, starts, horizons[-1], draws, rng)
    last = twin.model.undisturbed(errors.p)(errors.x[:, -1:], errors.u[:, -1:]) + errors.e_next[:, -1:]
    states = np.concatenate([errors.x, last], axis=1)
    return _compared(horizons, drawn, np.stack([states[starts[:, 0], starts[:, 1] + h] for h in horizons]))


def held_out_bands(
    twin: DigitalTwin, log: Trajectory, controller: Controller, *, rng: np.random.Generator, since: int = 0
) -> FreeRunningBands | None:
    """Bands on the held-out stretches of the twin's newest log.

    None where these are too short, or the twin has learned a median alone.
    """
    spans = _spans(log, twin.logs[-1], HELD_OUT, BLOCKS, since)
    if not _drawable(twin) or max((end - first for _, first, end in spans), default=0) < 10:
        return None
    return free_running_bands(twin, log, controller, rng=rng, windows=150, held_out=HELD_OUT, since=since)


def _drawable(twin: DigitalTwin) -> bool:
    return twin.discrepancy is not None and len(twin.discrepancy.network.levels) >= 3


Span = tuple[int, int, int]  # run, first sample, one past the last


def _spans(log: Trajectory, errors: Residuals, held_out: float | None, blocks: int, since: int) -> list[Span]:
    """Stretches for windows, run after run, without the first `since` samples."""
    parts = [(slice(0, errors.runs), slice(0, errors.steps))]
    if held_out is not None:
        parts = block_spans(errors, held_out, blocks, last=True)
    run, sample = divmod(since, errors.steps)
    later = np.flatnonzero(~log.diverged) - run  # the errors are those of the runs that did not diverge
    spans = []
    for runs, steps in parts:
        for kept in range(runs.start, runs.stop):
            first = max(steps.start, sample) if later[kept] == 0 else steps.start
            if later[kept] >= 0 and first < steps.stop:
                spans.append((kept, first, steps.stop))
    return spans


def _fitting(steps: Sequence[int], spans: Sequence[Span]) -> NDArray[np.int64]:
    """Increasing horizons that some span is long enough for."""
    given = list(steps) if isinstance(steps, list | tuple | range | np.ndarray) else [steps]
    wanted = sorted({as_count("steps", step) for step in given})
    longest = max((end - first for _, first, end in spans), default=0)
    kept = [step for step in wanted if step <= longest]
    if not kept:
        raise InputError("steps", shown(tuple(wanted)), f"at most {longest}, the longest stretch that the log offers")
    return np.array(kept)


def _starts(spans: Sequence[Span], length: int, windows: int) -> NDArray[np.int64]:
    """Run and first sample (n, 2) of windows, spread evenly over the spans."""
    every = np.array([(run, k) for run, first, end in spans for k in range(first, end - length + 1)])
    return np.asarray(every[np.unique(np.linspace(0, len(every) - 1, min(windows, len(every))).round().astype(int))])


def _draws(
    twin: DigitalTwin, errors: Residuals, controller: Controller, starts: NDArray[np.int64], length: int, draws: int,
    rng: np.random.Generator,
) -> Array:  # fmt: skip
    """Drawn states (n, draws, length + 1, nx) from the logged starts (n, 2)."""
    assert twin.discrepancy is not None
    discrepancy = replace(twin.discrepancy, noise="quantiles")
    assert twin.scale is not None
    newest = twin.logs[-1].p  # the network works in the coordinates of its design
    past = carried(twin.model, errors, newest, twin.scale).e[starts[:, 0], starts[:, 1]]
    plant = TwinPlant(twin.model, discrepancy, np.repeat(past, draws, axis=0))
    x0 = np.repeat(errors.x[starts[:, 0], starts[:, 1]], draws, axis=0)
    w = rng.random((len(x0), length, twin.model.nx))
    limit = RUNAWAY * np.maximum(np.abs(errors.x).max(axis=(0, 1)), np.finfo(float).tiny)
    run = simulate(plant, controller, x0=x0, steps=length, disturbance=w, design=errors.p, limit=limit)
    return np.clip(run.states, -limit, limit).reshape(len(starts), draws, length + 1, -1)


def _compared(horizons: NDArray[np.int64], drawn: Array, actual: Array) -> FreeRunningBands:
    """Bands of draws (n, draws, T + 1, nx) beside actual states (H, n, nx)."""
    at = np.moveaxis(drawn[:, :, horizons], 2, 0)
    lower, upper = np.quantile(at, (0.1, 0.9), axis=2, method="weibull")  # 80 %, if draws are as good as the truth
    inside = (actual >= lower) & (actual <= upper)
    own = np.sqrt(at.var(axis=2, ddof=1).mean(axis=1) * (1 + 1 / at.shape[2]))  # their mean is uncertain, too
    true = np.sqrt(((actual - at.mean(axis=2)) ** 2).mean(axis=1))
    spread = own / np.maximum(true, np.finfo(float).tiny)
    joint = inside.all(axis=2).mean(axis=1)
    return FreeRunningBands(horizons, lower, upper, actual, inside.mean(axis=1), joint, spread)
