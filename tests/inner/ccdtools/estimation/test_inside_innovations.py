"""Innovations of a pendulum, by their filter alone."""

import casadi as ca
import numpy as np
import pytest

from ccdtools.estimation.innovations import Innovations


def told(W, to_w):
    """Innovations, variances and slopes of a pendulum that `to_w` of the disturbance pushes, by a part of gravity."""
    x, u, w, p = (ca.SX.sym(*sized) for sized in (("x", 2), ("u", 1), ("w", len(W)), ("p", 1)))
    force = u - p * ca.sin(x[0]) + ca.DM(to_w).T @ w
    step = ca.Function("step", [x, u, w, p], [ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * force)])
    output = ca.Function("output", [x, u, p], [x[0]])
    rng = np.random.default_rng(0)
    rows = np.stack([10.0 * rng.standard_normal((2, 30)), np.full((2, 30), 10.0)], axis=2)  # noise of 0.1
    start = np.array([1.0, 0.0]), np.diag([0.5, 0.0])
    inputs = rng.standard_normal((2, 30, 1))
    disturbance = np.zeros(len(W)), np.asarray(W, dtype=float)
    found = Innovations(step, output, disturbance, start, rows, inputs, True)
    return found.at(np.array([2.0, 0.3, -0.2]))


@pytest.mark.parametrize(
    ("W", "to_w"), [([[0.09, 0.0], [0.0, 0.0]], [1.0, 5.0]), ([[0.09, 0.18e6], [0.18e6, 0.36e12]], [-1.0, 1e-6])]
)
def test_an_axis_of_the_disturbance_without_variance_changes_nothing(W, to_w):
    for one, other in zip(told([[0.09]], [1.0]), told(W, to_w)):
        np.testing.assert_allclose(other, one, rtol=1e-6, atol=1e-9)
