"""How often and how far the runs of one controller leave X, beside those of another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccdtools.limits import Excursions, StateLimits, excursions, further_outside
from ccdtools.trajectory import Trajectory

BLOCK = 100  # samples per replicate of a single long run


@dataclass(frozen=True, eq=False)
class Outside:
    """How often and how far the runs of one controller leave X.

    Attributes
    ----------
    whole : Excursions
        Of the runs that did not diverge.
    pieces : Excursions
        Of all runs, or of the blocks of a single run: what is paired with another controller's.
    lost : (n,) bool array
        Of the pieces, those of runs that diverged.
    """

    whole: Excursions
    pieces: Excursions
    lost: NDArray[np.bool_]

    @classmethod
    def of(cls, run: Trajectory, limits: StateLimits, plant: Any) -> Outside:
        """Those of a trajectory."""
        states = run.states[:, 1:]
        names = getattr(plant, "state_names", None) or None
        whole = excursions(states[~run.diverged], limits, names=names)
        n, steps, nx = states.shape
        blocks = steps // BLOCK
        if n > 1 or blocks < 2:
            return cls(whole, excursions(states, limits, names=names), run.diverged)
        pieces = states[0, : blocks * BLOCK].reshape(blocks, BLOCK, nx)
        return cls(whole, excursions(pieces, limits, names=names), np.repeat(run.diverged, blocks))

    def further_than(self, others: Mapping[str, Outside]) -> tuple[str, ...]:
        """The names of those that leave X less."""
        return tuple(name for name, other in others.items() if self._further(other))

    def _further(self, other: Outside) -> bool:
        """Whether these leave X further than another controller's, where neither diverged."""
        n = min(len(self.lost), len(other.lost))
        kept = ~(self.lost[:n] | other.lost[:n])
        return further_outside(self.pieces.of(slice(n)).of(kept), other.pieces.of(slice(n)).of(kept))
