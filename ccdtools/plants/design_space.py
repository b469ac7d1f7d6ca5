"""The box of designs a plant may take."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import qmc

from ccdtools.arrays import Array, ArrayField
from ccdtools.exceptions import InputError


@dataclass(frozen=True, eq=False)
class DesignSpace:
    """Named design parameters with bounds and units.

    Parameters
    ----------
    names : sequence of str
        One name per parameter.
    lower, upper : (np,) array_like
        Bounds, in `units`; ``lower < upper``.
    units : sequence of str, optional
        SI units, for tables and figures; dimensionless by default.

    Raises
    ------
    InputError
        If the lengths differ, or a bound is not finite or not ordered.
    """

    names: Sequence[str]
    lower: ArrayField
    upper: ArrayField
    units: Sequence[str] = field(default=())

    def __post_init__(self) -> None:
        lower, upper = (np.array(b, dtype=float).reshape(-1) for b in (self.lower, self.upper))
        names = tuple(self.names)
        units = tuple(self.units) or ("-",) * len(names)
        if not len(names) == len(lower) == len(upper) == len(units):
            raise InputError(
                f"design space: got {len(names)} names, {len(lower)} lower bounds, {len(upper)} upper bounds "
                f"and {len(units)} units, expected as many of each."
            )
        for name, low, high in zip(names, lower, upper):
            if not (np.isfinite(low) and np.isfinite(high) and low < high):
                raise InputError(f"design {name}: got bounds [{low:g}, {high:g}], expected finite lower < upper.")
        for array in (lower, upper):
            array.setflags(write=False)
        for key, value in {"names": names, "lower": lower, "upper": upper, "units": units}.items():
            object.__setattr__(self, key, value)

    @property
    def dim(self) -> int:
        """Number of design parameters."""
        return len(self.names)

    def check(self, p: ArrayLike, *, argument: str = "design") -> Array:
        """`p` as an array (np,) or (n, np), if every row lies within the bounds; else an `InputError`."""
        array = np.array(p, dtype=float)
        if array.ndim == 0:
            array = array.reshape(1)
        if array.ndim > 2 or array.shape[-1] != self.dim:
            raise InputError(
                f"{argument}: got shape {array.shape}, expected {self.dim} values ({', '.join(self.names)})."
            )
        slack = 1e-9 * (self.upper - self.lower)
        outside = ~((array >= self.lower - slack) & (array <= self.upper + slack))
        if outside.any():
            i = int(np.argwhere(outside)[0][-1])
            value = array[outside][0]
            unit = "" if self.units[i] == "-" else f" {self.units[i]}"
            raise InputError(
                f"{argument}: got {self.names[i]} = {value:g}, expected a value in "
                f"[{self.lower[i]:g}, {self.upper[i]:g}]{unit}."
            )
        return np.clip(array, self.lower, self.upper)

    def to_unit(self, p: ArrayLike) -> Array:
        """Designs mapped to the unit box, same shape."""
        return (np.asarray(p, dtype=float) - self.lower) / (self.upper - self.lower)

    def from_unit(self, v: ArrayLike) -> Array:
        """Points of the unit box mapped to designs, same shape; clipped to the bounds."""
        v = np.clip(np.asarray(v, dtype=float), 0.0, 1.0)
        return np.clip(self.lower + v * (self.upper - self.lower), self.lower, self.upper)

    def latin_hypercube(self, n: int, rng: np.random.Generator) -> Array:
        """`n` designs spread by Latin hypercube sampling, (n, np)."""
        return self.from_unit(qmc.LatinHypercube(self.dim, rng=rng).random(n))

    def active_bounds(self, p: ArrayLike, *, tol: float = 1e-3) -> dict[str, str]:
        """Names of the parameters within `tol` (of the range) of a bound, with "lower" or "upper"."""
        v = self.to_unit(p)
        active = {name: "lower" for name, vi in zip(self.names, v) if vi <= tol}
        return active | {name: "upper" for name, vi in zip(self.names, v) if vi >= 1 - tol}

    def as_dict(self, p: ArrayLike) -> dict[str, float]:
        """{name: value} of one design."""
        return {name: float(value) for name, value in zip(self.names, np.asarray(p, dtype=float))}

    def from_dict(self, values: Mapping[str, float]) -> Array:
        """The design with the named values, (np,)."""
        if set(values) != set(self.names):
            raise InputError(f"design: got {sorted(values)}, expected {sorted(self.names)}.")
        return self.check([values[name] for name in self.names])

    def describe(self, p: ArrayLike) -> str:
        """One design as text, with units."""
        return ", ".join(
            f"{name} = {value:.6g}{'' if unit == '-' else ' ' + unit}"
            for name, value, unit in zip(self.names, np.asarray(p, dtype=float), self.units)
        )
