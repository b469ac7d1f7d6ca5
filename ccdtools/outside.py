"""Comparison of two controllers' violations of limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccdtools.limits import Excursions, StateLimits, excursions_of, further_outside
from ccdtools.output_limits import OutputLimits
from ccdtools.tolerances import STRETCHES
from ccdtools.trajectory import Trajectory


def limits_in_words(outputs: OutputLimits | None) -> str:
    """Name of the limits that count: X, or the limits with outputs."""
    return "X" if outputs is None else "the limits"


@dataclass(frozen=True, eq=False)
class RunViolations:
    """Frequency and depth with which one controller's runs leave X.

    Attributes
    ----------
    whole : Excursions
        Of the runs that did not diverge.
    pieces : Excursions
        Of all runs, or of the stretches of a single run: what is paired with another controller's.
    single : bool
        Whether they are stretches of one run, one after the other.
    lost : (n,) bool array
        Of the pieces, those of runs that diverged.
    """

    whole: Excursions
    pieces: Excursions
    single: bool
    lost: NDArray[np.bool_]

    @classmethod
    def from_trajectory(
        cls, run: Trajectory, limits: StateLimits, plant: Any, outputs: OutputLimits | None = None
    ) -> RunViolations:
        """Violations of a trajectory, by states and limited outputs."""
        n, steps, nx = run.states[:, 1:].shape
        names = getattr(plant, "state_names", None) or tuple(f"x{i + 1}" for i in range(nx))
        by_row = limits.depths(run.states[:, 1:])
        rows = by_row.shape[-1]
        if outputs is not None:
            by_row = np.concatenate([by_row, outputs.depths(run.states[:, :-1], run.inputs, run.design)], axis=-1)

        def text(row: int) -> str:
            """Text of exceeding a limit."""
            return limits.row_text(row, names) if row < rows or outputs is None else outputs.row_text(row - rows)

        left = limits_in_words(outputs)
        whole = excursions_of(by_row[~run.diverged], text, left)
        if n > 1 or steps < STRETCHES:
            return cls(whole, excursions_of(by_row, text, left), False, run.diverged)
        length = min(100, steps // STRETCHES)  # samples of a stretch
        pieces = by_row[0, : steps // length * length].reshape(-1, length, by_row.shape[-1])
        return cls(whole, excursions_of(pieces, text, left), True, np.repeat(run.diverged, len(pieces)))

    def further_than(self, others: Mapping[str, RunViolations]) -> tuple[str, ...]:
        """Names of the controllers that leave X less."""
        return tuple(name for name, other in others.items() if self._further(other))

    def _further(self, other: RunViolations) -> bool:
        """Whether these leave X further than another controller's, where neither diverged."""
        n = min(len(self.lost), len(other.lost))
        kept = ~(self.lost[:n] | other.lost[:n])
        own, others = (one.pieces.of(slice(n)).of(kept) for one in (self, other))
        return further_outside(own, others, stretches=self.single)
