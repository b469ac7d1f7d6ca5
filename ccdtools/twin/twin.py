"""Digital twin: a nominal model with its learned discrepancy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import ArrayField, Immutable
from ccdtools.exceptions import InputError
from ccdtools.plants.models import Model, as_model
from ccdtools.plants.simulated_model import SimulatedModel
from ccdtools.trajectory import Trajectory
from ccdtools.twin.budgets import BLOCKS
from ccdtools.twin.discrepancy import Discrepancy, QuantileScores, score_quantiles
from ccdtools.twin.residuals import Residuals, block_parts, residuals, stacked
from ccdtools.twin.tolerances import FEWEST_FITTED, HELD_OUT
from ccdtools.twin.transport import Transport, as_extent, carried
from ccdtools_ground.door import as_count, as_flag, as_generator, as_instance, as_share, as_weight, shown
from learning.quantile import QuantileConfig, fit_quantiles


@dataclass(frozen=True, eq=False, repr=False)
class DigitalTwin(Immutable):
    """Nominal model with all logs and the discrepancy learned from them.

    `update` returns a new twin; the old one is unchanged. Its network works in the coordinates of the newest log's
    design: errors of other logs are carried there before it is fitted, and what it says is carried to any other design.

    Parameters
    ----------
    model : LinearModel, SampledModel, or a simulator
        Of a simulator, slopes are differences whose steps are parts of what the first log reaches.
    scale : (nx,) array, optional
        Extent of each state, such as half the width of X, by which the errors are split into what enters through E(p)
        and the rest. The largest |x| of the first log by default.
    held_out : float
        Part of every block of the newest log that trained nothing, as given to `update`.
    blocks : int
        As given to `update`.
    """

    model: Model
    logs: tuple[Residuals, ...] = ()
    discrepancy: Discrepancy | None = None
    scores: QuantileScores | None = None
    scale: ArrayField | None = None
    held_out: float = HELD_OUT
    blocks: int = BLOCKS

    def __post_init__(self) -> None:
        object.__setattr__(self, "model", as_model("model", self.model))
        if not isinstance(self.logs, tuple | list) or not all(isinstance(log, Residuals) for log in self.logs):
            raise InputError("logs", shown(self.logs), "a tuple of Residuals")
        object.__setattr__(self, "logs", tuple(self.logs))
        if self.discrepancy is not None:
            as_instance("discrepancy", self.discrepancy, Discrepancy, "a Discrepancy or None")
        if self.scale is not None:
            object.__setattr__(self, "scale", as_extent(self.scale, self.model.nx))

    def __repr__(self) -> str:
        samples = sum(log.runs * log.steps for log in self.logs)
        covered = "" if self.scores is None else f", coverage {', '.join(f'{c:.0%}' for c in self.scores.coverage)}"
        return f"DigitalTwin({self.model!r}, {len(self.logs)} logs of {samples} samples{covered})"

    def update(
        self,
        log: Trajectory,
        *,
        weight: ArrayLike,
        rng: np.random.Generator,
        config: QuantileConfig | None = None,
        design_as_feature: bool = False,
        held_out: float = HELD_OUT,
        blocks: int = BLOCKS,
        progress: bool = False,
    ) -> DigitalTwin:
        """Twin after learning from one more log.

        The last part of every contiguous block of the log is held out for the scores: it follows in time what was
        trained on, and fit and test both see every regime of a drive. Of several runs, the last ones are held out.
        The stated coverage is that over all regimes together; within a calm one the band may be too wide.

        Parameters
        ----------
        log : Trajectory
            From `deploy` or `simulate`.
        weight : (nx, nx) array
            Penalty Q_q on the quantile width.
        rng : numpy.random.Generator
        config : QuantileConfig, optional
        design_as_feature : bool
        held_out : float
            Fraction of every block that is only tested on.
        blocks : int
            Blocks that a single long run is cut into.

        Raises
        ------
        InputError
            If the log is not one of the model's, the weight is not positive semidefinite (nx, nx), or too little is
            left to train or to test on.
        """
        as_generator("rng", rng)
        weight = as_weight("weight", weight, self.model.nx)
        as_flag("design_as_feature", design_as_feature)
        held_out = as_share("held_out", held_out)
        blocks = as_count("blocks", blocks)
        if config is not None:
            as_instance("config", config, QuantileConfig, "a QuantileConfig or None")
        twin = self.remembering(log)
        logs = _carried(twin)
        parts = [part for one in logs for part in block_parts(one, held_out, blocks, last=False)]
        tested = block_parts(logs[-1], held_out, blocks, last=True)
        _check_split(parts, tested, logs[-1], held_out, blocks)
        train = stacked(parts)
        test = stacked(tested)
        columns = (0, 1, 2, 3) if design_as_feature else (0, 1, 2)
        inputs, tests = (np.hstack([part[i] for i in columns]) for part in (train, test))
        lengths = [part.runs * part.steps for part in parts]
        network = fit_quantiles(inputs, train[-1], stretches=lengths, rng=rng, config=config, progress=progress)
        discrepancy = Discrepancy(network, weight, design_as_feature, transport=twin.transport)
        scores = score_quantiles(network, tests, test[-1], train[-1])
        return replace(twin, discrepancy=discrepancy, scores=scores, held_out=held_out, blocks=blocks)

    def remembering(self, log: Trajectory) -> DigitalTwin:
        """Twin with one more log, not yet learned from."""
        logs = (*self.logs, residuals(self.model, log))
        extent = np.abs(logs[0].x).max(axis=(0, 1))
        scale = np.where(extent > 0, extent, 1.0) if self.scale is None else self.scale
        model = self.model
        if isinstance(model, SimulatedModel) and model.extent is None:
            kept = (logs[-1].u, log.disturbances[~log.diverged])
            largest = [np.abs(part).max(axis=(0, 1)) for part in kept]
            entering = np.concatenate(largest)
            model = replace(model, extent=np.concatenate([scale, np.where(entering > 0, entering, 1.0)]))
        return replace(self, model=model, logs=logs, scale=scale)

    @property
    def transport(self) -> Transport:
        """Transport of errors from the newest log's design to any other."""
        if not self.logs or self.scale is None:
            raise InputError("twin", "one without a log", "one after `update`")
        return Transport.at(self.model, self.logs[-1].p, self.scale)

    def carried(self) -> tuple[Residuals, ...]:
        """Logs at the newest log's design, their errors carried there."""
        return tuple(replace(log, p=self.logs[-1].p) for log in _carried(self))

    def innovations(self) -> tuple[Residuals, ...]:
        """Logs, as `carried`, with e⁺ less its predicted median."""
        if self.discrepancy is None:
            raise InputError("twin", "one without a discrepancy", "one after `update`")
        return tuple(replace(log, e_next=log.e_next - self.discrepancy.median(log)) for log in _carried(self))


def _carried(twin: DigitalTwin) -> tuple[Residuals, ...]:
    """Logs with errors carried to the newest log's design."""
    if not twin.logs or twin.scale is None:
        raise InputError("twin", "one without a log", "one after `update`")
    newest = twin.logs[-1].p
    return tuple(carried(twin.model, log, newest, twin.scale) for log in twin.logs)


def _check_split(
    train: Sequence[Residuals], test: Sequence[Residuals], log: Residuals, held_out: float, blocks: int
) -> None:  # fmt: skip
    argument = "log" if (held_out, blocks) == (HELD_OUT, BLOCKS) else "held_out"
    of = f"{log.runs} runs" if log.runs > 1 else f"{blocks} blocks of a log of {log.steps} samples"
    trained = sum(part.runs * part.steps for part in train)
    if trained < FEWEST_FITTED:
        got = f"{held_out} of {of}, which leaves {trained} samples to train on"
        raise InputError(argument, got, f"at least {FEWEST_FITTED}: a longer log or a smaller fraction")
    if not test:
        got = f"{held_out} of {of}, which leaves none to test on"
        raise InputError(argument, got, "a longer log, fewer blocks or a larger fraction")
