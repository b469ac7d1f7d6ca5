"""Multiple shooting of a random statement in plain CasADi and Ipopt, from eleven places."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from random_statements import PLANTS, Statement


class Reference:
    """Plain multiple shooting in plain units, by Ipopt."""

    def __init__(self, one: Statement) -> None:
        self.one, nx = one, len(one.x)
        limit = np.asarray(PLANTS[one.plant][1])
        nu, N = len(limit), one.N
        X, U, e = ca.MX.sym("x", nx, N + 1), ca.MX.sym("u", nu, N), ca.MX.sym("e", N + 1)
        x, u, w, last, t = (ca.SX.sym(n, s) for n, s in (("x", nx), ("u", nu), ("w", 2), ("last", nu), ("t", 1)))
        step = ca.Function("step", [x, u, w], [one.plant(x, u, w[0])])
        stage = ca.Function("stage", [x, u, w, last], [one.stage(x, u, w, one.p, last)])
        cost, rows, low, high = 0, [], [], []

        def keep(value: Any, least: Any, most: Any) -> None:
            rows.append(value)
            low.append(np.broadcast_to(least, value.shape[0]))
            high.append(np.broadcast_to(most, value.shape[0]))

        path = ca.Function("path", [x, u, t], [ca.vertcat(ca.SX(0, 1), *one.limits(x, u, t))])
        of_u = np.zeros(path.numel_out(0), dtype=bool)
        of_u[path.jac_sparsity(0, 1).row()] = True
        for k in range(N):
            before = U[:, k - 1] if k else ca.DM.zeros(nu)
            cost += stage(X[:, k], U[:, k], one.w[k], before)
            keep(X[:, k + 1] - step(X[:, k], U[:, k], one.w[k]), 0, 0)
            if one.rate is not None:
                keep(U[:, k] - before, -one.rate, one.rate)
            chosen = np.flatnonzero(of_u | (k > 0)).tolist()
            if chosen:
                keep(path(X[:, k], U[:, k], k)[chosen], -np.inf, 0)
        if not of_u.all():
            keep(path(X[:, N], U[:, N - 1], N)[np.flatnonzero(~of_u).tolist()], -np.inf, 0)
        cost += one.last(X[:, N], one.w[N], one.p)
        if one.soft is not None:
            for k in range(1, N + 1):
                keep(one.soft_value(X[:, k]) - e[k], -np.inf, 0)
            cost += one.soft[1] * ca.sum1(e) + one.soft[2] * ca.sumsqr(e)
        if one.ball:
            keep(ca.sumsqr(X[:, N]) - one.ball**2, -np.inf, 0)
        if one.end is not None:
            keep(X[0, N] - one.end, 0, 0)
        nlp = {"x": ca.vertcat(ca.vec(X), ca.vec(U), e), "f": cost, "g": ca.vertcat(*rows)}
        self.solver = ca.nlpsol("reference", "ipopt", nlp, {
            "ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "ipopt.tol": 1e-9, "ipopt.max_iter": 1000,
            "expand": True, "show_eval_warnings": False, "ipopt.bound_relax_factor": 0.0,
        })  # fmt: skip
        self.rows = np.concatenate(low), np.concatenate(high)
        bound = np.full(nx, np.inf) if one.bound is None else one.bound
        self.low = np.concatenate([one.x, np.tile(-bound, N), np.tile(-limit, N), np.zeros(N + 1)])
        self.high = np.concatenate([one.x, np.tile(bound, N), np.tile(limit, N), np.full(N + 1, np.inf)])
        self.g = ca.Function("g", [nlp["x"]], [nlp["f"], nlp["g"]])
        self.step, self.limit = step, limit

    def from_(self, states: np.ndarray, inputs: np.ndarray) -> tuple[float, np.ndarray]:
        """Cost and unknowns of an optimum, infinite where none was found."""
        guess = np.concatenate([states.ravel(), inputs.ravel(), np.zeros(self.one.N + 1)])
        found = self.solver(x0=guess, lbx=self.low, ubx=self.high, lbg=self.rows[0], ubg=self.rows[1])
        good = self.solver.stats()["success"] and self.solver.stats()["return_status"] == "Solve_Succeeded"
        return float(found["f"]) if good else np.inf, np.asarray(found["x"]).ravel()

    def starts(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """State held, and ten other places."""
        one, rng = self.one, np.random.default_rng(99)
        N, nu = one.N, len(self.limit)
        held = np.tile(one.x, (N + 1, 1))
        found = [(held, np.zeros((N, nu)))]
        way = np.linspace(1, 0, N + 1)[:, None]
        for side in (-1, 0, 1):
            bent = held * way
            bent[:, 0] -= side * np.sin(np.pi * way[:, 0]) * one.x[1]
            bent[:, 1] += side * np.sin(np.pi * way[:, 0]) * one.x[0]
            found.append((bent, np.zeros((N, nu))))
        for _ in range(7):
            inputs = np.repeat(rng.uniform(-1, 1, (1 + N // 5, nu)) * self.limit, 5, axis=0)[:N]
            states = [one.x]
            for k in range(N):
                states.append(np.asarray(self.step(states[-1], inputs[k], one.w[k])).ravel())
            found.append((np.array(states), inputs))
        return found

    def worth(self, states: np.ndarray, inputs: np.ndarray) -> tuple[float, float]:
        """Cost of a plan, and the most by which it passes anything."""
        one = self.one
        e = np.zeros(one.N + 1)
        if one.soft is not None:
            e[1:] = np.maximum(states[1:, 1] - one.soft[0], 0)
        v = np.concatenate([states.ravel(), inputs.ravel(), e])
        f, g = self.g(v)
        g = np.asarray(g).ravel()
        over = max(np.maximum(self.rows[0] - g, g - self.rows[1]).max(), np.maximum(self.low - v, v - self.high).max())
        return float(f), float(over)
