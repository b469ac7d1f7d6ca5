"""Windows of a log: where they start, and what a twin draws from there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ccdtools.arrays import Array, Indices
from ccdtools.controllers.controllers import Controller
from ccdtools.simulation import simulate
from ccdtools.twin.discrepancy import TwinPlant
from ccdtools.twin.residuals import Residuals, block_spans
from ccdtools.twin.tolerances import RECENT, RUNAWAY
from ccdtools.twin.transport import carried
from ccdtools.twin.twin import DigitalTwin
from learning.conformal import Conformal

Span = tuple[int, int, int]  # run, first sample, one past the last


def whole_spans(errors: Residuals) -> list[Span]:
    """All runs of a log."""
    return [(run, 0, errors.steps) for run in range(errors.runs)]


def part_spans(errors: Residuals, held_out: float, blocks: int, *, last: bool) -> list[Span]:
    """First or held-out last parts of a log's blocks, run after run."""
    parts = block_spans(errors, held_out, blocks, last=last)
    return [(run, steps.start, steps.stop) for runs, steps in parts for run in range(runs.start, runs.stop)]


def since_spans(errors: Residuals, spans: Sequence[Span], since: int) -> list[Span]:
    """Spans without the first samples, run after run."""
    number, sample = divmod(since, errors.steps)
    later = errors.numbers - number  # of the runs in their deployment, where some were lost
    firsts = [(run, max(first, sample) if later[run] == 0 else first, end) for run, first, end in spans]
    return [(run, first, end) for run, first, end in firsts if later[run] >= 0 and first < end]


def apart(spans: Sequence[Span], length: int, step: int) -> int:
    """Number of windows within spans that start a step apart."""
    return sum(max((end - first - length) // step + 1, 0) for _, first, end in spans)


@dataclass(frozen=True)
class Windows:
    """Draws from n windows of a log, and what followed.

    Attributes
    ----------
    path, below, above, actual : (T, n, nx) arrays
        Median of the draws, how far their outer quantiles lie from it, and logged states, at every step.
    spread : (T, nx) array
        Root mean square deviation of the draws over that of the logged states, both from the draws' mean.
    scale : (n,) array
        Mean of the recent errors before each window, in units of the trained ones [-].
    span : (n,) int array
        Which span each window lies in.
    limit : (nx,) array
        Largest states that are told apart from ones that run away.
    """

    path: Array
    below: Array
    above: Array
    actual: Array
    spread: Array
    scale: Array
    span: NDArray[np.int64]
    limit: Array

    def ends(self, at: Indices, factors: Array) -> tuple[Array, Array]:
        """Lower and upper ends (k, n, nx) at some steps, for factors of the widths."""
        lower, upper = self.path[at] - factors * self.below[at], self.path[at] + factors * self.above[at]
        return np.maximum(lower, -self.limit), np.minimum(upper, self.limit)

    def part(self, kept: NDArray[np.bool_]) -> Windows:
        """Some of the windows."""
        columns = {name: getattr(self, name)[:, kept] for name in ("path", "below", "above", "actual")}
        return replace(self, **columns, scale=self.scale[kept], span=self.span[kept])

    def scores_at(self, step: int) -> Array:
        """Least factors (nx + 1, n) by which widths hold each state, and all."""
        off = (self.actual - self.path)[:step]
        width = np.where(off < 0, self.below[:step], self.above[:step])
        scores = np.abs(off) / np.maximum(width, np.finfo(float).eps * np.abs(self.actual).max())
        return np.concatenate([scores[-1].T, scores.max(axis=(0, 2))[None]])

    def exponents(self, step: int, level: float) -> Array:
        """Powers (nx + 1,) of the scale that scores grow with."""
        return np.array([Conformal.scale_exponent(scores, self.scale, level) for scores in self.scores_at(step)])


@dataclass(frozen=True)
class Drawing:
    """How windows are drawn from a twin that has learned quantiles."""

    twin: DigitalTwin
    controller: Controller
    length: int
    draws: int
    windows: int
    level: float

    def on(self, errors: Residuals, spans: Sequence[Span], rng: np.random.Generator) -> Windows:
        """Windows spread evenly over spans of a log, of which one at least is long enough."""
        starts = starts_of(spans, self.length, self.windows)
        run, first = starts[:, 0], starts[:, 1]
        last = self.twin.model.undisturbed(errors.p)(errors.x[:, -1:], errors.u[:, -1:]) + errors.e_next[:, -1:]
        states = np.concatenate([errors.x, last], axis=1)
        actual = np.stack([states[run, first + h] for h in range(1, self.length + 1)])
        assert self.twin.scale is not None
        known = carried(self.twin.model, errors, self.twin.logs[-1].p, self.twin.scale).e
        limit = RUNAWAY * np.maximum(np.abs(errors.x).max(axis=(0, 1)), np.finfo(float).tiny)
        drawn = self._drawn(errors, starts, known[run, first], limit, rng)
        tail = (1 - self.level) / 2  # Weibull's quantiles hold it, if draws are as good as the truth
        low, middle, high = np.quantile(drawn, (tail, 0.5, 1 - tail), axis=2, method="weibull")
        own = np.sqrt(drawn.var(axis=2, ddof=1).mean(axis=1) * (1 + 1 / self.draws))  # their mean is uncertain, too
        true = np.sqrt(((actual - drawn.mean(axis=2)) ** 2).mean(axis=1))
        spread = own / np.maximum(true, np.finfo(float).tiny)
        recent = self._recent(known, starts)
        return Windows(middle, middle - low, high - middle, actual, spread, recent, starts[:, 2], limit)

    def _recent(self, errors: Array, starts: NDArray[np.int64]) -> Array:
        """Mean size of the last errors before each start; one where unknown."""
        unit = np.abs(self.twin.logs[-1].e_next).mean(axis=(0, 1))
        size = (np.abs(errors) / np.where(unit > 0, unit, 1.0)).mean(axis=2)
        size[:, 0] = 1.0
        total = np.cumsum(np.concatenate([np.ones((len(size), RECENT)), size], axis=1), axis=1)
        run, first = starts[:, 0], starts[:, 1]
        mean = (total[run, first + RECENT] - total[run, first]) / RECENT
        return np.asarray(np.maximum(mean, np.finfo(float).eps))

    def _drawn(
        self, errors: Residuals, starts: NDArray[np.int64], past: Array, limit: Array, rng: np.random.Generator
    ) -> Array:
        """Drawn states (T, n, draws, nx) from logged starts (n, 3) with errors (n, nx)."""
        twin = self.twin
        assert twin.discrepancy is not None
        plant = TwinPlant(twin.model, replace(twin.discrepancy, noise="quantiles"), np.repeat(past, self.draws, axis=0))
        x0 = np.repeat(errors.x[starts[:, 0], starts[:, 1]], self.draws, axis=0)
        w = rng.random((len(x0), self.length, twin.model.nx))
        run = simulate(plant, self.controller, x0=x0, steps=self.length, disturbance=w, design=errors.p, limit=limit)
        states = np.clip(run.states[:, 1:], -limit, limit).reshape(len(starts), self.draws, self.length, -1)
        return np.moveaxis(states, 2, 0)


def starts_of(spans: Sequence[Span], length: int, windows: int) -> NDArray[np.int64]:
    """Run, first sample and span (n, 3) of windows, spread evenly over the spans."""
    every = np.array([(run, k, i) for i, (run, first, end) in enumerate(spans) for k in range(first, end - length + 1)])
    return np.asarray(every[np.unique(np.linspace(0, len(every) - 1, min(windows, len(every))).round().astype(int))])
