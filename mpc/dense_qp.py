"""A dense strictly convex QP solved many times: scaled, warm-started, checked, with a second solver behind it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import daqp
import numpy as np

from mpc.checks import Array
from mpc.plan import Residuals

TOLERANCE = 1e-7  # relative KKT residual above which the second solver is asked
_NO_BOUND = 1e30
_SETTINGS = {"primal_tol": 1e-9, "iter_limit": 10_000}


@dataclass(frozen=True, eq=False)
class QPResult:
    """Minimiser z, multipliers of Gz <= b, residuals, infeasibility flag and solver name."""

    z: Array
    multipliers: Array
    residuals: Residuals
    infeasible: bool
    solver: str


class DenseQP:
    """Minimise ½ z'Hz + q'z subject to Gz <= b for many (q, b), H positive definite.

    Variables are scaled by the diagonal of H and rows to unit length, so the answer does not depend on the units of
    inputs, states or cost. The solver is DAQP, a dual active-set method that keeps its factorisation and last active
    set (Arnström, Bemporad and Axehill, IEEE TAC 67(8), 2022). Its answer is checked against the optimality
    conditions; where they do not hold to `TOLERANCE`, Clarabel, an interior-point method, is asked as well and the
    better answer returned. The workspace makes an instance unsuited to use from two threads at once.
    """

    def __init__(self, H: Array, G: Array):
        self._d = 1 / np.sqrt(np.diag(H))
        self._H = np.ascontiguousarray(H * np.outer(self._d, self._d))
        scaled = G * self._d
        length = np.linalg.norm(scaled, axis=1)
        self._rows = np.flatnonzero(length > 0)  # the other rows do not depend on z
        self._empty = np.flatnonzero(length == 0)
        self._r = 1 / length[self._rows]
        self._G = np.ascontiguousarray(scaled[self._rows] * self._r[:, None])
        self._m = len(G)
        self._model: daqp.Model | None = None

    def __getstate__(self) -> dict[str, Any]:
        """The workspace of the solver is not copied: a copy sets up its own."""
        return self.__dict__ | {"_model": None}

    def solve(self, q: Array, b: Array, *, doubt: bool = False) -> QPResult:
        """Solve for one linear cost and right-hand side; `doubt` has a verdict of infeasibility confirmed."""
        qs, bs = np.ascontiguousarray(q * self._d), np.ascontiguousarray(b[self._rows] * self._r)
        unreachable = bool((b[self._empty] < -1e-9 * max(1.0, float(np.abs(b).max(initial=0.0)))).any())
        z, y, flag = self._daqp(qs, bs)
        residuals = self._residuals(z, y, qs, bs)
        solver = "DAQP"
        infeasible = unreachable or flag == -1
        if (doubt and infeasible) or (not infeasible and not residuals.worst <= TOLERANCE):
            z2, y2, infeasible = self._clarabel(qs, bs)
            second = self._residuals(z2, y2, qs, bs)
            if second.worst < residuals.worst:
                z, y, residuals, solver = z2, y2, second, "Clarabel"
        multipliers = np.zeros(self._m)
        multipliers[self._rows] = y * self._r
        return QPResult(z * self._d, multipliers, residuals, infeasible, solver)

    def _daqp(self, q: Array, b: Array) -> tuple[Array, Array, int]:
        if not len(b):
            return np.asarray(np.linalg.solve(self._H, -q), dtype=np.float64), np.zeros(0), 1
        if self._model is None:
            model = daqp.Model()
            model.settings = _SETTINGS
            lower = np.full(len(b), -_NO_BOUND)
            if model.setup(self._H, q, self._G, b, lower, np.zeros(len(b), dtype=np.int32))[0] < 0:
                return np.full(len(q), np.nan), np.zeros(len(b)), 0
            self._model = model
        else:
            self._model.update(f=q, bupper=b)
        z, _, flag, info = self._model.solve()
        if flag not in (1, -1):  # forget a spoilt working set
            self._model = None
        return np.asarray(z), np.asarray(info["lam"]), int(flag)

    def _clarabel(self, q: Array, b: Array) -> tuple[Array, Array, bool]:
        import clarabel
        from scipy.sparse import csc_matrix, triu

        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_feas = settings.tol_gap_abs = settings.tol_gap_rel = 1e-11
        # the cone solver is not scale-free in (q, b); z = σ z' makes both about one
        sigma = max(1.0, float(np.abs(q).max(initial=0.0)))
        cones = [clarabel.NonnegativeConeT(len(b))]
        problem = clarabel.DefaultSolver(
            csc_matrix(triu(self._H)), q / sigma, csc_matrix(self._G), b / sigma, cones, settings
        )
        solution = problem.solve()
        infeasible = "PrimalInfeasible" in str(solution.status)
        return np.array(solution.x) * sigma, np.maximum(solution.z, 0.0) * sigma, infeasible

    @staticmethod
    def _middle(b: Array) -> float:
        return float(np.partition(np.abs(b), len(b) // 2)[len(b) // 2]) if len(b) else 0.0

    def _residuals(self, z: Array, y: Array, q: Array, b: Array) -> Residuals:
        """Relative KKT residuals, from the scaled data alone."""
        # where everything vanishes, as at the origin, the bounds say what is small
        tiny = max(1e-6 * self._middle(b), np.finfo(float).tiny)
        Hz, Gy, Gz = self._H @ z, y @ self._G, self._G @ z
        force = max(np.abs(Hz).max(initial=0.0), np.abs(q).max(initial=0.0), np.abs(Gy).max(initial=0.0), tiny)
        size = np.maximum(np.abs(b), max(np.abs(z).max(initial=0.0), tiny))
        active = max(np.abs(y).max(initial=0.0), force)
        with np.errstate(invalid="ignore", over="ignore"):
            return Residuals(
                stationarity=float(np.abs(Hz + q + Gy).max(initial=0.0) / force),
                primal=float(np.max((Gz - b) / size, initial=0.0)),
                dual=float(np.max(-y, initial=0.0) / active),
                complementarity=float(np.max(np.abs(y * (Gz - b)) / (active * size), initial=0.0)),
            )
