"""What test_vehicle_on_wheels.py claims, seen from inside."""

import casadi as ca
import numpy as np
import pytest

from mpc.optimal_control import NonlinearMPC
from mpc.optimal_control.c_code import real_time_iteration

Q, R, P = np.diag([1.0, 1.0, 0.1]), np.diag([0.1, 0.1]), np.diag([10.0, 10.0, 1.0])
FASTEST = np.array([1.0, 2.0])
UNITS = [(np.ones(3), np.ones(2), 1.0), (np.array([1e3, 1e3, 57.3]), np.array([3.6, 57.3]), 1e4)]


def rolled(x, u):
    """Speed and rate of turn, held for 0.1 s; position and heading."""
    return ca.vertcat(x[0] + 0.1 * u[0] * ca.cos(x[2]), x[1] + 0.1 * u[0] * ca.sin(x[2]), x[2] + 0.1 * u[1])


def law(sx=UNITS[0][0], su=UNITS[0][1], cost=1.0, P=P, **changes):
    """The controller in these units."""
    return NonlinearMPC(
        lambda x, u: sx * rolled(x / sx, u / su), 3, 2, horizon=20, U=(-FASTEST * su, FASTEST * su),
        Q=cost * Q / sx / sx[:, None], R=cost * R / su / su[:, None],
        P=None if P is None else cost * P / sx / sx[:, None], **changes,
    )  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("iterations", [None, 1])
def test_it_parks(iterations):
    controller, x = law(iterations=iterations), np.array([-1.0, 0.5, 0.0])
    for _ in range(150):
        u = controller(x)
        assert (np.abs(u) <= FASTEST + 1e-9).all()
        x = np.asarray(rolled(x, u)).ravel()
    assert np.abs(x).max() < 0.1
    assert real_time_iteration(controller.linear, controller.model).name() == "iteration"
