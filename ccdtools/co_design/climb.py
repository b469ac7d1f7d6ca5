"""A climb by L-BFGS-B on one fixed set of scenarios."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize

from ccdtools.arrays import Array
from ccdtools.co_design.sample_average import UNIT_OF_Z, SampleAverage

MEMORY = 20  # pairs that L-BFGS keeps
OPTIONS = {"maxcor": MEMORY, "ftol": 1e-7, "gtol": 1e-5 / UNIT_OF_Z}


class _StoppedError(Exception):
    """The evaluations are spent, or the climb is to end."""


class Climb:
    """At most so many evaluations of a cost and its gradient.

    Parameters
    ----------
    average : SampleAverage
    length : int
        Evaluations at most.
    counted : callable
        Called at every evaluation; whether the lowest point so far is to be looked at.
    look : callable
        Called with policy and design at the lowest point; whether the climb is to end there.
    """

    def __init__(
        self, average: SampleAverage, length: int, *, counted: Callable[[], bool], look: Callable[[], bool]
    ) -> None:
        self._average = average
        self._left = length
        self._counted = counted
        self._look = look
        self._lowest = average.first
        self._value = float("inf")
        self._new = False  # whether the lowest point has not been looked at

    def run(self) -> None:
        """Climb until it is level or the evaluations are spent; policy and design are those of the lowest point."""
        options = OPTIONS | {"maxfun": 10 * self._left, "maxiter": self._left}
        bounds = self._average.bounds
        with np.errstate(all="ignore"), contextlib.suppress(_StoppedError):
            minimize(self, self._average.first, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        self._average.put(self._lowest)
        if self._new:
            self._look()

    def __call__(self, z: Array) -> tuple[float, Array]:
        """Cost and gradient (m,), as parts of the return."""
        if self._left == 0:
            raise _StoppedError
        self._left -= 1
        value, gradient = self._average(z)
        if value < self._value:
            self._new = self._new or np.isfinite(self._value)
            self._value = value
            self._lowest = z.copy()
        if self._counted() or self._left == 0:
            self._average.put(self._lowest)
            self._new = False
            if self._look():
                raise _StoppedError
        return value, gradient
