"""Limits of state and input hold where the input acts: plans are the optima of plain Ipopt, stated so."""

import casadi as ca
import numpy as np
import pytest

from mpc import Status
from mpc.optimal_control import MultipleShooting, NonlinearMPC, Phase, build, solve

X0 = [1.0, 0.3]
LIMITS = {
    "power": (lambda x, u: u * x[1], (-np.inf, 0.5), lambda x, u: -x[1] + 0 * u),
    "law": (lambda x, u: u + 0.3 * x[0] + 0.3 * x[1], (0.0, 0.0), lambda x, u: ca.sumsqr(x) + 0 * u),
}


def step(x, u):
    """A mass, pushed; a tenth of a second later."""
    return ca.vertcat(x[0] + 0.1 * x[1] + 0.005 * u, x[1] + 0.1 * u)


def optimum(limit, sides, cost, N, until_the_end):
    """Least cost of N steps, by plain Ipopt."""
    x, u = ca.SX.sym("x", 2, N + 1), ca.SX.sym("u", 1, N)
    rows = [x[:, k + 1] - step(x[:, k], u[:, k]) for k in range(N)]
    kept = [limit(x[:, k], u[:, k]) for k in range(N)] + [limit(x[:, N], u[:, N - 1])] * until_the_end
    total = sum(cost(x[:, k], u[:, k]) for k in range(N)) - 3 * x[1, N]
    quiet = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-10}
    nlp = {"x": ca.vertcat(ca.vec(x), u.T), "f": total, "g": ca.vertcat(*rows, *kept)}
    solver, free = ca.nlpsol("plain", "ipopt", nlp, quiet), np.full(2 * N, np.inf)
    low, high = (np.concatenate([X0, side * free, np.full(N, side * 3.0)]) for side in (-1, 1))
    below, above = (np.concatenate([np.zeros(2 * N), np.full(len(kept), side)]) for side in sides)
    found = solver(x0=np.full(3 * N + 2, 0.1), lbx=low, ubx=high, lbg=below, ubg=above)
    assert solver.stats()["success"]
    return float(found["f"])


@pytest.mark.parametrize("N", [1, 5])
@pytest.mark.parametrize("name", LIMITS)
def test_no_input_acts_at_the_last_state_of_a_discrete_phase(name, N):
    path, sides, cost = LIMITS[name]
    stated = {"stage_cost": cost, "terminal_cost": lambda x: -3 * x[1], "path": path, "path_bounds": sides}
    stated |= {"discrete": True, "duration": N, "u_bounds": (-3, 3)}
    best = optimum(path, sides, cost, N, until_the_end=False)
    solution = solve(Phase(step, 2, 1, start=X0, **stated))
    law = NonlinearMPC(Phase(step, 2, 1, **stated))
    plan = law.solve(X0)
    assert solution.solved, solution.advice
    assert plan.status is Status.SOLVED
    assert [solution.cost, plan.cost] == pytest.approx([best, best], rel=1e-6)
    assert law(X0) == pytest.approx(plan.inputs[0], abs=1e-6)


@pytest.mark.parametrize("N", [1, 5])
def test_an_input_that_is_held_in_time_acts_until_the_end(N):
    path, sides, _ = LIMITS["power"]
    stated = {"terminal_cost": lambda x: -3 * x[1], "path": path, "path_bounds": sides, "duration": 0.1 * N}
    stated |= {"dynamics": lambda x, u: ca.vertcat(x[1], u), "states": 2, "inputs": 1, "u_bounds": (-3, 3)}
    best, passed = (optimum(path, sides, lambda x, u: 0, N, until_the_end=held) for held in (True, False))
    solution = solve(build(Phase(start=X0, **stated), MultipleShooting(4), N))
    plan = NonlinearMPC(Phase(**stated), horizon=N).solve(X0)
    assert plan.status is Status.SOLVED
    assert [solution.cost, plan.cost] == pytest.approx([best, best], rel=1e-6)
    assert passed < best - 1e-3


def test_a_limit_of_an_input_need_have_no_value_where_none_acts():
    """A brake as strong as the speed allows, to a stop."""
    stated = {"path": lambda x, u: u / x, "path_bounds": (-20.0, 0.0), "stage_cost": lambda u: u**2, "end": [0.0]}
    stated |= {"discrete": True, "duration": 3, "guess": ([0, 1], [[0.3], [0.0]], [[-1.0], [-1.0]])}
    solution = solve(Phase(lambda x, u: x + 0.1 * u, 1, 1, start=[0.3], **stated))
    plan = NonlinearMPC(Phase(lambda x, u: x + 0.1 * u, 1, 1, **stated)).solve([0.3])
    assert solution.solved, solution.advice
    assert plan.status is Status.SOLVED
    assert [solution.cost, plan.cost] == pytest.approx([3.0, 3.0], rel=1e-6)  # equal parts of what is to be lost
