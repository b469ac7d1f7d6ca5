"""An inverted pendulum in gusts, linearised; really a sine, with dry friction and a weaker motor."""

import casadi as ca
import numpy as np

from ccdtools import DesignSpace, Gaussian, Plant, QuadraticObjective, RealPlant, Study
from invariant_sets import Polytope

GRAVITY = 9.81  # m/s²
FRICTION = 0.1  # N·m·s
DRY_FRICTION = 0.15  # N·m
MOTOR = 0.85  # part of the torque asked for that the real motor gives


def pendulum(*, real: bool = False) -> Plant:
    """x = [angle from upright, angular velocity], u = torque, w = force of the wind on the bob, p = [l, m]."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    angle, velocity = ca.vertsplit(x)
    length, mass = ca.vertsplit(p)
    torque = u + length * w - FRICTION * velocity + mass * GRAVITY * length * angle
    if real:
        torque = MOTOR * u + length * w - FRICTION * velocity + mass * GRAVITY * length * ca.sin(angle)
        torque -= DRY_FRICTION * ca.tanh(velocity / 0.05)
    dynamics = ca.vertcat(velocity, torque / (mass * length**2))
    design = DesignSpace(["l", "m"], lower=[0.3, 0.3], upper=[1.0, 1.5], units=["m", "kg"])
    names = ["angle [rad]", "angular velocity [rad/s]"]
    return Plant(x, u, w, p, dynamics, design, dt=0.05, state_names=names, input_names=["torque [N·m]"])


study = Study(
    name="pendulum",
    title="Inverted pendulum, linearised",
    plant=pendulum(),
    X=Polytope.from_bounds([-1.0, -3.0], [1.0, 3.0]),
    U=Polytope.from_bounds([-12.0], [12.0]),
    objective=QuadraticObjective(Q=np.diag([50.0, 5.0]), R=[[0.4]]),
    disturbance=Gaussian(std=[1.0]),
    x0=[0.4, 0.0],
    p0=[0.7, 0.6],
    real=RealPlant(pendulum(real=True), Gaussian(std=[1.0]), x0=[0.4, 0.0], runs=200, steps=100),
    samples=600,
)
