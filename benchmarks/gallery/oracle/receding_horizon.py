"""Model predictive control with a state limit that may be exceeded at a price: Clarabel, one problem a sample."""

from __future__ import annotations

import clarabel
import numpy as np
from scipy import sparse
from scipy.linalg import solve_discrete_are

from gallery.oracle.cost import simulated
from gallery.oracle.statement import Array, Statement

PRICE = 1e2  # of a half-width outside X, linear, relative to the cost of a step at the limit


class RecedingHorizon:
    """u (n, nu) of states (n, nx): the first input of the plan of N steps that LQR continues.

    Decision variables are x_1 … x_N, u_0 … u_{N−1} and the depths s_1 … s_N outside X, in half-widths.
    """

    def __init__(self, s: Statement, p: Array, horizon: int = 20) -> None:
        A, B, _ = s.sampled(p)
        self.A = A
        self.first_input = slice(horizon * len(A), horizon * len(A) + B.shape[1])
        self.weight, self.linear = _costs(s, A, B, horizon)
        rows, lower, upper = _constraints(s, A, B, horizon)
        dynamics = horizon * len(A)  # whose bounds are equal
        above, below = (np.flatnonzero(np.isfinite(side[dynamics:])) + dynamics for side in (upper, lower))
        self.rows = sparse.vstack([rows[:dynamics], rows[above], -rows[below]], format="csc")
        self.sides = np.concatenate([upper[:dynamics], upper[above], -lower[below]])
        self.cones = [clarabel.ZeroConeT(dynamics), clarabel.NonnegativeConeT(len(above) + len(below))]
        self.settings = clarabel.DefaultSettings()
        self.settings.verbose = False

    def __call__(self, x: Array) -> Array:
        """Inputs (n, nu)."""
        return np.array([self._planned(row)[self.first_input] for row in x])

    def _planned(self, x: Array) -> Array:
        """The decision variables of the best plan from x (nx,)."""
        sides = self.sides.copy()
        sides[: len(x)] = self.A @ x
        solver = clarabel.DefaultSolver(
            sparse.triu(self.weight, format="csc"), self.linear, self.rows, sides, self.cones, self.settings
        )
        found = solver.solve()
        if found.status != clarabel.SolverStatus.Solved:
            raise RuntimeError(f"Clarabel: {found.status} from {x}")
        return np.array(found.x)


def _costs(s: Statement, A: Array, B: Array, N: int) -> tuple[sparse.csc_matrix, Array]:
    """Twice the quadratic weight and the linear one; x_N carries the Riccati matrix, which holds its own Q."""
    P = solve_discrete_are(A, B, np.diag(s.Q), np.diag(s.R))
    depths = sparse.csc_matrix((N * len(A), N * len(A)))
    weight = sparse.block_diag([*[np.diag(s.Q)] * (N - 1), P, *[np.diag(s.R)] * N, depths], format="csc")
    price = PRICE * np.mean(s.Q * s.x_max**2)
    return 2 * weight, np.r_[np.zeros(N * sum(B.shape)), np.full(N * len(A), price)]


def _constraints(s: Statement, A: Array, B: Array, N: int) -> tuple[sparse.csc_matrix, Array, Array]:
    """Rows with their bounds: the dynamics, |x| ≤ x_max (1 + s), |u| ≤ u_max, s ≥ 0."""
    nx, nu = B.shape
    x = sparse.eye(N * nx)
    before = sparse.kron(sparse.eye(N, k=-1), A)
    into = sparse.kron(sparse.eye(N), B)
    outside = sparse.kron(sparse.eye(N), np.diag(s.x_max))
    rows = sparse.bmat(
        [[x - before, -into, None], [x, None, -outside], [x, None, outside], [None, sparse.eye(N * nu), None],
         [None, None, x]], format="csc",
    )  # fmt: skip
    limit = np.tile(s.x_max, N)
    bound = np.tile(s.u_max, N)
    zero = np.zeros(N * nx)
    free = np.full(N * nx, np.inf)
    return rows, np.r_[zero, -free, -limit, -bound, zero], np.r_[zero, limit, free, bound, free]


def limited_return(s: Statement, p: Array, w: Array) -> tuple[float, float, float]:
    """Mean return of MPC, and the mean and the largest depth outside X in half-widths, at one design."""
    A, B, E = s.sampled(p)
    mpc = RecedingHorizon(s, p)
    total, states, _ = simulated(s, lambda x, u, w_k: x @ A.T + u @ B.T + w_k @ E.T, mpc, w)
    depth = np.maximum(np.abs(states) / s.x_max - 1, 0).max(axis=2)
    return float(total.mean()), float(depth.mean()), float(depth.max())
