"""Random nonlinear models in random units: plans keep their limits, follow the model, and Ipopt finds none better."""

import casadi as ca
import numpy as np
import pytest
from nonlinear_programs import optimum

from mpc import Status
from mpc.optimal_control import NonlinearMPC


def random_statement(seed):
    """Model in SI, sizes of its states and inputs, weights, limits, horizon and a state."""
    rng = np.random.default_rng(seed)
    nx, nu, N = int(rng.integers(1, 5)), int(rng.integers(1, 3)), int(rng.integers(3, 31))
    A, B, C, D = (rng.normal(size=shape) for shape in ((nx, nx), (nx, nu), (nx, nx), (nx, nu)))
    A *= rng.choice([0.8, 1.0, 1.15]) / np.abs(np.linalg.eigvals(A)).max()
    bend = rng.choice([0.05, 0.2, 0.4])

    def step(x, u):
        bent = 0.5 * (ca.sin(ca.DM(C) @ x) - ca.DM(C) @ x) + ca.tanh(x) * (ca.DM(D) @ u)
        return ca.DM(A) @ x + 0.5 * ca.DM(B) @ u + bend * bent

    sx, su = 10.0 ** rng.integers(-3, 4, nx), 10.0 ** rng.integers(-3, 4, nu)
    limits = {"U": np.full(nu, rng.uniform(0.3, 2))}
    if rng.random() < 0.6:
        limits["X"] = np.full(nx, rng.uniform(0.5, 2))
        if rng.random() < 0.5:
            limits["soft"] = (rng.uniform(0, 20), rng.uniform(1, 50))
    if rng.random() < 0.4:
        limits["rate_limit"] = rng.uniform(0.2, 1)
    weights = np.diag(rng.uniform(0.1, 2, nx)), np.diag(rng.uniform(0.05, 1, nu))
    return step, sx, su, weights, limits, N, rng.uniform(-0.5, 0.5, nx)


@pytest.mark.parametrize("seed", range(16))
def test_no_better_plan_is_found_from_there(seed):
    step, sx, su, (Q, R), limits, N, x = random_statement(seed)
    sizes = {"U": su, "X": sx}
    stated = {name: (-sizes[name] * limits[name], sizes[name] * limits[name]) for name in sizes if name in limits}
    if "rate_limit" in limits:
        stated["rate_limit"] = su * limits["rate_limit"]
    law = NonlinearMPC(
        lambda x, u: sx * step(x / sx, u / su), len(Q), len(R), Q=Q / sx / sx[:, None], R=R / su / su[:, None],
        horizon=N, soft=limits.get("soft"), **stated,
    )  # fmt: skip
    last = {"u_prev": np.zeros(len(R))} if "rate_limit" in limits else {}
    plan = law.solve(sx * x, **last)
    states, inputs = plan.states / sx, plan.inputs / su
    assert plan.status is Status.SOLVED
    assert (np.abs(inputs) <= limits["U"] * (1 + 1e-9)).all()
    assert (np.abs(np.diff(inputs, axis=0, prepend=0)) <= limits.get("rate_limit", np.inf) * (1 + 1e-9)).all()
    after = np.array([np.asarray(step(a, u)).ravel() for a, u in zip(states, inputs)])
    assert after == pytest.approx(states[1:], abs=1e-8)
    columns = ca.SX.sym("x", len(Q)), ca.SX.sym("u", len(R))
    model = ca.Function("model", columns, [step(*columns)])
    bounds = {name: (-value, value) if name in "UX" else value for name, value in limits.items()}
    units = (limits["X"],) * 2 if "X" in limits else None
    best, _, _ = optimum(model, x, Q=Q, R=R, P=law.linear.P * sx * sx[:, None], horizon=N, units=units,
                         guess=(states, inputs), **bounds, **last)  # fmt: skip
    assert plan.cost <= best * (1 + 1e-7) + 1e-9
