"""A mass on a spring and a damper, pushed by a force; the mass is the design. The real plant is the model."""

import casadi as ca
import numpy as np

from ccdtools import DesignSpace, Gaussian, Plant, QuadraticObjective, Study
from invariant_sets import Polytope

STIFFNESS = 2.0  # N/m
DAMPING = 0.3  # N·s/m


def oscillator() -> Plant:
    """x = [position, velocity], u = force, w = disturbing force: both forces enter divided by the design."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    position, velocity = ca.vertsplit(x)
    acceleration = (u + w - STIFFNESS * position - DAMPING * velocity) / p
    design = DesignSpace(["m"], lower=[0.3], upper=[3.0], units=["kg"])
    names = ["position [m]", "velocity [m/s]"]
    return Plant(
        x, u, w, p, ca.vertcat(velocity, acceleration), design, dt=0.1, state_names=names, input_names=["force [N]"]
    )


study = Study(
    name="mass_spring_damper",
    title="Mass on a spring, the mass as design",
    plant=oscillator(),
    X=Polytope.from_bounds([-3.0, -5.0], [3.0, 5.0]),
    U=Polytope.from_bounds([-20.0], [20.0]),
    objective=QuadraticObjective(Q=np.diag([10.0, 1.0]), R=[[0.1]]),
    disturbance=Gaussian(std=[1.8]),
    x0=[1.0, 0.0],
    p0=[2.0],
    samples=500,
)
