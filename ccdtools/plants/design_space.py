"""Box of designs of a plant, with constraints and whole numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import qmc

from ccdtools.arrays import Array, ArrayField, Immutable, frozen
from ccdtools.exceptions import InputError
from ccdtools.plants.allowed_designs import AllowedDesigns, whole_bounds
from ccdtools.plants.design_constraints import compiled, constraint_names
from ccdtools.plants.tolerances import FEASIBLE, ON_BOUND
from ccdtools_ground.door import as_count, as_floats, as_generator, as_mapping, as_names, as_number, as_vector, shown


@dataclass(frozen=True, eq=False, repr=False)
class DesignSpace(Immutable):
    """Named design parameters with bounds, units and constraints.

    Models, guards and training data cover the whole box; a co-design takes feasible designs alone.

    Parameters
    ----------
    names : sequence of str
        One name per parameter.
    lower, upper : (np,) array_like
        Bounds, in `units`. A parameter whose bounds are equal is fixed: the plant has it, and it is not designed.
    units : sequence of str, optional
        SI units, for tables and figures; dimensionless by default.
    constraints : callable, optional
        A function of a CasADi vector p (np,) that gives smooth expressions (ng,), or a list of them, each to be ≤ 0:
        ``lambda p: p[0] + p[1] - 3.0``. It is called once; a CasADi function of p is kept.
    constraint_names : sequence of str, optional
        One name per constraint.
    integer : sequence of str or int, optional
        Names or places of the parameters that are whole numbers. Models take values between them too.

    Raises
    ------
    InputError
        If the lengths differ, a name repeats, a bound is not finite or not ordered, the constraints are no finite
        expressions in p, or no design keeps the constraints and whole numbers.
    """

    names: Sequence[str]
    lower: ArrayField
    upper: ArrayField
    units: Sequence[str] = field(default=())
    constraints: Any = None
    constraint_names: Sequence[str] = ()
    integer: Sequence[Any] = ()

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
            if not (low <= high and np.isfinite(float(high) - float(low))):
                expected = "finite lower < upper, or lower = upper for a fixed parameter"
                raise InputError("lower, upper", f"[{low:g}, {high:g}] for {name}", expected)
        dimensionless = isinstance(self.units, tuple) and not self.units
        units = as_names("units", ("-",) * len(names) if dimensionless else self.units, len(names))
        integer = _whole_numbers(self.integer, names, lower, upper)
        self._set(names=names, lower=lower, upper=upper, units=units, integer=integer)
        self._compile()

    def _compile(self) -> None:
        """Compile the constraints; raise an `InputError` unless finite and somewhere feasible."""
        if self.constraints is None:
            if len(self.constraint_names):
                raise InputError("constraint_names", shown(self.constraint_names), "none, as there are no constraints")
            self._set(constraint_names=())
            return
        if not self.names:
            raise InputError("constraints", shown(self.constraints), "none, as there are no parameters")
        function = compiled(self.constraints, self.names)
        self._set(constraints=function)
        self._set(constraint_names=constraint_names(self.constraint_names, function.numel_out(0)))
        limits = self.allowed.limits
        assert limits is not None
        for place in self.from_unit(limits.not_finite[:1]):
            raise InputError(
                "constraints", f"a value that is not finite at {self.describe(place)}",
                "finite values over the whole box", "Move the bounds, or look for a division by zero.",
            )  # fmt: skip
        if not len(self.allowed.known):
            p = self.from_unit(self.allowed.least_violated)
            raise InputError(
                "constraints", f"no design that keeps them: at best {self._broken(p)} at {self.describe(p)}",
                "at least one design in the box at which every constraint is ≤ 0", "Widen the bounds, or ask for less.",
            )  # fmt: skip

    def __repr__(self) -> str:
        boxes = [
            f"{name} = {low:g}{_unit(unit)} fixed" if low == high else
            f"{name}{' whole' if name in self.integer else ''} in [{low:g}, {high:g}]{_unit(unit)}"
            for name, low, high, unit in zip(self.names, self.lower, self.upper, self.units)
        ]  # fmt: skip
        kept = [f"{name} <= 0" for name in self.constraint_names]
        return f"DesignSpace({', '.join(boxes + kept)})"

    @property
    def dim(self) -> int:
        """Number of design parameters."""
        return len(self.names)

    @property
    def labels(self) -> list[str]:
        """Names with units, for axes and headings."""
        return [name if unit == "-" else f"{name} [{unit}]" for name, unit in zip(self.names, self.units)]

    def check(self, p: ArrayLike, *, argument: str = "design") -> Array:
        """`p` as an array (np,) or (n, np) within the bounds, checked."""
        array = self._sized(p, argument)
        outside = self._outside(array)
        if outside.any():
            i = int(np.argwhere(outside)[0][-1])
            value = array[outside][0]
            box = f"a value in [{self.lower[i]:g}, {self.upper[i]:g}]{_unit(self.units[i])}"
            raise InputError(argument, f"{self.names[i]} = {value:g}", box)
        return np.clip(array, self.lower, self.upper)

    def check_one(self, p: ArrayLike, *, argument: str = "design") -> Array:
        """`p` as one design (np,) within the bounds, checked."""
        array = self.check(p, argument=argument)
        if array.ndim != 1:
            raise InputError(argument, f"shape {array.shape}", f"one design ({self.dim},)")
        return frozen(array)

    def check_feasible(self, p: ArrayLike, *, argument: str = "design") -> Array:
        """`p` as one feasible design (np,), exact to the last digit.

        A violation of up to 1e-6, and as much of a whole number, is rounding. Models are not so strict: for them,
        `check` asks for the bounds alone.
        """
        design = self.check_one(p, argument=argument)
        numbers = self.from_unit(self.allowed.rounded(self.to_unit(design)))
        for i in np.flatnonzero(np.abs(numbers - design) > FEASIBLE).tolist():
            raise InputError(argument, f"{self.names[i]} = {design[i]:g}", "a whole number")
        if self.violation(design) > FEASIBLE:
            raise InputError(
                argument, f"{self.describe(design)} with {self._broken(design)}", "constraints ≤ 0",
                "DesignSpace.project gives the nearest design that keeps them.",
            )  # fmt: skip
        if self.violation(design) > 0:
            return frozen(self.project(design))
        return frozen(self.settled(self.to_unit(design))) if self.integer else design

    def constraint_values(self, p: ArrayLike) -> Array:
        """Constraint values (ng,) or (n, ng) at designs, each to be ≤ 0."""
        p = self._sized(p, "p")
        if self.constraints is None:
            return np.zeros((*p.shape[:-1], 0))
        return np.asarray(self.constraints(p.T), dtype=float).T.reshape(*p.shape[:-1], -1)

    def violation(self, p: ArrayLike) -> Any:
        """Largest violation () or (n,), about the distance to the edge.

        It is g/|∇g| in the unit box, or g in parts of how much g varies over the box if that is more: an edge is the
        same however the constraint is written, as g, as exp(40 g) − 1 or as g³.
        """
        return self.allowed.violation(self.to_unit(p))

    def feasible(self, p: ArrayLike) -> Any:
        """Whether designs keep bounds, constraints and whole numbers; () or (n,)."""
        v = self.to_unit(p)
        within = ~self._outside(self._sized(p, "p")).any(axis=-1)
        whole = (np.abs(self.allowed.rounded(v) - v) * self.allowed.width <= FEASIBLE).all(axis=-1)
        return within & whole & (self.allowed.violation(v) <= FEASIBLE)

    def project(self, p: ArrayLike) -> Array:
        """Nearest feasible design (np,) by distance in the unit box.

        The nearest of what SLSQP finds from the design and from known feasible designs, of which none is nearer.

        Raises
        ------
        InputError
            If `p` has the wrong size, or no feasible design is found.
        """
        v = np.clip(self.to_unit(as_vector("p", p, self.dim)), 0.0, 1.0)
        found = self.allowed.near(v)
        if found is None:
            raise InputError("p", self.describe(self.from_unit(v)), "a design near which a feasible one is found")
        return self.settled(found)

    def settled(self, v: ArrayLike) -> Array:
        """Design (np,) of a feasible unit-box point, with exact whole numbers."""
        p = self.from_unit(v)
        p[self.whole] = np.round(p[self.whole])
        return p

    def active_constraints(self, p: ArrayLike, *, tol: float = 1e-3) -> dict[str, float]:
        """Names and values of constraints within `tol` of their edge."""
        tol = as_number("tol", tol, expected="a number from 0 to 0.5", low=0.0, high=0.5)
        limits = self.allowed.limits
        if limits is None:
            return {}
        near = limits.edges(self.to_unit(as_vector("p", p, self.dim)))[1] <= tol
        values = self.constraint_values(p)
        return {name: float(g) for name, g, close in zip(self.constraint_names, values, near) if close}

    @cached_property
    def allowed(self) -> AllowedDesigns:
        """Allowed points of the unit box."""
        return AllowedDesigns(self.lower, self.upper, self.whole, self.constraints)

    @property
    def whole(self) -> Any:
        """Mask (np,) of whole-number entries."""
        return np.isin(self.names, self.integer)

    @property
    def outermost(self) -> tuple[Array, Array]:
        """Least and largest design, (np,) each, whole numbers within bounds."""
        low, high = whole_bounds(self.lower, self.upper)
        return np.where(self.whole, low, self.lower), np.where(self.whole, high, self.upper)

    @property
    def free(self) -> Any:
        """Mask (np,) of entries that are not fixed."""
        return self.upper > self.lower

    def _outside(self, p: Array) -> Any:
        """Mask of values outside their bounds by more than rounding, same shape."""
        width = self.upper - self.lower
        slack = ON_BOUND * np.where(width > 0, width, np.abs(self.upper))
        return ~((p >= self.lower - slack) & (p <= self.upper + slack))

    def _broken(self, p: Array) -> str:
        """Violated constraints with their values, as text."""
        values = zip(self.constraint_names, self.constraint_values(p), strict=True)
        return ", ".join(f"{name} = {g:.4g}" for name, g in values if g > 0)

    def to_unit(self, p: ArrayLike) -> Array:
        """Designs in the unit box, same shape; fixed entries at 0."""
        return np.asarray((self._sized(p, "p") - self.lower) / self.allowed.width)

    def from_unit(self, v: ArrayLike) -> Array:
        """Designs of unit-box points, same shape, clipped to the bounds."""
        v = np.clip(self._sized(v, "v"), 0.0, 1.0)
        return np.asarray(np.clip(self.lower + v * (self.upper - self.lower), self.lower, self.upper))

    @property
    def centre(self) -> Array:
        """Design (np,) in the middle of the box."""
        return self.from_unit(np.full(self.dim, 0.5))

    def spread(self) -> Array:
        """Corners (at most 10 parameters), centre and 64 seeded points, (n, np)."""
        if not self.free.any():
            return self.centre[None]
        interior = self.latin_hypercube(64, np.random.default_rng(0))
        return np.vstack([self.from_unit(self.allowed.corners), self.centre[None], interior])

    def latin_hypercube(self, n: int, rng: np.random.Generator) -> Array:
        """Latin hypercube sample of `n` designs, (n, np)."""
        n = as_count("n", n)
        rng = as_generator("rng", rng)
        return self.from_unit(qmc.LatinHypercube(self.dim, rng=rng).random(n) if self.dim else np.zeros((n, 0)))

    def active_bounds(self, p: ArrayLike, *, tol: float = 1e-3) -> dict[str, str]:
        """Parameters within `tol` (of the range) of a bound, "lower" or "upper"."""
        tol = as_number("tol", tol, expected="a number from 0 to 0.5", low=0.0, high=0.5)
        lower, upper = self.outermost
        width = upper - lower
        v = (as_vector("p", p, self.dim) - lower) / np.where(width > 0, width, 1.0)
        moving = [(name, vi) for name, vi, free in zip(self.names, v, width > 0) if free]
        active = {name: "lower" for name, vi in moving if vi <= tol}
        return active | {name: "upper" for name, vi in moving if vi >= 1 - tol}

    def as_dict(self, p: ArrayLike) -> dict[str, float]:
        """{name: value} of one design."""
        return {name: float(value) for name, value in zip(self.names, as_vector("p", p, self.dim))}

    def from_dict(self, values: Mapping[str, float]) -> Array:
        """Design (np,) with the named values."""
        given = as_mapping("values", values, f"{{name: value}} of {', '.join(self.names)}")
        if set(given) != set(self.names):
            raise InputError("values", sorted(given), sorted(self.names))
        return self.check([given[name] for name in self.names], argument="values")

    def describe(self, p: ArrayLike) -> str:
        """Text of one design, with units."""
        values = zip(self.names, as_vector("p", p, self.dim), self.units)
        return ", ".join(f"{name} = {value:.6g}{_unit(unit)}" for name, value, unit in values)

    def _sized(self, p: ArrayLike, argument: str) -> Array:
        """`p` as an array with the parameters along the last axis."""
        array = as_floats(argument, p)
        array = array.reshape(1) if array.ndim == 0 else array
        if array.ndim > 2 or array.shape[-1] != self.dim:
            if not self.dim:
                raise InputError(argument, shown(p), "nothing, because there are no design parameters")
            raise InputError(argument, f"shape {array.shape}", f"{self.dim} values ({', '.join(self.names)})")
        return array


def _whole_numbers(given: Any, names: tuple[str, ...], lower: Array, upper: Array) -> tuple[str, ...]:
    """Names of the whole-number parameters; checks that their bounds hold one."""
    if isinstance(given, str) or not isinstance(given, Sequence | np.ndarray):
        raise InputError("integer", shown(given), 'a list of names or places, such as ["teeth"]')
    places = set()
    for one in given:
        place = names.index(one) if isinstance(one, str) and one in names else one
        if isinstance(place, bool) or not isinstance(place, int | np.integer) or not 0 <= place < len(names):
            raise InputError("integer", shown(one), f"names among {', '.join(names)}, or places from 0")
        low, high = whole_bounds(lower[place], upper[place])
        if low > high:
            bounds = f"{names[place]} in [{lower[place]:g}, {upper[place]:g}]"
            raise InputError("integer", bounds, "bounds with a whole number between them")
        places.add(int(place))
    return tuple(names[i] for i in sorted(places))


NO_DESIGN = DesignSpace([], [], [])


def sample_designs(design: DesignSpace | None) -> Array:
    """Samples (n, np) of a box of designs; one empty design without a box."""
    return (design or NO_DESIGN).spread()


def check_finite(function: Callable[[Array], Any], design: DesignSpace | None, what: str) -> None:
    """Raise an `InputError` unless `function` is finite at sample designs."""
    for p in sample_designs(design):
        if not np.isfinite(np.asarray(function(p), dtype=float)).all():
            where = design.describe(p) if design is not None else "the only design"
            raise InputError(
                "design", f"bounds that hold {where}, where {what} are not finite", "a box in which they are",
                "Move the bounds, or look for a division by zero.",
            )  # fmt: skip


def _unit(unit: str) -> str:
    """Unit as it follows a number; empty if dimensionless."""
    return "" if unit == "-" else f" {unit}"
