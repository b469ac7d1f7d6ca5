"""A pendulum swung up from below with a weak motor; its length is the design.

The real one is Gymnasium's Pendulum-v1, two of its steps a sample, by its equations: a test holds them against it.
"""

from typing import Any

import casadi as ca
import numpy as np

from ccdtools.co_design.custom_objective import CustomObjective
from ccdtools.disturbances.disturbance import Gaussian
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.plant import Plant
from ccdtools.studies.real_plant import RealPlant
from ccdtools.studies.study import Study
from invariant_sets import Polytope

START = np.array([2.6, 0.0])  # rad from upright, rad/s


def pendulum(*, real: bool = False, most: float = 2.0, fastest: float = 8.0, dt: float = 0.05) -> Plant:
    """Rod of 0.9 kg, or of 1 kg in Euler steps."""
    x, u, w, length = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("l")
    mass = 1.0 if real else 0.9

    def acceleration(angle: Any, torque: Any) -> Any:
        """Acceleration about one end [rad/s²]."""
        return 15 / length * ca.sin(angle) + 3 / (mass * length**2) * torque

    dynamics = ca.vertcat(x[1], acceleration(x[0], u + w))
    if real:
        angle, speed = ca.vertsplit(x)
        for _ in range(2):
            speed = cut_off(speed + dt * acceleration(angle, cut_off(u, most) + w), fastest)
            angle = angle + dt * speed
        dynamics = ca.vertcat(angle, speed)
    return Plant(
        x, u, w, length, dynamics, DesignSpace(["l"], [0.8], [1.25], ["m"]), dt=2 * dt, continuous=not real,
        state_names=["angle [rad]", "speed [rad/s]"], input_names=["torque [N·m]"],
    )  # fmt: skip


def cut_off(value: Any, bound: float) -> Any:
    """Value cut at ± a bound, as the environment does."""
    return ca.fmax(-bound, ca.fmin(bound, value))


def stage_cost(x: Any, u: Any, p: Any) -> Any:
    """Cost of Pendulum-v1, of the angle from upright within ± π."""
    return ca.atan2(ca.sin(x[0]), ca.cos(x[0])) ** 2 + 0.1 * x[1] ** 2 + 0.001 * u[0] ** 2


study = Study(
    name="swing_up",
    title="Swing-up",
    plant=pendulum(),
    X=Polytope.from_bounds([-12.0, -8.0], [12.0, 8.0]),
    U=Polytope.from_bounds([-2.0], [2.0]),
    objective=CustomObjective(stage_cost, Q=np.diag([1.0, 0.1]), R=[[0.001]], design_cost=lambda p: 50 / p[0] ** 2),
    disturbance=Gaussian(std=[0.02]),  # N·m
    x0=START,
    p0=[1.0],
    real=RealPlant(pendulum(real=True), Gaussian(std=[0.02]), x0=START, runs=100, steps=50),
    steps=50,
    limit_tolerance="off",
    accuracy=1e-3,
)  # fmt: skip
