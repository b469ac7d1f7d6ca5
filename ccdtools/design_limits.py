"""Limits of states or inputs that depend on the design."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, Immutable, Mask
from ccdtools.exceptions import InputError
from ccdtools.plants.casadi_arrays import SymbolicFunction
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.symbols import as_expression, check_known
from ccdtools.plants.tolerances import FEASIBLE
from ccdtools.tolerances import ON_LIMIT
from ccdtools_ground.door import as_vector, shown
from ccdtools_ground.user_functions import stopped
from invariant_sets import Polytope
from invariant_sets.system_checks import as_set

PAIR = "a function of p that returns two bounds (lower, upper)"
FORBIDDEN = "No such design may be built, but data are drawn over the whole box: hold the bounds apart with ca.fmax."
EXAMPLE = "Such as lambda p: (-3 * p[0], 3 * p[0])."


@dataclass(frozen=True, eq=False, repr=False)
class DesignLimits(Immutable):
    """Box with bounds that are functions of the design.

    Attributes
    ----------
    argument : str
        What errors call it: X or U.
    both : SymbolicFunction
        p (np,) → the lower bounds, then the upper ones, (2 n,).
    names : tuple of str
        Of the design parameters.
    lower, upper : (n,) arrays
        The widest bounds that were seen over the box of designs, which scales are taken from.
    """

    argument: str
    both: SymbolicFunction
    names: tuple[str, ...]
    lower: Array
    upper: Array

    @classmethod
    def from_function(
        cls, argument: str, given: Callable[..., Any], size: int, of: str, space: DesignSpace
    ) -> DesignLimits:
        """Limits on `size` numbers from a function of p, checked.

        Also where constraints forbid a design: the expert's data cover the box.

        Raises
        ------
        InputError
            If it is no function of p with two bounds, these have the wrong size or symbols of their own, or at some
            design are not finite, not in order, or leave out 0.
        """
        both = SymbolicFunction(argument, _compiled(argument, given, size, of, space.dim), ("p",))
        both.function(space.dim)
        designs = space.spread()
        lower, upper = np.split(np.asarray(both.vector(space.dim)(designs)), 2, axis=-1)
        wrong = {
            "finite numbers": ~(np.isfinite(lower) & np.isfinite(upper)),
            "lower < upper": ~(lower < upper),
            "bounds with 0 between them, which is regulated to": ~((lower <= 0) & (upper >= 0)),
        }
        for expected, where in wrong.items():
            found = np.argwhere(where)
            if len(found):
                k, i = found[0]
                got = f"{lower[k, i]:.6g} and {upper[k, i]:.6g} for number {i + 1} at {space.describe(designs[k])}"
                over = f"{expected} over the whole box of designs"
                raise InputError(argument, got, over, "" if space.violation(designs[k]) <= FEASIBLE else FORBIDDEN)
        return cls(argument, both, tuple(space.names), lower.min(axis=0), upper.max(axis=0))

    def __repr__(self) -> str:
        return f"DesignLimits({self.argument}, {self.dim} numbers)"

    def __str__(self) -> str:
        """Lower, then upper bounds as expressions of p."""
        return str(self.both)

    def __deepcopy__(self, memory: Any) -> DesignLimits:
        """This object itself, which never changes."""
        return self

    @property
    def dim(self) -> int:
        """Number of limited quantities."""
        return len(self.lower)

    @property
    def entries(self) -> int:
        """Number of design parameters."""
        return len(self.names)

    @property
    def box(self) -> tuple[Array, Array]:
        """Widest bounds, each (n,)."""
        return self.lower, self.upper

    @cached_property
    def widest(self) -> Polytope:
        """Box of the widest bounds."""
        return Polytope.from_bounds(self.lower, self.upper)

    def bounds(self, p: Any) -> tuple[Any, Any]:
        """Bounds (..., n) at designs (..., np), arrays or tensors; differentiable in tensors."""
        both = self.both.vector(self.entries)(p)
        return both[..., : self.dim], both[..., self.dim :]

    def at(self, p: ArrayLike) -> Polytope:
        """Box at one design (np,).

        Raises
        ------
        InputError
            If the bounds are not in order there: between the designs that were looked at.
        """
        design = as_vector("p", p, self.entries, of="one per design parameter")
        lower, upper = self.bounds(design)
        if not (np.isfinite(lower) & np.isfinite(upper) & (lower < upper)).all():
            where = ", ".join(f"{name} = {value:.6g}" for name, value in zip(self.names, design))
            got = f"{shown(lower)} and {shown(upper)} at {where}"
            raise InputError(self.argument, got, "finite lower < upper at every design")
        return Polytope.from_bounds(lower, upper)

    def contains(self, x: Array, p: Array) -> Mask:
        """Whether x (n, ·) lie within the bounds at designs (n, np) or (np,)."""
        lower, upper = self.bounds(p)
        slack = ON_LIMIT * (upper - lower) / 2
        return np.asarray(((lower - slack <= x) & (x <= upper + slack)).all(axis=-1))

    def followed_by(self, lower: Array, upper: Array) -> DesignLimits:
        """These limits, with further fixed bounds (m,) appended."""
        p = ca.SX.sym("p", self.entries)
        own = self.both.function(self.entries)(p)
        both = ca.vertcat(own[: self.dim], ca.DM(lower), own[self.dim :], ca.DM(upper))
        function = SymbolicFunction(self.argument, ca.Function(self.argument, [p], [both]), ("p",))
        function.function(self.entries)
        return DesignLimits(self.argument, function, self.names, np.r_[self.lower, lower], np.r_[self.upper, upper])

    def as_dict(self) -> dict[str, Any]:
        """Plain values for `from_dict`."""
        function = self.both.function(self.entries).serialize()
        plain = {"lower": self.lower.tolist(), "upper": self.upper.tolist(), "names": list(self.names)}
        return {"argument": self.argument, "function": function, **plain}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> DesignLimits:
        """Limits from the values of `as_dict`."""
        both = SymbolicFunction(values["argument"], ca.Function.deserialize(values["function"]), ("p",))
        both.function(len(values["names"]))
        return cls(values["argument"], both, tuple(values["names"]), values["lower"], values["upper"])


Limits: TypeAlias = Polytope | DesignLimits


def as_limits_over(argument: str, value: Any, size: int, of: str, space: DesignSpace) -> Limits:
    """Limits on `size` numbers from a Polytope, bounds, or a function of p."""
    if isinstance(value, DesignLimits):
        if (value.dim, value.names) != (size, tuple(space.names)):
            got = f"limits of {value.dim} numbers over designs {', '.join(value.names)}"
            raise InputError(argument, got, f"{size}, {of}, over {', '.join(space.names)}")
        return value
    if callable(value) and not isinstance(value, type):
        return DesignLimits.from_function(argument, value, size, of, space)
    if isinstance(value, Polytope) and value.dim != size:
        raise InputError(argument, f"dimension {value.dim}", f"{size}, {of}")
    return as_set(value, argument, size)


def limits_at(limits: Limits, p: ArrayLike) -> Polytope:
    """Limits at one design (np,)."""
    return limits.at(p) if isinstance(limits, DesignLimits) else limits


def set_at(limits: Any, p: ArrayLike | None, argument: str, size: int) -> Polytope:
    """Set of so many numbers at one design (np,), or at none, checked."""
    if isinstance(limits, DesignLimits) and (p is None or np.size(p) == 0):
        raise InputError("design", "nothing", f"the design whose limits {argument}(p) count")
    return as_set(limits_at(limits, p), argument, size)  # type: ignore[arg-type]


def bounds_at(limits: Limits, p: Any) -> tuple[Any, Any]:
    """Bounds (n,) of fixed limits, or (..., n) at designs (..., np)."""
    return limits.bounds(p) if isinstance(limits, DesignLimits) else limits.bounding_box()


def widest(limits: Limits) -> Polytope:
    """Fixed limits, or the box of the widest bounds."""
    return limits.widest if isinstance(limits, DesignLimits) else limits


def _compiled(argument: str, given: Callable[..., Any], size: int, of: str, designs: int) -> ca.Function:
    """Function from p to lower and upper bounds in one column."""
    p = ca.SX.sym("p", designs)
    try:
        pair = given(p)
    except Exception as error:
        raise stopped(argument, given, error, PAIR, EXAMPLE) from error
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise InputError(argument, f"{shown(pair)} from a function of p", PAIR, EXAMPLE)
    columns = []
    for side in pair:
        column = ca.vec(as_expression(argument, side.tolist() if isinstance(side, np.ndarray) else side))
        if column.numel() not in (1, size):
            got = f"a bound of {column.numel()} numbers"
            raise InputError(argument, got, f"{size}, {of}" + (", or one for all" if size > 1 else ""))
        check_known(argument, column, p=p)
        columns.append(column if column.numel() == size else ca.repmat(column, size, 1))
    return ca.Function(argument, [p], [ca.densify(ca.vertcat(*columns))])
