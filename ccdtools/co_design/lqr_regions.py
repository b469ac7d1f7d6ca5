"""States that saturated LQR keeps within X for ever, by simulation.

A state belongs to the region of its design if the loop x⁺ = A x + B clip(k − K x) + E d, with the stated mean d of the
disturbance, stays within X until it enters an ellipsoid about its rest in which no input needs clipping and x stays
within X; the ellipsoid is invariant. So the region is a positively invariant part of X_fea(p), found without a
polytope. Simulating costs milliseconds where the recursion for X_fea(p) of a weakly damped plant costs minutes.

References
----------
Gilbert, Tan (1991), IEEE TAC 36(9): trajectories that keep the constraints until a certified set is reached.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError, solve_discrete_lyapunov

from ccdtools.arrays import Array, Indices, Mask
from ccdtools.co_design.design_controllers import lqr_laws
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.tolerances import NEARLY_LINEAR
from ccdtools.design_limits import DesignLimits
from ccdtools.exceptions import InputError
from ccdtools.plants.linear_model import LinearModel
from ccdtools.tolerances import ON_LIMIT


@dataclass(frozen=True, eq=False)
class LQRRegions:
    """Regions of n designs."""

    A: Array  # (n, nx, nx): of each design's model
    B: Array  # (n, nx, nu)
    E: Array  # (n, nx, nw)
    K: Array  # (n, nu, nx): LQR gains, u = k − K x; NaN where a design cannot be stabilised
    k: Array  # (n, nu): offsets against the mean
    mean: Array  # (nw,): of the disturbance, as stated
    rest: Array  # (n, nx): where the loops rest under the mean; 0 without LQR
    lower: Array  # (n, nu): input bounds
    upper: Array  # (n, nu)
    # (n, m, nx): X as {x : rows (x − rest) <= 1}, NaN where the rest is not inside X or U, so no region is known; None
    # where that is so everywhere
    rows: Array | None
    # (n, nx, nx): M with x'Mx <= 1 inside X and without clipping, invariant under LQR. Of a model that is not linear, a
    # tenth of the ellipsoid of its linearisation in every direction: there it is as good as linear
    shapes: Array
    designs: Array  # (n, np)
    sampled: Any = None  # the model where it is not linear; A, B and E are then its linearisation

    @classmethod
    def of(cls, problem: CoDesignProblem, designs: Array) -> LQRRegions:
        """Regions of designs (n, np)."""
        A, B, E = problem.model.matrices(designs)
        K, k = lqr_laws(problem, (A, B, E), designs)
        designs = np.asarray(designs, dtype=float)
        bounds = problem.input_bounds_at(designs)
        lower, upper = (np.broadcast_to(bound, (len(designs), problem.model.nu)) for bound in bounds)
        shapes = np.full_like(A, np.inf)
        sampled = None if isinstance(problem.model, LinearModel) else problem.model
        none = np.zeros(A.shape[:2])
        regions = cls(A, B, E, K, k, problem.mean_disturbance, none, lower, upper, None, shapes, designs, sampled)
        rest = regions._rests(problem.state_scale)
        still = k - times(K, rest)
        rows = _unit_rows(problem, designs, rest)
        rows[~((lower < still) & (still < upper)).all(axis=1)] = np.nan
        for i in np.flatnonzero(np.isfinite(rows).all(axis=(1, 2))):
            sides = (-K[i] / (bound[i] - still[i])[:, None] for bound in (upper, lower))
            shapes[i] = _ellipsoid(A[i] - B[i] @ K[i], np.vstack([rows[i], *sides]), problem.state_scale)
        shapes = shapes if sampled is None else shapes / NEARLY_LINEAR**2
        known = rows if np.isfinite(rows).any() else None
        return replace(regions, rest=np.nan_to_num(rest), rows=known, shapes=shapes)

    def _rests(self, scale: Array, rounds: int = 20) -> Array:
        """States (n, nx) where unclipped LQR rests; NaN without one."""
        rest = np.full(self.rest.shape, np.nan)
        runs = np.flatnonzero(self.stabilised)
        K, k, x = self.K[runs], self.k[runs], self.rest[runs]
        moved = np.asarray(np.linalg.inv(np.eye(x.shape[1]) - self.A[runs] + self.B[runs] @ K), dtype=float)
        mean = np.broadcast_to(self.mean, (len(runs), len(self.mean)))
        drift: Array = np.full_like(x, np.inf)
        for _ in range(rounds):  # of a linear model the first one ends there
            drift = self.step(x, k - times(K, x), runs, mean) - x
            x = x + times(moved, drift)
        settled = (np.abs(drift) <= ON_LIMIT * scale).all(axis=1)
        rest[runs[settled]] = x[settled]
        return rest

    def of_runs(self, runs: Indices) -> LQRRegions:
        """Regions of some of the designs."""
        names = ("A", "B", "E", "K", "k", "rest", "lower", "upper", "shapes", "designs")
        parts: dict[str, Any] = {name: getattr(self, name)[runs] for name in names}
        return replace(self, rows=None if self.rows is None else self.rows[runs], **parts)

    @property
    def stabilised(self) -> Mask:
        """Whether each design has an LQR, (n,)."""
        return np.asarray(np.isfinite(self.K).all(axis=(1, 2)))

    def contains(self, x: Array, runs: Indices) -> Mask:
        """Whether x[i] (k, nx) lies in region runs[i] (k,)."""
        inside = np.zeros(len(x), bool)
        if self.rows is None:
            return inside
        left = np.flatnonzero(self.stabilised[runs])
        for _ in range(2000):  # a longer loop counts as outside
            away = x[left] - self.rest[runs[left]]
            within = (times(self.rows[runs[left]], away) <= 1 + ON_LIMIT).all(axis=1)
            arrived = within & (_quadratic(self.shapes[runs[left]], away) <= 1)
            inside[left[arrived]] = True
            going = within & ~arrived
            left = left[going]
            if not len(left):
                break
            x = x.copy()
            mean = np.broadcast_to(self.mean, (len(left), len(self.mean)))
            x[left] = self.step(x[left], self.inputs(x[left], runs[left]), runs[left], mean)
        return inside

    def inputs(self, x: Array, runs: Indices) -> Array:
        """Saturated LQR inputs (k, nu) of states (k, nx) at designs `runs`."""
        return np.clip(self.k[runs] - times(self.K[runs], x), self.lower[runs], self.upper[runs])

    def step(self, x: Array, u: Array, runs: Any, w: Array) -> Array:
        """Next states (k, nx) at designs `runs`, under w (k, nw)."""
        if self.sampled is not None:
            return np.asarray(self.sampled.advance(x, u, w, self.designs[runs]))
        return times(self.A[runs], x) + times(self.B[runs], u) + times(self.E[runs], w)

    def reach(self, x: Array, runs: Indices) -> Array:
        """Largest scales (k,) in [0, 1] from the rest to x within the region.

        They are 0 where none is known. Geometric bisection between the ellipsoid and x.
        """
        rest = self.rest[runs]
        away = x - rest
        low = np.zeros(len(x))
        if self.rows is None:
            return low
        size = _quadratic(self.shapes[runs], away)
        known = np.isfinite(size)
        low[known] = 1 / np.sqrt(np.maximum(size[known], 1.0))
        high = np.ones(len(x))
        low[self.contains(x, runs)] = 1.0
        for _ in range(10):  # from 1e-6 to 1 this leaves 1.4 %
            middle = np.sqrt(low * high)
            inside = self.contains(rest + middle[:, None] * away, runs)
            low = np.where(inside, middle, low)
            high = np.where(inside, high, middle)
        return low


def times(M: Array, x: Array) -> Array:
    """M[i] @ x[i] for every i.

    Raises
    ------
    InputError
        If the vectors are not as wide as the matrices; a width of one would be broadcast.
    """
    if M.shape[2] != x.shape[1]:
        raise InputError("x", f"{x.shape[1]} columns", f"{M.shape[2]}, as the matrices have")
    products: Array = np.einsum("nij,nj->ni", M, x)
    return products


def _quadratic(M: Array, x: Array) -> Array:
    """x[i]' M[i] x[i] for every i, inf where M is."""
    known = np.isfinite(M).all(axis=(1, 2))
    values = np.full(len(x), np.inf)
    values[known] = np.einsum("ni,nij,nj->n", x[known], M[known], x[known])
    return values


def _unit_rows(problem: CoDesignProblem, designs: Array, rest: Array) -> Array:
    """Rows (n, m, nx) of X about the rest; NaN without room."""
    X: Any = problem.X
    if isinstance(X, DesignLimits):
        lower, upper = X.bounds(designs)
        H, h = np.vstack([np.eye(problem.model.nx), -np.eye(problem.model.nx)]), np.hstack([upper, -lower])
    else:
        H, h = X.A, X.b
    room: Array = h - rest @ H.T
    inside: Any = (room > ON_LIMIT * (np.abs(H) @ problem.state_scale)).all(axis=1)
    inside &= isinstance(X, DesignLimits) or not len(X.b_eq)
    return np.asarray(H / np.where(inside[:, None], room, np.nan)[:, :, None])


def _ellipsoid(closed: Array, limits: Array, scale: Array) -> Array:
    """Invariant ellipsoid M (nx, nx), x'Mx <= 1, inside {limits x <= 1}; inf if none found."""
    unit = closed * scale / scale[:, None]
    rows = limits * scale
    try:
        M = solve_discrete_lyapunov(unit.T, np.eye(len(unit)))
        widest = np.einsum("mi,im->m", rows, np.linalg.solve(M, rows.T)).max()
    except (LinAlgError, ValueError):
        return np.full_like(closed, np.inf)
    M = M * widest
    decreasing = np.linalg.eigvalsh(unit.T @ M @ unit - M).max() < 0
    return M / scale / scale[:, None] if decreasing else np.full_like(closed, np.inf)
