"""Two unstable modes on one input that saturates; the real actuator is weaker and biased."""

import casadi as ca
import numpy as np

from ccdtools import DesignSpace, Gaussian, Plant, QuadraticObjective, RealPlant, Study
from invariant_sets import Polytope

RATES = (0.5, 0.2)  # 1/s
STRENGTH = 0.95  # of the real actuator
BIAS = 0.1  # of the real actuator, in units of u


def modes(*, real: bool = False) -> Plant:
    """x = amplitudes, u = actuator in units of its limit, w = a disturbance of each mode, p = drive of the second."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w", 2), ca.SX.sym("p")
    drive = STRENGTH * u + BIAS if real else u
    dynamics = ca.vertcat(RATES[0] * x[0] + drive + w[0], RATES[1] * x[1] + p * drive + w[1])
    design = DesignSpace(["b"], lower=[0.4], upper=[2.0])
    return Plant(x, u, w, p, dynamics, design, dt=0.1, state_names=["mode 1", "mode 2"], input_names=["u"])


noise = Gaussian(std=[0.3, 0.3])

study = Study(
    name="two_unstable_modes",
    title="Two unstable modes, one saturated input",
    plant=modes(),
    X=Polytope.from_bounds([-3.0, -3.0], [3.0, 3.0]),
    U=Polytope.from_bounds([-1.0], [1.0]),
    objective=QuadraticObjective(Q=np.eye(2), R=[[0.1]]),
    disturbance=noise,
    x0=[0.8, 0.8],
    p0=[1.4],
    real=RealPlant(modes(real=True), noise, x0=[0.8, 0.8], runs=200, steps=100),
    samples=600,
)
