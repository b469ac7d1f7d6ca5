"""The illustrative example of Tsai et al.: an unstable system whose input matrix is the design."""

import casadi as ca
import numpy as np

from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.disturbances.combinations import Sum
from ccdtools.disturbances.disturbance import Gaussian, Uniform
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.plant import Plant
from ccdtools.studies.study import RealPlant, Study
from invariant_sets import Polytope


def plants() -> tuple[Plant, Plant]:
    """The nominal model and the real plant (eqs. numerical_example and real_system_numerical_example)."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w", 2), ca.SX.sym("p")
    x1, x2 = x[0], x[1]
    nominal = ca.DM([[0.8, 0.5], [0.5, 0.6]]) @ x + ca.vertcat(0.5, p) * u + w
    bias = ca.DM([0.1, -0.2])
    drift = 0.1 * ca.vertcat(ca.sin(x1) * x1 + ca.cos(x2) * x2, ca.sin(x2) * x2 + ca.cos(x1) * x1)
    gain = ca.vertcat(0.5 * ca.sin(x1), 0.5 * p * ca.cos(x2)) * u
    design = DesignSpace(names=["p"], lower=[0.5], upper=[3.0])
    model = Plant(x, u, w, p, nominal, design, dt=1.0, continuous=False)
    return model, Plant(x, u, w, p, nominal + bias + drift + gain, design, dt=1.0, continuous=False)


model, real = plants()
noise = Gaussian(std=[0.1, 0.2])
start = np.array([-3.5, -2.0])

study = Study(
    name="illustrative",
    title="Illustrative example",
    plant=model,
    X=Polytope.from_bounds([-10.0, -5.0], [5.0, 2.0]),
    U=Polytope.from_bounds([-1.0], [1.0]),
    objective=QuadraticObjective(Q=np.eye(2), R=[[0.1]]),
    disturbance=noise,
    x0=start,
    p0=[1.0],
    real=RealPlant(real, Sum((noise, Uniform([-0.1, -0.1], [0.1, 0.1]))), x0=start, runs=200, steps=100),
    paper_networks=(32, 32, 16, 16),
    samples=600,
)
