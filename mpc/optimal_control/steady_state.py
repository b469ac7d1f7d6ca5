"""Nearest steady state of a nonlinear model, by Ipopt."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from mpc.checks import Array
from mpc.linear_mpc import LinearMPC
from mpc.optimal_control.discrete_model import DiscreteModel
from mpc.optimal_control.functions import symbols_of
from mpc.tolerances import STEADY_SOLVER, TARGET_COST
from mpc.tracking import sizes_of


class SteadyStates:
    """Steady states of a model in X and U.

    Parameters
    ----------
    law : LinearMPC
        Weights and sets.
    model : DiscreteModel
    """

    def __init__(self, law: LinearMPC, model: DiscreteModel) -> None:
        self._size = sizes_of(law)
        nx = law.nx
        _, _, w, p = symbols_of(model.step).values()
        kind = type(w)
        z, squares, slope = kind.sym("z", len(self._size)), kind.sym("squares", nx, nx), kind.sym("slope", nx)
        x, u = ca.vertsplit(z * self._size, [0, nx, len(self._size)])
        cost = ca.bilin(law.Q, x) + ca.bilin(law.R, u)
        if law.S is not None:
            cost += 2 * ca.dot(x, ca.DM(law.S) @ u)
        most = float(sum(np.diag(law.Q) * self._size[:nx] ** 2) + sum(np.diag(law.R) * self._size[nx:] ** 2)) or 1.0
        (HX, hX), (HU, hU) = law.state_rows, law.input_rows
        units = np.concatenate([law.row_units["state"], law.row_units["input"]])
        rows = ca.vertcat(ca.DM(HX) @ x, ca.DM(HU) @ u) / units
        drift = (model.step(x, u, w, p) - x) / law.state_extent
        self._most = np.concatenate([np.zeros(nx), np.concatenate([hX, hU]) / units])
        self._least = np.concatenate([np.zeros(nx), np.full(len(units), -np.inf)])
        program: dict[str, Any] = {
            "x": z, "p": ca.vertcat(ca.vec(squares), slope, w, p), "g": ca.vertcat(drift, rows),
            "f": ca.bilin(squares, x) - 2 * ca.dot(slope, x) + TARGET_COST * cost / most,
        }  # fmt: skip
        self._solver = ca.nlpsol("steady_state", "ipopt", program, {
            "ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "ipopt.tol": STEADY_SOLVER,
            "ipopt.max_iter": 200, "ipopt.bound_relax_factor": 0.0, "show_eval_warnings": False,
        })  # fmt: skip

    def nearest(self, C: Array, r: Array, w: Array, p: Array) -> Array | None:
        """State and input (nx + nu,) with Cx nearest to r, or None."""
        unit = max(float(np.linalg.norm(C * self._size[: C.shape[1]])), np.finfo(float).tiny)
        data = np.concatenate([(C.T @ C).ravel() / unit**2, C.T @ r / unit**2, w, p])
        found = self._solver(x0=0, p=data, lbg=self._least, ubg=self._most)
        if not self._solver.stats()["success"]:
            return None
        return np.asarray(found["x"]).ravel() * self._size
