"""Quantiles of what logged errors add up to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.stats import norm

from ccdtools.arrays import Array, Immutable
from ccdtools.exceptions import InputError
from ccdtools.plants.models import Model
from ccdtools.twin.residuals import Residuals, of_linearisation
from ccdtools_ground.door import as_share
from learning.conformal import Conformal, samples_needed


@dataclass(frozen=True, eq=False, repr=False)
class ErrorQuantiles(Immutable):
    """Room that errors take along limits, each with a probability.

    The errors of k steps are those that a loop under u = v − Kx gathers along every stretch of k logged samples, with
    their own correlation in time.

    Attributes
    ----------
    errors : tuple of (n, T, nx) arrays
        One-step errors x⁺ − Ax − Bu of every log.
    level : float
        Probability with which each limit is to hold at each step, in (0, 1).
    steps : int
        Horizon of the plan.
    normal : bool
        Whether the errors of k steps are taken as normal. Else their quantile is a rank, which assumes nothing of
        their distribution.
    """

    errors: tuple[Array, ...]
    level: float
    steps: int
    normal: bool = False

    @classmethod
    def of(
        cls, model: Model, logs: Sequence[Residuals], *, level: float, steps: int, normal: bool = False
    ) -> ErrorQuantiles:
        """Quantiles of logs at one design; an `InputError` if these are too short."""
        found = cls(tuple(of_linearisation(model, log).e_next for log in logs), as_share("level", level), steps, normal)
        if found.apart(steps) < samples_needed(level):
            got = f"{found.apart(steps)} stretches of {steps} steps without overlap, for a level of {level:g}"
            raise InputError("logs", got, f"at least {samples_needed(level)}: longer logs, or a lower level")
        return found

    def __repr__(self) -> str:
        return f"ErrorQuantiles({self.dim} states, level={self.level:g}, {self.steps} steps)"

    @property
    def dim(self) -> int:
        """Number of states."""
        return int(self.errors[0].shape[2])

    def affine_map(self, M: Array, c: Array) -> ErrorQuantiles:
        """Quantiles of errors M e + c."""
        return replace(self, errors=tuple(e @ M.T + c for e in self.errors))

    def apart(self, steps: int) -> int:
        """Number of stretches of so many steps that do not overlap."""
        return sum(len(e) * (e.shape[1] // steps) for e in self.errors)

    @cached_property
    def spans(self) -> tuple[int, ...]:
        """Horizon, doubled thrice as far as the log goes."""
        longer = (self.steps * 2**k for k in range(4))
        return tuple(k for k in longer if self.apart(k) >= samples_needed(self.level))

    def room(self, rows: Array, loop: Array, E: Array, at: Sequence[int]) -> Array:
        """Room (steps, m) along `rows` (m, nx), see `mpc.robust.tightened`."""
        room = np.zeros((len(at), len(rows)))
        gathered = [np.zeros_like(e) @ E.T for e in self.errors]
        for k in range(1, max(at) + 1):
            gathered = [
                before[:, : max(e.shape[1] - k + 1, 0)] @ loop.T + e[:, k - 1 :] @ E.T
                for before, e in zip(gathered, self.errors)
            ]
            if k in at:
                along = np.concatenate([one.reshape(-1, len(loop)) for one in gathered]) @ rows.T
                room[list(at).index(k)] = self._quantiles(along, self.apart(k))
        return room

    def _quantiles(self, along: Array, independent: int) -> Array:
        """Quantile (m,) of each column of errors (n, m)."""
        if self.normal:
            return np.asarray(along.mean(axis=0) + norm.ppf(self.level) * along.std(axis=0, ddof=1))
        columns = along.T
        return np.array([Conformal.fit(one, self.level, independent=independent).factor for one in columns])
