"""How far a plan of the sparse QP misses its optimum, told by the states that it leads to."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from mpc.checks import Array
from mpc.stages import Staging
from mpc.tolerances import INTERIOR_POINT, KKT_REPORTED, NEGLIGIBLE, REMEMBERED


class PlanCheck:
    """Gradient by the inputs alone, and duality gap, each relative to its own parts.

    In the residuals of all variables those of another size would hide it. With a cross weight the parts may cancel to a
    cost that is small beside them: then what both can have lost, by convexity, is also set against the cost itself.

    Parameters
    ----------
    staging : Staging
        Gives the order and the sizes of the variables.
    H : (n, n) sparse matrix
        Hessian, both triangles.
    K : (m, n) sparse matrix
        Rows: first state and dynamics, then limits.
    """

    def __init__(self, staging: Staging, H: Any, K: Any):
        problem = staging.problem
        self._size = staging.state_size
        self._inputs, self._states = _columns(staging)
        self._H = H
        self._equal = self._states.size
        dynamics, self._limits = K[: self._equal], K[self._equal :].tocsr()
        self._limits_T = self._limits.T.tocsr()
        self._costates = splu(dynamics[:, self._states.ravel()].T.tocsc())
        self._driven = dynamics[:, self._inputs].T.tocsr()
        self._driven_sizes = abs(self._driven)
        self._weight = float(np.abs(H.diagonal()[self._inputs]).max(initial=0.0))
        radius = float(np.abs(np.linalg.eigvals(problem.A)).max())
        self._remembers = problem.horizon * np.log(max(radius, 1.0)) < np.log(REMEMBERED)

    def doubt(self, v: Array, y: Array, q: Array, high: Array, states: Array, own_cost: float | None = None) -> float:
        """The largest of them for variables v and multipliers y, with `states` (N + 1, nx) in place of those in v.

        `own_cost` is the cost of the plan in the units of H, where it is to be compared with.
        """
        v = v.copy()
        v[self._states[:, : states.shape[1]]] = states / self._size
        y = y[self._equal :]
        Hv = self._H @ v
        pushed = self._limits_T @ y
        unit = float(np.abs(v).max(initial=0.0))
        left, largest = self._gradient(Hv, q, pushed, unit) if self._remembers else (np.zeros(1), 0.0)
        gradient = float(np.linalg.norm(left)) / largest if largest > 0 else 0.0
        least = INTERIOR_POINT / KKT_REPORTED * self._weight * unit**2  # that the solver knows of
        cost = max(abs(float(v @ Hv)), abs(float(q @ v)), least)
        gap = abs(float(y @ (high[self._equal :] - self._limits @ v)))
        doubt = max(gradient, gap / cost if cost > 0 else 0.0)
        if own_cost is None or max(own_cost, least) <= 0:
            return doubt
        return max(doubt, (float(np.abs(left).sum()) * unit + gap) / max(own_cost, least))

    def _gradient(self, Hv: Array, q: Array, pushed: Array, unit: float) -> tuple[Array, float]:
        """Gradient by the inputs, with costates that leave none by the states, and the size of its largest part."""
        force = Hv + q + pushed
        costates = self._costates.solve(force[self._states.ravel()])
        left = force[self._inputs] - self._driven @ costates
        parts = [Hv[self._inputs], q[self._inputs], pushed[self._inputs], self._driven_sizes @ np.abs(costates)]
        return left, max(NEGLIGIBLE * self._weight * unit, *(float(np.linalg.norm(part)) for part in parts))


def _columns(staging: Staging) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Where inputs, in order, and states (N + 1, n) stand among the variables; the slacks are neither."""
    widths = np.array([len(stage.gx) + len(stage.gv) for stage in staging.stages])
    states = (np.cumsum(widths) - widths)[:, None] + np.arange(staging.n)
    inputs = [first[-1] + 1 + np.arange(stage.nu) for first, stage in zip(states, staging.stages)]
    return np.concatenate(inputs), states
