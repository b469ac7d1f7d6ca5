"""Constraints g(p) ≤ 0 on designs, also over the unit box."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.exceptions import InputError
from ccdtools.plants.symbols import as_expression, check_known
from ccdtools.plants.tolerances import BESIDE_LEVEL, EXTENT_QUANTILES, LEVEL, NEAR_EDGE
from ccdtools_ground.door import as_names, shown
from ccdtools_ground.operations import term_sizes
from ccdtools_ground.user_functions import stopped

TINY = float(np.finfo(float).tiny)  # a divisor that stands for zero
COMPARISONS = (ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_AND, ca.OP_OR, ca.OP_NOT)
EXAMPLE = "a function of p that gives expressions, each to be ≤ 0, such as lambda p: p[0] + p[1] - 3.0"


def compiled(constraints: Any, names: Sequence[str]) -> ca.Function:
    """p (np,) → g (ng,) as a CasADi function.

    Raises
    ------
    InputError
        If `constraints` is no function of p, or what it gives is no column of expressions in p, or a comparison.
    """
    if not callable(constraints):
        raise InputError("constraints", shown(constraints), EXAMPLE)
    p = ca.SX.sym("p", len(names))
    try:
        value = constraints(p)
    except Exception as error:  # the function is the user's: whatever it raises is told with what is expected
        raise stopped("constraints", constraints, error, EXAMPLE, f"p is ({', '.join(names)}).") from error
    g = as_expression("constraints", value)
    if g.numel() == 0 or 1 not in g.shape:
        raise InputError("constraints", f"expressions of shape {g.shape}", EXAMPLE)
    g = ca.densify(ca.vec(g))
    check_known("constraints", g, p=p)
    if any(not entry.is_constant() and entry.op() in COMPARISONS for entry in ca.vertsplit(g)):
        raise InputError("constraints", "a comparison", EXAMPLE, "Write a ≤ b as a - b.")
    return ca.Function("constraints", [p], [g])


def constraint_names(names: Any, count: int) -> tuple[str, ...]:
    """Different names of the constraints; "constraint 1", … by default."""
    given = as_names("constraint_names", names, count, "constraint ")
    if len(set(given)) < count or not all(name.strip() for name in given):
        raise InputError("constraint_names", list(given), "a different name for every constraint")
    return given


class UnitConstraints:
    """Constraints over the unit box, by the distance to their edges.

    A constraint g ≤ 0 and a growing function of it, such as exp(40 g) − 1 or g³, leave the same designs. What is
    violated and by how much, and where a search goes, therefore rests on g/|∇g| at the point (Newton), which is close
    to the distance from the edge however g is written. Where the slope vanishes with g it is a part of that distance.

    Parameters
    ----------
    function : casadi.Function
        p → g.
    lower, upper : (np,) arrays
    samples : (n, np) array
        Points of the unit box that the sizes are measured at.

    Attributes
    ----------
    count : int
        Number of constraints.
    not_finite : (m, np) array
        Samples at which a constraint is not finite.

    References
    ----------
    Higham, "Accuracy and Stability of Numerical Algorithms", SIAM, 2002, section 3.3 (running errors).
    Schröder, Mathematische Annalen 2, 1870 (g/g′ has a simple root where g has one of any order).
    """

    def __init__(self, function: ca.Function, lower: Array, upper: Array, samples: Array) -> None:
        v = ca.SX.sym("v", len(lower))
        p = ca.DM(lower) + v * ca.DM(upper - lower)
        g = function(p)
        self.count = g.numel()
        prices = ca.SX.sym("prices", self.count)
        self._g = ca.Function("g", [v], [g])
        self._rows = ca.Function("rows", [v], [ca.vec(ca.densify(ca.jacobian(g, v)).T)])
        self._rounding = ca.Function("rounding", [v], [np.finfo(float).eps * term_sizes(function, p)])
        self._curvature = ca.Function("H", [v, prices], [ca.densify(ca.hessian(ca.dot(prices, g), v)[0])])
        raw = _mapped(self._g, samples)
        self.not_finite = samples[~np.isfinite(raw).all(axis=1)]
        known = np.where(np.isfinite(raw), raw, 0.0)
        extent = np.ptp(np.quantile(known, EXTENT_QUANTILES, axis=0), axis=0)
        size = np.abs(known).max(axis=0)
        self._scale = np.where(extent > 1e-12 * size, extent, np.where(size > 0, size, 1.0))
        compressed = ca.asinh(g / ca.DM(self._near_edge(known, samples)))
        squares = ca.sum2(ca.densify(ca.jacobian(compressed, v)) ** 2)
        sought = ca.densify(compressed / ca.sqrt(squares + compressed**2 + TINY))
        self._values = ca.Function("h", [v], [sought])
        self._jacobian = ca.Function("dh", [v], [ca.densify(ca.jacobian(sought, v))])

    def _near_edge(self, values: Array, samples: Array) -> Array:
        """Least size (ng,) of each constraint among samples not on its edge."""
        slopes = self._slopes(samples)[1]
        size = np.abs(values)
        far = (size > 0) & (size > NEAR_EDGE * np.where(np.isfinite(slopes), slopes, 0.0))
        least = np.where(far, size, np.inf).min(axis=0)
        return np.where(np.isfinite(least), least, self._scale)

    def _slopes(self, points: Array) -> tuple[Array, Array]:
        """Slopes (n, ng, np) at points (n, np) and their lengths (n, ng)."""
        slopes = _mapped(self._rows, points).reshape(len(points), -1, points.shape[1])
        return slopes, np.nan_to_num(np.hypot.reduce(slopes, axis=-1), nan=np.inf, posinf=np.inf)

    def values(self, v: Array) -> Array:
        """Scaled constraints (ng,): sign of g, slope one across the edge.

        A search brings them to zero.

        It is g/|∇g| of an asinh of g, which makes a straight one of an exponential, and of less than one.
        """
        return np.asarray(self._values(v), dtype=float).ravel()

    def jacobian(self, v: Array) -> Array:
        """Slopes of the scaled constraints (ng, np); non-finite ones are zero."""
        slopes = np.asarray(self._jacobian(v), dtype=float)
        return np.where(np.isfinite(slopes), slopes, 0.0)

    def violation(self, v: Array) -> Any:
        """Largest violation () or (n,) at points (n, np); infinite where a constraint is.

        Of a constraint it is the larger of g/|∇g|, in lengths of the unit box and below one, and g in parts of how
        much g varies over the box. What rounding may make of a zero is zero.
        """
        points = np.atleast_2d(v)
        g = _mapped(self._g, points)
        slopes = self._slopes(points)[1]
        noise = _mapped(self._rounding, points)
        with np.errstate(invalid="ignore"):
            distance = g / np.hypot(slopes, np.maximum(np.abs(g), TINY))
            over = np.where(g > np.where(np.isfinite(noise), noise, 0.0), np.maximum(distance, g / self._scale), 0.0)
        worst = np.where(np.isfinite(g), over, np.inf).max(axis=1, initial=0.0)
        return worst if v.ndim == 2 else worst[0]

    def edges(self, v: Array, off: Array | None = None) -> tuple[Array, Array]:
        """Outward unit normals (ng, np) of the constraints and their distances (ng,).

        The distances are those of straight constraints: of signs opposite to those of g, infinite where g is level.
        With `off`, a direction (np,) that leads out, the normals are those beside the point, for constraints that are
        level at their edge.
        """
        g = np.asarray(self._g(v), dtype=float).ravel()
        (_, J), (own, slopes) = self._slopes(np.array([v, _beside(v, off)]))
        finite = np.isfinite(slopes) & (slopes > 0)
        normals = np.divide(J, slopes[:, None], out=np.zeros_like(J), where=finite[:, None])
        far = np.where(g < 0, np.inf, np.where(g > 0, -np.inf, 0.0))
        level = own <= LEVEL * np.abs(g)
        far = np.divide(-g, own, out=far, where=np.isfinite(own) & ~level)
        return normals, np.where(np.isfinite(own), far, -g / self._scale)

    def steepness(self, v: Array, free: Any) -> Array:
        """Slopes (ng,) of the constraints along the free entries, per unit-box length."""
        return np.asarray(np.linalg.norm(self._slopes(v[None])[0][0][:, free], axis=1))

    def curvature(self, v: Array, prices: Array, off: Array) -> Array:
        """Curvature (np, np) of the edges just off `v`, weighted with their prices (ng,)."""
        point = _beside(v, off)
        lengths = self._slopes(point[None])[1][0]
        paid = np.divide(prices, lengths, out=np.zeros(self.count), where=prices > 0)
        return np.asarray(self._curvature(point, paid), dtype=float)


def _beside(v: Array, off: Array | None) -> Array:
    """Point (np,) of the unit box just off `v`."""
    length = 0.0 if off is None else float(np.linalg.norm(off))
    return v if off is None or length == 0 else np.clip(v + BESIDE_LEVEL * off / length, 0.0, 1.0)


def _mapped(function: Callable[[Any], Any], points: Array) -> Array:
    """Values (n, m) of a CasADi function at points (n, np)."""
    if not len(points):
        return np.zeros((0, 0))
    return np.asarray(function(points.T), dtype=float).reshape(-1, len(points)).T
