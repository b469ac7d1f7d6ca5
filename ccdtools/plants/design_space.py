"""The box of designs a plant may take."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import qmc

from ccdtools.arrays import Array, ArrayField, Immutable, frozen
from ccdtools.checks import as_count, as_floats, as_generator, as_mapping, as_names, as_number, as_vector
from ccdtools.exceptions import InputError

SAME_DESIGN = 1e-3  # of the range of every parameter: two designs that differ by less are one
MAX_CORNERS = 10  # parameters of which every combination of bounds is looked at
INTERIOR = 64  # seeded points inside the box, beside its centre and corners


@dataclass(frozen=True, eq=False, repr=False)
class DesignSpace(Immutable):
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
        If the lengths differ, a name repeats, or a bound is not finite or not ordered.
    """

    names: Sequence[str]
    lower: ArrayField
    upper: ArrayField
    units: Sequence[str] = field(default=())

    def __post_init__(self) -> None:
        lower = as_vector("lower", self.lower)
        upper = as_vector("upper", self.upper)
        names = as_names("names", self.names, len(lower))
        if len(upper) != len(lower):
            raise InputError("upper", f"{len(upper)} bounds", f"{len(lower)}, as many as lower bounds")
        if not all(name.strip() for name in names):
            raise InputError("names", list(names), "names that are not empty")
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise InputError("names", f"{', '.join(repeated)} more than once", "a different name for every parameter")
        for name, low, high in zip(names, lower, upper):
            if not (low < high and np.isfinite(float(high) - float(low))):
                raise InputError("lower, upper", f"[{low:g}, {high:g}] for {name}", "finite lower < upper")
        default = ("-",) * len(names)
        units = (
            default if isinstance(self.units, tuple) and not self.units else as_names("units", self.units, len(names))
        )
        for key, value in {"names": names, "lower": lower, "upper": upper, "units": units}.items():
            object.__setattr__(self, key, value)

    def __repr__(self) -> str:
        boxes = (f"{name} in [{low:g}, {high:g}]{_unit(unit)}"
                 for name, low, high, unit in zip(self.names, self.lower, self.upper, self.units))  # fmt: skip
        return f"DesignSpace({', '.join(boxes)})"

    @property
    def dim(self) -> int:
        """Number of design parameters."""
        return len(self.names)

    def check(self, p: ArrayLike, *, argument: str = "design") -> Array:
        """`p` as an array (np,) or (n, np), if every row lies within the bounds; else an `InputError`."""
        array = self._sized(p, argument)
        slack = 1e-9 * (self.upper - self.lower)
        outside = ~((array >= self.lower - slack) & (array <= self.upper + slack))
        if outside.any():
            i = int(np.argwhere(outside)[0][-1])
            value = array[outside][0]
            box = f"a value in [{self.lower[i]:g}, {self.upper[i]:g}]{_unit(self.units[i])}"
            raise InputError(argument, f"{self.names[i]} = {value:g}", box)
        return np.clip(array, self.lower, self.upper)

    def check_one(self, p: ArrayLike, *, argument: str = "design") -> Array:
        """`p` as one design (np,) within the bounds; else an `InputError`."""
        array = self.check(p, argument=argument)
        if array.ndim != 1:
            raise InputError(argument, f"shape {array.shape}", f"one design ({self.dim},)")
        return frozen(array)

    def to_unit(self, p: ArrayLike) -> Array:
        """Designs mapped to the unit box, same shape."""
        return (self._sized(p, "p") - self.lower) / (self.upper - self.lower)

    def from_unit(self, v: ArrayLike) -> Array:
        """Points of the unit box mapped to designs, same shape; clipped to the bounds."""
        v = np.clip(self._sized(v, "v"), 0.0, 1.0)
        return np.clip(self.lower + v * (self.upper - self.lower), self.lower, self.upper)

    @property
    def centre(self) -> Array:
        """The design in the middle of the box, (np,)."""
        return self.from_unit(np.full(self.dim, 0.5))

    def spread(self) -> Array:
        """The corners of the box, its centre and 64 seeded points inside, (n, np); corners of 10 parameters at most."""
        if self.dim == 0:
            return np.zeros((1, 0))
        corners = np.array(list(product((0.0, 1.0), repeat=min(self.dim, MAX_CORNERS))))
        corners = np.pad(corners, ((0, 0), (0, self.dim - corners.shape[1])), constant_values=0.5)
        interior = self.latin_hypercube(INTERIOR, np.random.default_rng(0))
        return np.vstack([self.from_unit(corners), self.centre[None], interior])

    def latin_hypercube(self, n: int, rng: np.random.Generator) -> Array:
        """`n` designs spread by Latin hypercube sampling, (n, np)."""
        n = as_count("n", n)
        rng = as_generator("rng", rng)
        return self.from_unit(qmc.LatinHypercube(self.dim, rng=rng).random(n) if self.dim else np.zeros((n, 0)))

    def active_bounds(self, p: ArrayLike, *, tol: float = 1e-3) -> dict[str, str]:
        """Names of the parameters within `tol` (of the range) of a bound, with "lower" or "upper"."""
        tol = as_number("tol", tol, expected="a number from 0 to 0.5", low=0.0, high=0.5)
        v = self.to_unit(as_vector("p", p, self.dim))
        active = {name: "lower" for name, vi in zip(self.names, v) if vi <= tol}
        return active | {name: "upper" for name, vi in zip(self.names, v) if vi >= 1 - tol}

    def as_dict(self, p: ArrayLike) -> dict[str, float]:
        """{name: value} of one design."""
        return {name: float(value) for name, value in zip(self.names, as_vector("p", p, self.dim))}

    def from_dict(self, values: Mapping[str, float]) -> Array:
        """The design with the named values, (np,)."""
        given = as_mapping("values", values, f"{{name: value}} of {', '.join(self.names)}")
        if set(given) != set(self.names):
            raise InputError("values", sorted(given), sorted(self.names))
        return self.check([given[name] for name in self.names], argument="values")

    def describe(self, p: ArrayLike) -> str:
        """One design as text, with units."""
        values = zip(self.names, as_vector("p", p, self.dim), self.units)
        return ", ".join(f"{name} = {value:.6g}{_unit(unit)}" for name, value, unit in values)

    def _sized(self, p: ArrayLike, argument: str) -> Array:
        """`p` as an array whose last axis holds the parameters; a single number is a design of one parameter."""
        array = as_floats(argument, p)
        array = array.reshape(1) if array.ndim == 0 else array
        if array.ndim > 2 or array.shape[-1] != self.dim:
            raise InputError(argument, f"shape {array.shape}", f"{self.dim} values ({', '.join(self.names)})")
        return array


def sample_designs(design: DesignSpace | None) -> Array:
    """Samples of a box of designs; the empty design where there is none, (n, np)."""
    return np.zeros((1, 0)) if design is None else design.spread()


def check_finite(function: Callable[[Array], Any], design: DesignSpace | None, what: str) -> None:
    """Raise an `InputError` if `function` of the design is not finite at some sample of its box."""
    for p in sample_designs(design):
        if not np.isfinite(np.asarray(function(p), dtype=float)).all():
            where = design.describe(p) if design is not None else "the only design"
            raise InputError(
                "design", f"bounds that hold {where}, where {what} are not finite", "a box in which they are",
                "Move the bounds, or look for a division by zero.",
            )  # fmt: skip


def _unit(unit: str) -> str:
    """The unit as it follows a number; nothing for a dimensionless one."""
    return "" if unit == "-" else f" {unit}"
