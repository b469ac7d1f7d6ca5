"""Strictly convex dense QPs: scaled, warm-started, checked, with a fallback solver."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from typing import Any

import daqp
import numpy as np

from mpc.budgets import DAQP_ITERATIONS
from mpc.checks import Array
from mpc.plan import Residuals
from mpc.tolerances import EPS, KKT, NEGLIGIBLE, NO_BOUND, PRIMAL, SOLVERS


@dataclass(frozen=True, eq=False)
class QPResult:
    """Minimiser z, multipliers or proof of infeasibility, residuals, verdict and solver."""

    z: Array
    multipliers: Array
    residuals: Residuals
    infeasible: bool
    solver: str


class DenseQP:
    """Minimise ½ z'Hz + q'z subject to Gz <= b for many (q, b).

    Variables are scaled by the diagonal of H, rows to unit length and bounds to size one, so the answer does not
    depend on the units of inputs, states or cost. The solver is DAQP, a dual active-set method that keeps its
    factorisation and last active set (Arnström, Bemporad and Axehill, IEEE TAC 67(8), 2022). Its answer is checked
    against the optimality conditions; where they do not hold to `tolerances.KKT`, Clarabel, an interior-point method,
    is asked as well and the better answer returned. Every thread has a workspace of its own.

    Parameters
    ----------
    H : (n, n) array
        Hessian, positive definite.
    G : (m, n) array
        Rows of the constraints.
    units : (m,) array, optional
        Typical size of each entry of b; by default the sizes in b itself, taken anew in every solve.
    second : bool
        Whether Clarabel is asked where DAQP fails; without it the residuals say so.
    settings : dict, optional
        Further ones of DAQP.
    """

    def __init__(
        self, H: Array, G: Array, units: Array | None = None, *, second: bool = True,
        settings: dict[str, float] | None = None,
    ):  # fmt: skip
        self._d = 1 / np.sqrt(np.diag(H))
        self._H = np.ascontiguousarray(H * self._d * self._d[:, None])
        scaled = G * self._d
        length = np.sqrt(np.einsum("ij,ij->i", scaled, scaled))
        self._rows = np.flatnonzero(length > 0)  # the other rows do not depend on z
        self._empty = np.flatnonzero(length == 0)
        self._r = 1 / length[self._rows]
        self._G = np.ascontiguousarray(scaled[self._rows] * self._r[:, None])
        self._m = len(G)
        self.second = second
        # DAQP would give up at a cost beyond 1e30
        self._settings = {"primal_tol": PRIMAL, "iter_limit": DAQP_ITERATIONS, "fval_bound": 1e300} | (settings or {})
        self._units = units
        self._size = 0.0 if units is None else _typical(units[self._rows] * self._r)
        self._workspace = threading.local()

    def solve(self, q: Array, b: Array, *, confirm_infeasible: bool = False) -> QPResult:
        """Solve for one linear cost and right-hand side.

        With `confirm_infeasible` a problem that DAQP calls infeasible is solved again with Clarabel before it is
        reported so.
        """
        bs = b[self._rows] * self._r
        size = self._size_of(q * self._d, bs)
        qs = np.ascontiguousarray(q * self._d / size)
        bs = np.ascontiguousarray(np.minimum(bs / size, NO_BOUND))
        z, y, flag = self._daqp(qs, bs)
        residuals = self._residuals(z, y, qs, bs)
        solver = "DAQP"
        infeasible = flag == -1
        doubtful = (confirm_infeasible and infeasible) or (not infeasible and not residuals.worst <= KKT)
        if doubtful and self.second:
            z2, y2, infeasible = self._clarabel(qs, bs)
            second = self._residuals(z2, y2, qs, bs)
            if second.worst < residuals.worst:
                z = z2
                y = y2
                residuals = second
                solver = "Clarabel"
            infeasible = infeasible and not residuals.worst <= KKT
            if infeasible:
                y = y2
        multipliers = np.zeros(self._m)
        multipliers[self._rows] = y * self._r * size
        # a row that no variable reaches is violated or not
        unit = np.abs(b).max(initial=0.0) if self._units is None else self._units[self._empty]
        unreached = bool((b[self._empty] < -PRIMAL * unit).any())
        return QPResult(z * self._d * size, multipliers, residuals, infeasible or unreached, solver)

    def _size_of(self, q: Array, bs: Array) -> float:
        """Unit of the variables, from bounds, cost and violated rows.

        It is larger where the origin violates some rows by far more: their size is that of the answer, and `PRIMAL`
        would lie below their rounding.
        """
        size = _typical(bs) if self._units is None else self._size
        violated = float(np.max(-bs, initial=0.0))
        asked = max(float(np.abs(q).max(initial=0.0)), violated)
        return max(min(size, asked) if asked > 0 else size, EPS / PRIMAL * violated)

    def _daqp(self, q: Array, b: Array) -> tuple[Array, Array, int]:
        """Minimiser, multipliers and exit flag of DAQP, warm-started in this thread."""
        if not len(b):
            return np.asarray(np.linalg.solve(self._H, -q), dtype=np.float64), np.zeros(0), 1
        model = getattr(self._workspace, "model", None)
        if model is None:
            model = self._workspace.model = self._model(q, b, self._settings)
        else:
            model.update(f=q, bupper=b)
        if model is None:
            return np.full(len(q), np.nan), np.zeros(len(b)), 0
        z, _, flag, info = model.solve()
        if flag not in (1, -1):  # forget a spoilt working set
            self._workspace.model = None
        if flag == -2:  # rows that meet in one point let it go in circles, of which a larger tolerance leads out
            again = self._model(q, b, self._settings | {"primal_tol": NEGLIGIBLE})
            z, _, flag, info = again.solve() if again else (z, 0.0, flag, info)
        return np.asarray(z), np.asarray(info["lam"]), int(flag)

    def _model(self, q: Array, b: Array, settings: dict[str, float]) -> Any:
        """Workspace of DAQP, None where it cannot be made."""
        model = daqp.Model()
        model.settings = settings
        lower, senses = np.full(len(b), -NO_BOUND), np.zeros(len(b), dtype=np.int32)
        return None if model.setup(self._H, q, self._G, b, lower, senses)[0] < 0 else model

    def _clarabel(self, q: Array, b: Array) -> tuple[Array, Array, bool]:
        """Minimiser, multipliers and verdict of infeasibility of Clarabel."""
        from scipy.sparse import csc_matrix, triu

        # the cone solver is not scale-free in (q, b)
        unit = max(1.0, float(np.abs(q).max(initial=0.0)))
        z, y, infeasible = clarabel_solution(csc_matrix(triu(self._H)), q, csc_matrix(self._G), b, unit)
        return z, np.maximum(y, 0.0), infeasible

    def _residuals(self, z: Array, y: Array, q: Array, b: Array) -> Residuals:
        """Relative KKT residuals, from the scaled data alone."""
        tiny = NEGLIGIBLE  # of the bounds, which say what is small where everything vanishes, as at the origin
        with np.errstate(invalid="ignore", over="ignore"):
            Hz = self._H @ z
            Gy = y @ self._G
            over = self._G @ z - b
            force = max(_length(Hz), _length(q), _length(Gy), tiny)
            size = np.maximum(np.abs(b), max(_length(z), tiny))
            active = max(force, _length(y))  # NaN where the force is
            return Residuals(
                stationarity=_length(Hz + q + Gy) / force,
                primal=float((over / size).max(initial=0.0)),
                dual=max(-float(y.min(initial=0.0)), 0.0) / active,
                complementarity=_length(y * over / size) / active,
            )


def clarabel_solution(H: Any, q: Array, K: Any, b: Array, unit: float, equal: int = 0) -> tuple[Array, Array, bool]:
    """Minimiser of ½ z'Hz + q'z with Kz <= b, its first `equal` rows equalities, multipliers, whether it is infeasible.

    H : upper triangle, K : both sparse; unit : what the data are divided by, since the tolerances are absolute, too.
    """
    import clarabel

    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_feas = settings.tol_gap_abs = settings.tol_gap_rel = SOLVERS
    cones = [clarabel.ZeroConeT(equal)] * (equal > 0) + [clarabel.NonnegativeConeT(len(b) - equal)]
    solution = clarabel.DefaultSolver(H, q / unit, K, b / unit, cones, settings).solve()
    infeasible = "PrimalInfeasible" in str(solution.status)
    return np.array(solution.x) * unit, np.array(solution.z) * unit, infeasible


def _length(v: Array) -> float:
    """Euclidean norm."""
    return math.sqrt(v @ v)


def _typical(b: Array) -> float:
    """Tenth percentile of the nonzero sizes, 1 without any."""
    sizes = np.abs(b[b != 0])
    if not len(sizes):
        return 1.0
    return max(float(np.partition(sizes, len(sizes) // 10)[len(sizes) // 10]), np.finfo(float).tiny)
