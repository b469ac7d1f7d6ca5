"""Constraints g(p) ≤ 0 on the designs of a box: as CasADi expressions, and scaled over the unit box."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import nnls

from ccdtools.arrays import Array
from ccdtools.checks import as_names, shown
from ccdtools.exceptions import InputError
from ccdtools.plants.symbols import as_expression, check_known

COMPARISONS = (ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_AND, ca.OP_OR, ca.OP_NOT)
EXAMPLE = "a function of p that gives expressions, each to be ≤ 0, such as lambda p: p[0] + p[1] - 3.0"
EXTENT = (0.05, 0.95)  # quantiles of a constraint over the box, between which its size is measured: a pole is left out
EXACT = 1e-9  # violation, beside that size, that is rounding
ON_EDGE = 1e-7  # of that size: a constraint that is closer to zero may hold a design
CURVED = 0.1  # curvature of the distance along the constraints below which its own curvature is left out


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
        first = (str(error).strip().splitlines() or [type(error).__name__])[-1][:120]
        got = f"a function that fails at p ({', '.join(names)}): {first}"
        raise InputError("constraints", got, EXAMPLE) from error
    g = as_expression("constraints", value)
    if g.numel() == 0 or 1 not in g.shape:
        raise InputError("constraints", f"expressions of shape {g.shape}", EXAMPLE)
    g = ca.vec(g)
    check_known("constraints", g, p=p)
    if any(not entry.is_constant() and entry.op() in COMPARISONS for entry in ca.vertsplit(g)):
        raise InputError("constraints", "a comparison", EXAMPLE, "Write a ≤ b as a - b.")
    return ca.Function("constraints", [p], [g])


def constraint_names(names: Any, count: int) -> tuple[str, ...]:
    """One different name for each constraint; "constraint 1", … by default."""
    if isinstance(names, tuple) and not names:
        return tuple(f"constraint {i + 1}" for i in range(count))
    given = as_names("constraint_names", names, count)
    if len(set(given)) < count or not all(name.strip() for name in given):
        raise InputError("constraint_names", list(given), "a different name for every constraint")
    return given


class UnitConstraints:
    """The constraints over the unit box, each divided by its own size.

    Parameters
    ----------
    function : casadi.Function
        p → g.
    lower, upper : (np,) arrays
    samples : (n, np) array
        Points of the unit box that the sizes are measured at.

    Attributes
    ----------
    scale : (ng,) array
        What each constraint is divided by: how much it varies over the box, its poles left out.
    """

    def __init__(self, function: ca.Function, lower: Array, upper: Array, samples: Array) -> None:
        v = ca.SX.sym("v", len(lower))
        g = function(ca.DM(lower) + v * ca.DM(upper - lower))
        prices = ca.SX.sym("prices", g.numel())
        raw = _mapped(ca.Function("g", [v], [ca.densify(g)]), samples)
        self.not_finite = ~np.isfinite(raw).all(axis=1)
        known = np.where(np.isfinite(raw), raw, 0.0)
        extent = np.ptp(np.quantile(known, EXTENT, axis=0), axis=0)
        size = np.abs(known).max(axis=0)
        self.scale: Array = np.where(extent > 1e-12 * size, extent, np.where(size > 0, size, 1.0))
        scaled = ca.densify(g / ca.DM(self.scale))
        curvature = ca.hessian(ca.dot(prices, scaled), v)[0]
        self._values = ca.Function("g", [v], [scaled])
        self._jacobian = ca.Function("J", [v], [ca.densify(ca.jacobian(scaled, v))])
        self._curvature = ca.Function("H", [v, prices], [ca.densify(curvature)])

    def values(self, v: Array) -> Array:
        """Scaled values (ng,) at a point of the unit box, or (n, ng) at points (n, np)."""
        if v.ndim == 2:
            return _mapped(self._values, v)
        return np.asarray(self._values(v), dtype=float).ravel()

    def jacobian(self, v: Array) -> Array:
        """Their slopes (ng, np)."""
        return np.asarray(self._jacobian(v), dtype=float)

    def violation(self, v: Array) -> Any:
        """The largest scaled value above zero, (), or (n,) at points (n, np); infinite where one is not finite."""
        g = self.values(v)
        return np.maximum(np.where(np.isfinite(g), g, np.inf).max(axis=-1), 0.0)

    def distances(self, v: Array) -> Array:
        """About how far the edge of each constraint is in the unit box, (ng,); below zero where it is violated."""
        g = self.values(v)
        slopes = np.linalg.norm(self.jacobian(v), axis=1)
        far = np.where(g < 0, np.inf, np.where(g > 0, -np.inf, 0.0))
        return np.divide(-g, slopes, out=far, where=slopes > 1e-12)

    def prices(self, u: Array, push: Array, free: Any) -> tuple[Array, Array, Array]:
        """What holds a point against a push: see `held`. Here the edges are those of constraints and unit box at `u`.

        Returns
        -------
        (ng,), (np,) and (np,) arrays
            Prices of the constraints, those of the bounds (below zero at a lower one), and what is left of the push.
        """
        g = self.values(u)
        at = np.flatnonzero(g >= -ON_EDGE)
        J = self.jacobian(u)[at]
        low = np.flatnonzero(free & (u <= 0.0))
        high = np.flatnonzero(free & (u >= 1.0))
        eye = np.eye(len(u))
        normals = np.vstack([J, -eye[low], eye[high]])[:, free]
        paid = held(normals, push[free])
        constraints = np.zeros(len(g))
        constraints[at] = paid[: len(at)]
        bounds = np.zeros(len(u))
        bounds[low] = -paid[len(at) : len(at) + len(low)]
        bounds[high] = paid[len(at) + len(low) :]
        rest = np.zeros(len(u))
        rest[free] = push[free] - paid @ normals
        return constraints, bounds, rest

    def pulled_back(self, v: Array, u: Array, gradient: Array, free: Any) -> Array:
        """Gradient at `v` of a function of the nearest point `u` that the constraints allow, from that at `u`, (np,).

        The nearest point moves along the constraints that hold it alone, and by less where they are curved away.
        """
        constraints, bounds, _ = self.prices(u, v - u, free)
        eye = np.eye(len(v))
        normals = np.vstack([self.jacobian(u)[constraints > 0], eye[bounds != 0], eye[~free]])
        along = _null_space(normals)
        curvature = along.T @ (eye + np.asarray(self._curvature(u, constraints), dtype=float)) @ along
        if not along.size:
            return np.zeros(len(v))
        if np.linalg.eigvalsh(curvature)[0] < CURVED:
            curvature = np.eye(along.shape[1])
        return np.asarray(along @ np.linalg.solve(curvature, along.T @ gradient), dtype=float)


def held(normals: Array, push: Array) -> Array:
    """Prices ≥ 0 of edges with outward normals (m, np) that leave of a push (np,) what may be followed, (m,).

    The rest, push − prices · normals, is the push's projection on the directions that cross no edge (Moreau).
    """
    if not len(normals):
        return np.zeros(0)
    lengths = np.linalg.norm(normals, axis=1)
    lengths = np.where(lengths > 0, lengths, 1.0)
    paid = nnls((normals / lengths[:, None]).T, push)[0] / lengths
    return np.asarray(paid, dtype=float)


def _null_space(normals: Array) -> Array:
    """An orthonormal basis (np, k) of what is at right angles to normals (m, np) of whatever length."""
    if not len(normals):
        return np.eye(normals.shape[1])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    _, sizes, rows = np.linalg.svd(normals / np.where(lengths > 0, lengths, 1.0))
    return np.asarray(rows[(sizes > 1e-8).sum() :].T)


def _mapped(function: Callable[[Any], Any], points: Array) -> Array:
    """Values (n, m) of a CasADi function at points (n, np)."""
    if not len(points):
        return np.zeros((0, 0))
    return np.asarray(function(points.T), dtype=float).reshape(-1, len(points)).T
