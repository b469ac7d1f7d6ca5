"""A motor that turns a load over a gear; the real load is heavier and has dry friction."""

import casadi as ca
import numpy as np

from ccdtools import DesignSpace, Gaussian, Plant, QuadraticObjective, RealPlant, Study
from invariant_sets import Polytope

MOTOR = 2e-5  # kg·m², inertia of the motor
LOAD = 4e-3  # kg·m², inertia of the load
TORQUE = 0.05  # N·m/A
FRICTION_LOAD, FRICTION_MOTOR = 1e-3, 2e-5  # N·m·s
HEAVIER = 0.5  # of the real load, relative to the model's
DRY_FRICTION = 0.02  # N·m, at the real load


def servo(*, real: bool = False) -> Plant:
    """x = [angle, speed] of the load, u = current, w = torque on the load, p = [gear ratio, flywheel]."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    speed = x[1]
    ratio, flywheel = ca.vertsplit(p)
    inertia = LOAD + flywheel + MOTOR * ratio**2
    torque = TORQUE * ratio * u + w - (FRICTION_LOAD + FRICTION_MOTOR * ratio**2) * speed
    if real:
        inertia += HEAVIER * LOAD
        torque -= DRY_FRICTION * ca.tanh(speed / 0.1)
    design = DesignSpace(["n", "J_f"], lower=[4.0, 0.0], upper=[40.0, 1e-2], units=["-", "kg·m²"])
    names = ["angle [rad]", "speed [rad/s]"]
    return Plant(
        x, u, w, p, ca.vertcat(speed, torque / inertia), design, dt=0.02, state_names=names, input_names=["current [A]"]
    )


noise = Gaussian(std=[0.3])

study = Study(
    name="servo",
    title="Geared servo",
    plant=servo(),
    X=Polytope.from_bounds([-2.0, -30.0], [2.0, 30.0]),
    U=Polytope.from_bounds([-12.0], [12.0]),
    objective=QuadraticObjective(Q=np.diag([20.0, 0.02]), R=[[0.05]]),
    disturbance=noise,
    x0=[1.0, 0.0],
    p0=[30.0, 4e-3],
    real=RealPlant(servo(real=True), noise, x0=[1.0, 0.0], runs=200, steps=100),
    samples=600,
)
