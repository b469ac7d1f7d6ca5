"""Two tanks in a row, in units of laboratories: at a level that is held nothing is left to solve, nor is an offset."""

import casadi as ca
import numpy as np
import pytest

from mpc import Status
from mpc.optimal_control import NonlinearMPC, OffsetFreeNonlinearMPC

LEVEL = 0.1  # m
AREA, HOLE, GRAVITY = 0.0154, 5e-5, 9.81
PUMP = HOLE * np.sqrt(2 * GRAVITY * LEVEL)  # m³/s that hold it
UNITS = [(1.0, 1.0, 1.0), (100.0, 3600.0, 1e6), (1e3, 1.0, 1e-3)]  # of length in 1/m, of time in 1/s, of cost


def tanks(x, u, pump=1.0):
    """Levels and inflow in deviations from those at rest, in SI units, 20 s later."""
    h = x + LEVEL

    def rate(h):
        out = HOLE * ca.sqrt(2 * GRAVITY * h)
        return ca.vertcat((pump * (u + PUMP) - out[0]) / AREA, (out[0] - out[1]) / AREA)

    for _ in range(2):
        k1 = rate(h)
        k2 = rate(h + 5 * k1)
        k3 = rate(h + 5 * k2)
        h = h + 10 / 6 * (k1 + 2 * k2 + 2 * k3 + rate(h + 10 * k3))
    return h - LEVEL


def law(length, cost, flow, **changes):
    """The controller in these units."""
    return NonlinearMPC(
        lambda x, u: length * tanks(x / length, u / flow), 2, 1, horizon=20, U=(-PUMP * flow, PUMP * flow),
        Q=cost * np.array([10.0, 100.0]) / length**2, R=cost * 1e3 / (1e3 * flow) ** 2, **changes,
    )  # fmt: skip


@pytest.mark.parametrize(("length", "time", "cost"), UNITS)
@pytest.mark.parametrize("off", [0.0, 1e-14, 1e-11])
@pytest.mark.parametrize("level", [0.02, -0.06])
def test_at_a_level_that_is_held_plans_are_solved(level, off, length, time, cost):
    flow = length**3 / time
    controller = law(length, cost, flow)
    held = flow * (HOLE * np.sqrt(2 * GRAVITY * (LEVEL + level)) - PUMP)
    at = length * np.array([level + off, level - off])
    plan = controller.solve(at, x_ref=length * np.full(2, level), u_ref=[held])
    assert plan.status is Status.SOLVED
    assert plan.inputs == pytest.approx(held, rel=1e-6)


@pytest.mark.long
@pytest.mark.quick(2)
@pytest.mark.parametrize(("length", "time", "cost"), UNITS)
@pytest.mark.parametrize(("level", "reached"), [(0.05, 0.05), (-0.05, -0.05), (0.3, 0.224)], ids=["up", "down", "full"])
def test_a_weak_pump_leaves_no_offset_and_every_plan_is_solved(level, reached, length, time, cost):
    flow = length**3 / time
    loop = OffsetFreeNonlinearMPC(law(length, cost, flow), [[0, 1]]).loop()
    x, u, statuses = np.zeros(2), np.zeros(1), []
    for _ in range(150):
        u = loop(length * x, reference=[length * level], u_prev=u)
        statuses.append(loop._each[0].mpc.last_plans[0].status)  # noqa: SLF001
        x = np.asarray(tanks(x, u / flow, pump=0.9)).ravel()
    assert x[1] == pytest.approx(reached, abs=1e-6)  # (2 · 0.9)² of the level at rest is all that the pump holds
    assert set(statuses) == {Status.SOLVED}
