"""Free-running bands: what many steps of the updated model promise of the plant."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ccdtools.arrays import Array, Immutable, Indices, frozen
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.signals import as_controller, needs_of
from ccdtools.exceptions import InputError, LimitWarning
from ccdtools.trajectory import Trajectory
from ccdtools.twin.budgets import BLOCKS
from ccdtools.twin.residuals import Residuals, residuals
from ccdtools.twin.twin import DigitalTwin
from ccdtools.twin.windows import Drawing, Span, Windows, apart, part_spans, since_spans, starts_of, whole_spans
from ccdtools_ground.door import as_count, as_generator, as_instance, as_share, shown
from learning.conformal import Conformal, samples_needed


@dataclass(frozen=True, eq=False, repr=False)
class FreeRunningBands(Immutable):
    """Calibrated bands of states drawn from a twin, and their coverage of the plant.

    Attributes
    ----------
    level : float
        What every band promises.
    steps : (H,) int array
        How many steps after the start.
    lower, upper, actual : (H, n, nx) arrays
        Bands of n windows, calibrated state by state, and the logged states.
    coverage : (H, nx) array
        Fraction of windows whose logged state lies within its band.
    joint : (H,) array
        Fraction of windows with all states within `tube` at all steps up to that one.
    spread : (H, nx) array
        Root mean square deviation of the draws from their mean over that of the logged states from it; 1 is right.
    factors : (H, n) array
        By which widths are multiplied in a tube.
    windows : Windows
        Draws before calibration, and what followed.
    """

    level: float
    steps: Indices
    lower: Array
    upper: Array
    actual: Array
    coverage: Array
    joint: Array
    spread: Array
    factors: Array
    windows: Windows

    def __post_init__(self) -> None:
        for name in ("steps", "lower", "upper", "actual", "coverage", "joint", "spread", "factors"):
            object.__setattr__(self, name, frozen(np.asarray(getattr(self, name))))

    def __repr__(self) -> str:
        covered = "; ".join(
            f"{step} steps {', '.join(f'{c:.0%}' for c in row)}" for step, row in zip(self.steps, self.coverage)
        )
        return f"FreeRunningBands({self.actual.shape[1]} windows, coverage of {100 * self.level:g} %: {covered})"

    def tube(self, steps: int) -> tuple[Array, Array]:
        """Lower and upper ends (steps, n, nx) that hold all states at all steps jointly."""
        found = np.flatnonzero(self.steps == as_count("steps", steps))
        if not len(found):
            raise InputError("steps", shown(steps), f"one of {', '.join(map(str, self.steps))}")
        return self.windows.ends(np.arange(steps), self.factors[found[0], :, None])

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
    level: float = 0.8,
) -> FreeRunningBands:
    """Closed-loop bands of `twin` from logged states, compared with what followed.

    The draws know the state and the error at the start of a window, and nothing of what follows. They are calibrated on
    windows that trained nothing: of the parts of the twin's newest log that `update` held out. Each state at each step
    is calibrated alone, and a tube over all states and steps jointly. Widths follow a power of the recent error, which
    a quantile regression over the windows that trained gives. As many windows count as do not overlap, n. Were these
    exchangeable with fresh ones, the level would be held but for 1 / (n + 1) on average over twins. That of one twin
    deviates by √(level (1 − level) / (n + 2)).

    Parameters
    ----------
    twin : DigitalTwin
        After `update`.
    log : Trajectory
        Of the plant under `controller`: one that the twin did not learn from, or with `held_out` its newest.
    controller : Controller
        Closes the loop of the draws, as it did that of both logs: one without memory is asked, and warned of.
    rng : numpy.random.Generator
    steps : sequence of int
        Those longer than every window that the log offers are left out, and those that too few windows calibrate.
    draws : int
        Per window.
    windows : int
        At most so many, evenly spread over the log; as many calibrate.
    held_out : float, optional
        As given to `update` (0.2 by default there): windows then lie within the parts that were held out of it, of
        which every other one calibrates the rest.
    blocks : int
        As given to `update`.
    since : int
        Samples at the start of the log, run after run, to leave out: of a former policy, say.
    level : float
        Share that bands are to hold, in (0, 1).

    Raises
    ------
    InputError
        If the twin has learned nothing, or a median alone, the log is of another plant, no window is as long as any
        of the steps, or too few windows calibrate: at least level / (1 − level) that do not overlap.
    """
    as_instance("twin", twin, DigitalTwin, "a DigitalTwin")
    if twin.discrepancy is None:
        raise InputError("twin", "one without a discrepancy", "one after `update`")
    if not _drawable(twin):
        got = f"one that has learned {len(twin.discrepancy.network.levels)} quantile, from which nothing can be drawn"
        raise InputError("twin", got, "one of at least three levels", "Set `QuantileConfig(levels=…)`.")
    as_generator("rng", rng)
    level = as_share("level", level)
    draws, windows = as_count("draws", draws, least=2), as_count("windows", windows, least=samples_needed(level))
    errors = residuals(twin.model, log)
    split = None if held_out is None else (as_share("held_out", held_out), as_count("blocks", blocks))
    spans, folds = _split(twin, errors, split, as_count("since", since, least=0))
    horizons = _fitting(steps, spans, folds, level)
    drawing = Drawing(twin, controller, int(horizons[-1]), draws, windows, level)
    judged = drawing.on(errors, spans, rng)
    _warn_of_another(controller, errors, starts_of(spans, 1, windows * draws))  # which can drive, as was seen
    own = twin.logs[-1]
    former = part_spans(own, twin.held_out, twin.blocks, last=False)
    trained = drawing.on(own, former, rng) if apart(former, drawing.length, 1) else None
    if split is None:
        calibrating = [drawing.on(own, folds[0], rng)]
    else:
        calibrating = [judged.part(judged.span % 2 != k) for k in (0, 1)]
    return _calibrated(horizons, judged, trained, calibrating, folds, level)


def held_out_bands(
    twin: DigitalTwin, log: Trajectory, controller: Controller, *, rng: np.random.Generator, since: int = 0
) -> FreeRunningBands | None:
    """Bands on the held-out stretches of the twin's newest log.

    None where these are too short, or the twin has learned a median alone.
    """
    spans, folds = _split(twin, twin.logs[-1], (twin.held_out, twin.blocks), since)
    if not _drawable(twin) or not _calibrable((10,), spans, folds, 0.8):
        return None
    return free_running_bands(
        twin, log, controller, rng=rng, windows=150, held_out=twin.held_out, blocks=twin.blocks, since=since
    )


def _warn_of_another(controller: Controller, errors: Residuals, at: Indices) -> None:
    """Warn if a controller without memory did not drive samples (n, 3) of a log.

    Its answers then differ from the inputs by a function of the state, which noise of exploration is not.
    """
    drawn = getattr(controller, "rng", None) is not None
    if drawn or needs_of(controller) or hasattr(controller, "reset") or hasattr(controller, "loop"):
        return
    x, u = (column[at[:, 0], at[:, 1]] for column in (errors.x, errors.u))
    answers = np.asarray(as_controller(controller)(x))
    if answers.size != u.size or len(x) < 3 * (1 + x.shape[1]):
        return
    low, high = (end(errors.u, axis=(0, 1)) for end in (np.min, np.max))
    off = np.clip(answers.astype(float).reshape(u.shape), low, high) - u
    known = np.column_stack([np.ones(len(x)), x])
    told = (known @ np.linalg.lstsq(known, off, rcond=None)[0]) ** 2
    if (told.mean(axis=0) > 0.5 * u.var(axis=0)).any():
        said = "controller: its answers to logged states differ by a function of these from the logged inputs, by more"
        cure = "Pass the controller that drove the log: bands of another loop say nothing of the twin."
        warnings.warn(f"{said} than half of their variance. {cure}", LimitWarning, stacklevel=3)


def _drawable(twin: DigitalTwin) -> bool:
    return twin.discrepancy is not None and len(twin.discrepancy.network.levels) >= 3


def _split(
    twin: DigitalTwin, errors: Residuals, split: tuple[float, int] | None, since: int
) -> tuple[list[Span], list[list[Span]]]:  # fmt: skip
    """Stretches for windows, and those that calibrate the first, the second, … of them in turn."""
    if split is None:
        own = part_spans(twin.logs[-1], twin.held_out, twin.blocks, last=True)
        return since_spans(errors, whole_spans(errors), since), [own]
    spans = since_spans(errors, part_spans(errors, *split, last=True), since)
    return spans, [spans[1::2], spans[::2]]


def _fitting(steps: Sequence[int], spans: Sequence[Span], folds: Sequence[Sequence[Span]], level: float) -> Indices:
    """Increasing horizons that some span is long enough for, and that enough windows calibrate."""
    given = list(steps) if isinstance(steps, list | tuple | range | np.ndarray) else [steps]
    wanted = sorted({as_count("steps", step) for step in given})
    if not wanted:
        raise InputError("steps", shown(steps), "at least one number of steps")
    longest = max((end - first for _, first, end in spans), default=0)
    if wanted[0] > longest:
        raise InputError("steps", shown(tuple(wanted)), f"at most {longest}, the longest stretch that the log offers")
    kept = _calibrable(wanted, spans, folds, level)
    if not kept:
        found = min(apart(fold, wanted[0], wanted[0]) for fold in folds)
        got = f"{found} windows of {wanted[0]} steps, held out and without overlap, to calibrate a level of {level:g}"
        raise InputError("twin", got, f"at least {samples_needed(level)}: a longer log, fewer blocks or fewer steps")
    return np.array(kept)


def _calibrable(
    wanted: Sequence[int], spans: Sequence[Span], folds: Sequence[Sequence[Span]], level: float
) -> list[int]:  # fmt: skip
    """Horizons that the spans are long enough for, and that enough windows without overlap calibrate."""
    longest = max((end - first for _, first, end in spans), default=0)
    return [h for h in wanted
            if h <= longest and min(apart(fold, h, h) for fold in folds) >= samples_needed(level)]  # fmt: skip


def _calibrated(
    horizons: Indices, judged: Windows, trained: Windows | None, calibrating: Sequence[Windows],
    folds: Sequence[Sequence[Span]], level: float,
) -> FreeRunningBands:  # fmt: skip
    """Bands of judged windows: those of fold k are calibrated by the windows that stand k-th."""
    fold = judged.span % len(folds)
    nx = judged.path.shape[2]
    factors = np.empty((len(horizons), nx + 1, len(fold)))  # of each state alone, and last of all jointly
    for i, h in enumerate(horizons):
        exponents = np.zeros(nx + 1) if trained is None else trained.exponents(h, level)
        for k, windows in enumerate(calibrating):
            count = apart(folds[k], int(horizons[-1]), h)
            for j, scores in enumerate(windows.scores_at(h)):
                fitted = Conformal.fit(
                    scores, level, scale=windows.scale, exponent=exponents[j], independent=count, at_least=False
                )
                factors[i, j, fold == k] = fitted.at(judged.scale[fold == k])
    at = horizons - 1
    single = np.moveaxis(factors[:, :-1], 1, 2)
    lower, upper = judged.ends(at, single)
    actual = judged.actual[at]
    joint = [np.mean(judged.scores_at(h)[-1] <= factors[i, -1]) for i, h in enumerate(horizons)]
    coverage = ((actual >= lower) & (actual <= upper)).mean(axis=1)
    return FreeRunningBands(
        level, horizons, lower, upper, actual, coverage, np.array(joint), judged.spread[at], factors[:, -1], judged
    )
