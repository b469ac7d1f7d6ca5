"""What test_affine_and_holds.py claims, seen from inside."""

import casadi as ca
import numpy as np

from ccdtools import DesignSpace, LinearFeedback, Plant, discretise, simulate
from ccdtools.twin.residuals import residuals

BOX = DesignSpace(["k", "d"], [20.0, 0.1], [200.0, 2.0])


def hanging(continuous=True, dt=0.05):
    """A mass on a spring under gravity, its position counted from where the spring is slack."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    if not continuous:
        return Plant(
            x, u, w, p, ca.vertcat(x[0] + dt * x[1], x[1] - p[0] * dt * x[0] + u - 9.81 * dt + w), BOX, dt, False
        )
    return Plant(x, u, w, p, ca.vertcat(x[1], -9.81 - p[0] * x[0] - p[1] * x[1] + u + w), BOX, dt)


def test_errors_of_a_model_with_a_constant_term_are_counted_from_it():
    model = discretise(hanging())
    log = simulate(model, LinearFeedback([[1.0, 1.0]]), x0=[0.1, 0.0], steps=30, design=[50.0, 0.3])
    assert np.abs(residuals(model, log).e_next).max() < 1e-12
