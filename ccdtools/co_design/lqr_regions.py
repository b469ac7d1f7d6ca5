"""States that saturated LQR keeps within X for ever, by simulation.

A state belongs to the region of its design if the nominal loop x⁺ = A x + B clip(−K x) stays within X until it
enters an ellipsoid in which −K x needs no clipping and x stays within X; the ellipsoid is invariant. So the region is a
positively invariant part of X_fea(p), found without a polytope. Simulating costs milliseconds where the recursion for
X_fea(p) of a weakly damped plant costs minutes.

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
    k: Array  # (n, nu): offsets against a stated mean of the disturbance; regions are of the loop without either
    lower: Array  # (n, nu): input bounds
    upper: Array  # (n, nu)
    rows: Array | None  # (n, m, nx): X as {x : rows x <= 1}; None where 0 is not inside X or U, so no region is known
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
        rows = _unit_rows(problem, designs) if (lower < 0).all() and (upper > 0).all() else None
        shapes = np.full_like(A, np.inf)
        if rows is not None:
            for i in np.flatnonzero(np.isfinite(K).all(axis=(1, 2))):
                limits = np.vstack([rows[i], -K[i] / upper[i][:, None], -K[i] / lower[i][:, None]])
                shapes[i] = _ellipsoid(A[i] - B[i] @ K[i], limits, problem.state_scale)
        sampled = None if isinstance(problem.model, LinearModel) else problem.model
        shapes = shapes if sampled is None else shapes / NEARLY_LINEAR**2
        return cls(A, B, E, K, k, lower, upper, rows, shapes, designs, sampled)

    def of_runs(self, runs: Indices) -> LQRRegions:
        """Regions of some of the designs."""
        names = ("A", "B", "E", "K", "k", "lower", "upper", "shapes", "designs")
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
            within = (times(self.rows[runs[left]], x[left]) <= 1 + ON_LIMIT).all(axis=1)
            arrived = within & (_quadratic(self.shapes[runs[left]], x[left]) <= 1)
            inside[left[arrived]] = True
            going = within & ~arrived
            left = left[going]
            if not len(left):
                break
            x = x.copy()
            x[left] = self.step(x[left], self._inputs(x[left], runs[left], 0.0), runs[left])
        return inside

    def inputs(self, x: Array, runs: Indices) -> Array:
        """Saturated LQR inputs (k, nu) of states (k, nx) at designs `runs`."""
        return self._inputs(x, runs, self.k[runs])

    def _inputs(self, x: Array, runs: Indices, offset: Array | float) -> Array:
        """Inputs (k, nu) with another offset."""
        return np.clip(offset - times(self.K[runs], x), self.lower[runs], self.upper[runs])

    def step(self, x: Array, u: Array, runs: Any, w: Array | None = None) -> Array:
        """Next states (k, nx) at designs `runs`, nominal ones without disturbances (k, nw)."""
        if self.sampled is not None:
            drive = np.zeros(self.sampled.nw) if w is None else w
            return np.asarray(self.sampled.advance(x, u, drive, self.designs[runs]))
        after = times(self.A[runs], x) + times(self.B[runs], u)
        return after if w is None else after + times(self.E[runs], w)

    def reach(self, x: Array, runs: Indices) -> Array:
        """Approximate largest scales (k,) in [0, 1] with scale · x in the region.

        They are 0 where none is known.

        Geometric bisection between the ellipsoid and x.
        """
        low = np.zeros(len(x))
        if self.rows is None:
            return low
        size = _quadratic(self.shapes[runs], x)
        known = np.isfinite(size)
        low[known] = 1 / np.sqrt(np.maximum(size[known], 1.0))
        high = np.ones(len(x))
        low[self.contains(x, runs)] = 1.0
        for _ in range(10):  # from 1e-6 to 1 this leaves 1.4 %
            middle = np.sqrt(low * high)
            inside = self.contains(middle[:, None] * x, runs)
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


def _unit_rows(problem: CoDesignProblem, designs: Array) -> Array | None:
    """Rows (n, m, nx) of X with right-hand side 1; None where 0 is not well inside X."""
    if isinstance(problem.X, DesignLimits):
        least, largest = (bound / problem.state_scale for bound in problem.X.bounds(designs))
        if not (least < -ON_LIMIT).all() or not (largest > ON_LIMIT).all():
            return None
        eye = np.eye(problem.model.nx) / problem.state_scale
        return np.concatenate([eye / largest[:, :, None], eye / least[:, :, None]], axis=1)
    room = problem.X.b / (np.abs(problem.X.A) @ problem.state_scale)
    if len(problem.X.b_eq) or not (room > ON_LIMIT).all():
        return None
    rows = problem.X.A / problem.X.b[:, None]
    return np.broadcast_to(rows, (len(designs), *rows.shape))


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
