"""What test_sampling_guard.py claims, seen from inside."""

import casadi as ca
import numpy as np
import pytest

from ccdtools import DesignSpace, Plant
from ccdtools.plants.sampling_guard import fastest_mode


def oscillator(stiffness, design, dt, damping=0.0):
    """ẍ = −stiffness(p) x − damping ẋ + u."""
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p")
    return Plant(x, u, None, p, [x[1], -stiffness(p) * x[0] - damping * x[1] + u], design, dt=dt)


@pytest.mark.parametrize("peak", [0.11, 0.37, 0.5, 0.83])
def test_the_fastest_design_may_lie_inside_the_box(peak):
    plant = oscillator(lambda p: (20 * ca.exp(-200 * (p - peak) ** 2)) ** 2, DesignSpace(["p"], [0], [1]), dt=0.05)
    A = ca.Function("A", [plant.p], [ca.jacobian(plant.dynamics, plant.x)])
    frequency, design = fastest_mode(A, plant.design, plant.dt)
    assert frequency == pytest.approx(20 / (2 * np.pi), rel=1e-4)
    np.testing.assert_allclose(design, [peak], atol=1e-2)
