"""How often and how far the runs of one controller leave X, beside those of another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccdtools.limits import Excursions, StateLimits, excursions, further_outside
from ccdtools.trajectory import Trajectory

BLOCK = 100  # samples of a stretch of a single long run at most,
STRETCHES = 40  # of which there are at least so many


@dataclass(frozen=True, eq=False)
class Outside:
    """How often and how far the runs of one controller leave X.

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
    def of(cls, run: Trajectory, limits: StateLimits, plant: Any) -> Outside:
        """Those of a trajectory."""
        states = run.states[:, 1:]
        names = getattr(plant, "state_names", None) or None
        whole = excursions(states[~run.diverged], limits, names=names)
        n, steps, nx = states.shape
        if n > 1 or steps < STRETCHES:
            return cls(whole, excursions(states, limits, names=names), False, run.diverged)
        length = min(BLOCK, steps // STRETCHES)
        pieces = states[0, : steps // length * length].reshape(-1, length, nx)
        return cls(whole, excursions(pieces, limits, names=names), True, np.repeat(run.diverged, len(pieces)))

    def further_than(self, others: Mapping[str, Outside]) -> tuple[str, ...]:
        """The names of those that leave X less."""
        return tuple(name for name, other in others.items() if self._further(other))

    def _further(self, other: Outside) -> bool:
        """Whether these leave X further than another controller's, where neither diverged."""
        n = min(len(self.lost), len(other.lost))
        kept = ~(self.lost[:n] | other.lost[:n])
        own, others = (one.pieces.of(slice(n)).of(kept) for one in (self, other))
        return further_outside(own, others, stretches=self.single)
