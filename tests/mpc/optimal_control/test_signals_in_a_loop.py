"""A loop in continuous time sees its own signal as `solve` does, and holds what is handed over."""

import casadi as ca
import numpy as np
import pytest

from mpc import Status
from mpc.optimal_control import MultipleShooting, NonlinearMPC, Phase, build, sampled, solve

N, DT = 12, 0.25
TIMES = DT * np.arange(N + 1)
TABLE = np.stack([1.5 * np.sin(1.3 * TIMES), 0.5 * np.cos(3 * TIMES)], axis=-1)
START = np.array([0.4, -0.2])


def swing(x, u, w):
    """A pendulum with wind."""
    return ca.vertcat(x[1], u - 0.4 * x[1] - ca.sin(x[0]) + w[1])


def apart(x, u, w):
    """Squares of an error and an effort whose price changes."""
    return (x[0] - w[0]) ** 2 + (0.05 + w[1] ** 2) * u**2


def phase(**stated):
    """Pendulum that follows a signal."""
    usual = {"dynamics": swing, "stage_cost": apart, "duration": N * DT, "signal": TABLE, "u_bounds": (-6, 6)}
    return Phase(states=2, inputs=1, **(usual | stated))


DRAWN = {
    "dynamics": lambda x, u, z: ca.vertcat(x[1], u - z), "algebraic": lambda x, z, w: 2 * z - x[0] - w[1],
    "algebraics": 1, "stage_cost": lambda x, u, z, w: (x[0] - w[0]) ** 2 + z**2 + 0.1 * u**2,
}  # fmt: skip


@pytest.mark.parametrize(
    "stated",
    [
        {},
        {"stage_cost": lambda x, u: ca.sumsqr(x) + 0.1 * u**2},
        {"path": lambda x, w: x[0] - 0.5 - 0.3 * w[1], "terminal_cost": lambda x, w: 3 * (x[0] - w[0]) ** 2},
        {"boundary": lambda x, w: x[0] - w[0]},
        DRAWN,
    ],
)
def test_the_plan_of_a_loop_is_that_of_the_phase_between_the_rows_of_a_signal(stated):
    found = NonlinearMPC(phase(**stated), horizon=N).solve(START)
    assert found.status is Status.SOLVED
    exact = solve(build(phase(start=START, **stated), MultipleShooting(4), N))
    assert found.cost == pytest.approx(exact.cost, rel=1e-6)


def test_plans_that_are_followed_beside_a_limit_of_rates_see_the_same_signal():
    law, x, u = NonlinearMPC(phase(), horizon=N, rate_limit=12.0), START, np.zeros(1)
    for _ in range(4):
        u = law(x, u_prev=u)
        plan = law.last_plans[0]
        assert plan.status is Status.SOLVED
        assert plan.cost == pytest.approx(solve(build(phase(start=x), MultipleShooting(4), N)).cost, rel=1e-6)
        x = plan.states[1]


def test_a_signal_that_is_handed_over_is_held_over_a_sample():
    move = sampled(lambda x, u, w: ca.vertcat(swing(x, u, w), apart(x, u, w)), DT)
    held = Phase(
        move, 3, 1, discrete=True, duration=N, signal=TABLE, u_bounds=(-6, 6), terminal_cost=lambda x: x[2]
    )  # fmt: skip
    cost = NonlinearMPC(held).solve([*START, 0]).cost
    law = NonlinearMPC(phase(), horizon=N)
    for w in (TABLE, TABLE[:-1]):
        assert law.solve(START, w=w).cost == pytest.approx(cost, rel=1e-6)
    assert abs(law.solve(START).cost - cost) > 0.02 * cost


def test_a_signal_that_is_a_function_is_met_to_second_order():
    stated = {"dynamics": lambda x, u: ca.vertcat(x[1], u - ca.sin(x[0])), "states": 2, "inputs": 1, "duration": 4.0}
    by_time = Phase(stage_cost=lambda x, u, t: (x[0] - ca.sin(1.3 * t)) ** 2 + 0.05 * u**2, **stated)
    by_signal = Phase(
        stage_cost=lambda x, u, w: (x[0] - w) ** 2 + 0.05 * u**2, signal=lambda t: np.sin(1.3 * t)[:, None], **stated
    )  # fmt: skip
    errors = []
    for n in (16, 32):
        exact, found = (NonlinearMPC(one, horizon=n).solve(START, t=0.5).cost for one in (by_time, by_signal))
        errors.append(abs(found - exact) / exact)
    assert errors[0] < 0.05
    assert errors[1] < 0.3 * errors[0]
