"""Nonlinear MPC as a plain CasADi script solved by Ipopt to the last digits: what derivatives are compared with."""

import casadi as ca
import numpy as np

TIGHT = {
    "ipopt.tol": 1e-12, "ipopt.constr_viol_tol": 1e-13, "ipopt.compl_inf_tol": 1e-14, "ipopt.acceptable_iter": 0,
    "ipopt.bound_relax_factor": 0, "ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False,
}  # fmt: skip


class PlainProgram:
    """min Σ x'Qx + u'Ru + x_N'Px_N subject to x⁺ = step(x, u, p) and limits, from x0."""

    def __init__(self, step, sizes, weights, horizon, X=None, U=None, terminal=None):
        nx, nu, count = sizes
        x, u = ca.SX.sym("x", nx, horizon + 1), ca.SX.sym("u", nu, horizon)
        start, p, P = ca.SX.sym("start", nx), ca.SX.sym("p", count), ca.SX.sym("P", nx, nx)
        cost = ca.bilin(P, x[:, horizon], x[:, horizon])
        gaps = [x[:, 0] - start]
        for k in range(horizon):
            cost += ca.bilin(ca.DM(weights[0]), x[:, k]) + ca.bilin(ca.DM(weights[1]), u[:, k])
            gaps.append(x[:, k + 1] - step(x[:, k], u[:, k], p))
        low, high = (np.full(nx * (horizon + 1) + nu * horizon, sign * np.inf) for sign in (-1, 1))
        states = [side[: nx * (horizon + 1)].reshape(-1, nx) for side in (low, high)]
        inputs = [side[nx * (horizon + 1) :].reshape(-1, nu) for side in (low, high)]
        for i in range(2):
            if X is not None:
                states[i][1:] = X[i]
            if U is not None:
                inputs[i][:] = U[i]
            if terminal is not None:
                states[i][-1] = terminal[i]
        statement = {"x": ca.veccat(x, u), "f": cost, "g": ca.vertcat(*gaps), "p": ca.veccat(start, p, P)}
        self._solver = ca.nlpsol("plain", "ipopt", statement, TIGHT)
        self._bounds = low, high
        self._cut = nx * (horizon + 1)

    def __call__(self, x, p, P, plan):
        """Cost, then the inputs, from a guess near a plan."""
        guess = np.r_[plan.states.ravel(), plan.inputs.ravel()]
        found = self._solver(x0=guess, p=np.r_[x, p, P.ravel()], lbx=self._bounds[0], ubx=self._bounds[1], lbg=0, ubg=0)
        assert self._solver.stats()["return_status"] == "Solve_Succeeded"
        return np.r_[float(found["f"]), np.asarray(found["x"]).ravel()[self._cut :]]
