"""A study with other dimensions throughout than those of the package."""

import casadi as ca
import numpy as np

from ccdtools import DesignSpace, Gaussian, Plant, QuadraticObjective
from ccdtools.studies import RealPlant, Study
from invariant_sets import Polytope


def two_masses() -> Study:
    """Four states, two inputs, two disturbances, three design parameters, one long real run."""
    x, u, w, p = ca.SX.sym("x", 4), ca.SX.sym("u", 2), ca.SX.sym("w", 2), ca.SX.sym("p", 3)
    spring = p[0] * (x[2] - x[0]) + p[1] * (x[3] - x[1])
    dynamics = ca.vertcat(x[1], spring - p[2] * x[1] + u[0] + w[0], x[3], -spring + u[1] + w[1])
    design = DesignSpace(["k", "c", "d"], [1.0, 0.1, 0.1], [3.0, 1.0, 1.0], ["N/m", "N·s/m", "N·s/m"])
    names = ["q1 [m]", "v1 [m/s]", "q2 [m]", "v2 [m/s]"]
    plant = Plant(x, u, w, p, dynamics, design, dt=0.2, state_names=names, input_names=["f1 [N]", "f2 [N]"])
    noise = Gaussian(std=[0.2, 0.2])
    return Study(
        name="two_masses", title="Two masses", plant=plant, X=Polytope.from_bounds([-2.0] * 4, [2.0] * 4),
        U=Polytope.from_bounds([-3.0] * 2, [3.0] * 2), objective=QuadraticObjective(Q=np.eye(4), R=0.1 * np.eye(2)),
        disturbance=noise, x0=[1.0, 0.0, -0.5, 0.0], p0=[1.0, 0.5, 0.5], steps=20,
        real=RealPlant(plant, noise, x0=np.zeros(4), runs=1, steps=500),
    )  # fmt: skip
