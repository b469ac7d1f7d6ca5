"""The statement of a nonlinear MPC as one nonlinear program for Ipopt: states, inputs and slacks side by side."""

import casadi as ca
import numpy as np


def optimum(step, x, *, Q, R, P, horizon, U=None, X=None, rate_limit=None, u_prev=None, soft=None, units=None,
            x_ref=None, u_ref=None, w=None, terminal=None, guess=None):  # fmt: skip
    """Cost, inputs (N, nu) and states (N + 1, nx) of the optimum; `step` is a casadi.Function of x, u (and w).

    U and X are pairs of vectors, `units` those of the violations of X, upper then lower; `terminal` is (H, h).
    """
    N, nx, nu = horizon, len(Q), len(R)
    xs, us = ca.MX.sym("x", nx, N + 1), ca.MX.sym("u", nu, N)
    s = ca.MX.sym("s", N if soft is not None else 0)
    x_ref = np.zeros((N + 1, nx)) if x_ref is None else np.broadcast_to(x_ref, (N + 1, nx))
    u_ref = np.zeros((N, nu)) if u_ref is None else np.broadcast_to(u_ref, (N, nu))
    unknowns = ca.veccat(xs, us, s)
    g, low, high = [xs[:, 0] - x], [np.zeros(nx)], [np.zeros(nx)]
    cost = ca.bilin(P, xs[:, N] - x_ref[N])
    for k in range(N):
        after = step(xs[:, k], us[:, k]) if w is None else step(xs[:, k], us[:, k], w[k])
        cost += ca.bilin(Q, xs[:, k] - x_ref[k]) + ca.bilin(R, us[:, k] - u_ref[k])
        g, low, high = [*g, xs[:, k + 1] - after], [*low, np.zeros(nx)], [*high, np.zeros(nx)]
        if rate_limit is not None:
            g.append(us[:, k] - (us[:, k - 1] if k else ca.DM(u_prev)))
            low, high = [*low, -rate_limit * np.ones(nu)], [*high, rate_limit * np.ones(nu)]
        if soft is not None:
            upper, lower = (np.asarray(bound) for bound in units)
            for i in range(nx):
                if np.isfinite(X[1][i]):
                    g += [xs[i, k + 1] - upper[i] * s[k], -xs[i, k + 1] - lower[i] * s[k]]
                    low, high = [*low, [-np.inf] * 2], [*high, [X[1][i], -X[0][i]]]
            cost += soft[0] * s[k] + soft[1] * s[k] ** 2
    if terminal is not None:
        g, low, high = [*g, terminal[0] @ xs[:, N]], [*low, np.full(len(terminal[1]), -np.inf)], [*high, terminal[1]]
    free = np.full(nx, np.inf)
    bounds = [-free, free] if X is None or soft is not None else [np.asarray(side, dtype=float) for side in X]
    inputs = [-np.full(nu, np.inf), np.full(nu, np.inf)] if U is None else [np.asarray(side, dtype=float) for side in U]
    lbx = np.r_[-free, np.tile(bounds[0], N), np.tile(inputs[0], N), np.zeros(s.numel())]
    ubx = np.r_[free, np.tile(bounds[1], N), np.tile(inputs[1], N), np.full(s.numel(), np.inf)]
    options = {"ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes", "ipopt.tol": 1e-11, "expand": True}
    options |= {"ipopt.max_iter": 2000, "ipopt.bound_relax_factor": 0.0}
    solver = ca.nlpsol("optimum", "ipopt", {"x": unknowns, "f": cost, "g": ca.vertcat(*g)}, options)
    x0 = np.zeros(unknowns.numel())
    if guess is not None:
        x0[: nx * (N + 1) + nu * N] = np.r_[np.asarray(guess[0]).ravel(), np.asarray(guess[1]).ravel()]
    found = solver(x0=x0, lbx=lbx, ubx=ubx, lbg=np.concatenate(low), ubg=np.concatenate(high))
    assert solver.stats()["success"], solver.stats()["return_status"]
    z = np.asarray(found["x"]).ravel()
    states, rest = z[: nx * (N + 1)], z[nx * (N + 1) :]
    return float(found["f"]), rest[: N * nu].reshape(N, nu), states.reshape(N + 1, nx)
