"""Sizes that the limits of a problem say: of inputs, of states, and the units in which violations have a price."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mpc.checks import Array
from mpc.halfspaces import along_axes
from mpc.tolerances import SMALL_BOUND


@dataclass(frozen=True, eq=False)
class Limits:
    """Half-spaces (H, h) of states, of the end and of inputs, rates, and what inputs move.

    Attributes
    ----------
    B : (nx, nu) array
    state, terminal, input : (H, h)
    rate : (nu,) array or None
    horizon : int
    """

    B: Array
    state: tuple[Array, Array]
    terminal: tuple[Array, Array]
    input: tuple[Array, Array]
    rate: Array | None
    horizon: int

    def input_extent(self) -> Array:
        """Size (nu,) of each input: the distance to its bound, or what the rate limit lets it move; 0 without limit."""
        extent = along_axes(*self.input)
        if self.rate is None:
            return extent
        return np.where(extent > 0, np.minimum(extent, self.horizon * self.rate), self.rate)

    def state_extent(self) -> Array:
        """Size (nx,) of each state: the distance to a bound, else what inputs with limits move; 0 without either."""
        inputs = self.input_extent()
        limited = (inputs > 0) | ~self.B.any(axis=0)
        moved = np.abs(self.B) @ inputs
        moved[self.B[:, ~limited].any(axis=1)] = 0.0
        return first_positive(along_axes(*self.state), along_axes(*self.terminal), moved)

    def reaches(self) -> dict[str, Array]:
        """Extent of each set along each of its rows; 1 where it has none."""
        states = self.state_extent()
        ends = first_positive(along_axes(*self.terminal), states)
        found = {"state": np.abs(self.state[0]) @ states, "terminal": np.abs(self.terminal[0]) @ ends,
                 "input": np.abs(self.input[0]) @ self.input_extent()}  # fmt: skip
        return {kind: np.where(reach == 0, 1.0, reach) for kind, reach in found.items()}

    def price_units(self) -> dict[str, Array]:
        """Unit of each row of each set, see `MPCProblem.price_units`."""
        reaches, own = self.reaches(), self.own()
        units = {kind: np.where(own[kind], np.abs(h), reaches[kind]) for kind, (_, h) in self._sets.items()}
        if self.rate is not None:
            units["rate"] = np.tile(self.rate, 2)
        return units

    def own(self) -> dict[str, NDArray[np.bool_]]:
        """Which rows of each set are priced in units of their own bounds (bool)."""
        reaches = self.reaches()
        return {kind: np.asarray(np.abs(h) > SMALL_BOUND * reaches[kind]) for kind, (_, h) in self._sets.items()}

    @property
    def _sets(self) -> dict[str, tuple[Array, Array]]:
        return {"state": self.state, "terminal": self.terminal, "input": self.input}


def first_positive(*sizes: Array) -> Array:
    """The first of several sizes that is positive, entry by entry; 0 where none is."""
    first = np.zeros_like(sizes[0])
    for size in sizes:
        first = np.where(first > 0, first, size)
    return first
