"""A mass that is to travel along a rail, with a limit of its speed that binds; the mass is the design."""

import casadi as ca
import numpy as np

from ccdtools import DesignSpace, Gaussian, Plant, QuadraticObjective, Study
from invariant_sets import Polytope

DAMPING = 0.4  # N·s/m


def rail() -> Plant:
    """x = [position, velocity], u = force, w = disturbing force, p = mass."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    dynamics = ca.vertcat(x[1], (u + w - DAMPING * x[1]) / p)
    design = DesignSpace(["m"], lower=[0.3], upper=[3.0], units=["kg"])
    names = ["position [m]", "velocity [m/s]"]
    return Plant(x, u, w, p, dynamics, design, dt=0.1, state_names=names, input_names=["force [N]"])


study = Study(
    name="rail_mass",
    title="Mass on a rail with a speed limit",
    plant=rail(),
    X=Polytope.from_bounds([-2.0, -0.5], [2.0, 0.5]),
    U=Polytope.from_bounds([-2.0], [2.0]),
    objective=QuadraticObjective(Q=np.diag([1.0, 0.1]), R=[[0.5]]),
    disturbance=Gaussian(std=[0.7]),
    x0=[-1.5, 0.0],
    p0=[2.0],
    samples=600,
)
