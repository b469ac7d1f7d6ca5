"""A quarter car whose spring, damper and tyre are the design; its real spring hardens, its damper is asymmetric."""

import casadi as ca
import numpy as np

from ccdtools import DesignSpace, Gaussian, Plant, QuadraticObjective, RealPlant, Study
from invariant_sets import Polytope

SPRUNG = 300.0  # kg
UNSPRUNG = 40.0  # kg
HARDENING = 40.0  # of the spring [1/m²]
REBOUND, BUMP = 1.3, 0.7  # of the damper, either side of its mean


def quarter_car(*, real: bool = False) -> Plant:
    """x = [tyre deflection, unsprung velocity, suspension deflection, sprung velocity]; u [N]; w = ż₀ [m/s]."""
    x, u, w, p = ca.SX.sym("x", 4), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 3)
    tyre, unsprung, deflection, sprung = ca.vertsplit(x)
    spring, damper, stiffness = ca.vertsplit(p)
    rate = sprung - unsprung
    force = spring * deflection + damper * rate
    if real:
        force = spring * (deflection + HARDENING * deflection**3)
        force += damper * ca.if_else(rate > 0, REBOUND, BUMP) * rate
    dynamics = ca.vertcat(unsprung - w, (force - u - stiffness * tyre) / UNSPRUNG, rate, (u - force) / SPRUNG)
    design = DesignSpace(
        ["k_s", "c_s", "k_t"], lower=[8e3, 400.0, 1.2e5], upper=[4e4, 4000.0, 3e5], units=["N/m", "N·s/m", "N/m"]
    )
    names = ["z_us − z₀ [m]", "ż_us [m/s]", "z_s − z_us [m]", "ż_s [m/s]"]
    return Plant(x, u, w, p, dynamics, design, dt=0.02, state_names=names, input_names=["u [N]"])


study = Study(
    name="quarter_car",
    title="Quarter car, three parameters",
    plant=quarter_car(),
    X=Polytope.from_bounds([-0.06, -3.0, -0.12, -1.5], [0.06, 3.0, 0.12, 1.5]),
    U=Polytope.from_bounds([-4000.0], [4000.0]),
    objective=QuadraticObjective(Q=np.diag([4e4, 1.0, 2e3, 40.0]), R=[[1e-5]]),
    disturbance=Gaussian(std=[0.25]),
    x0=[0.0, 0.0, 0.05, 0.0],
    p0=[3e4, 800.0, 2.5e5],
    real=RealPlant(quarter_car(real=True), Gaussian(std=[0.25]), x0=[0.0, 0.0, 0.05, 0.0], runs=200, steps=100),
    samples=800,
)
