"""The active suspension of Tsai et al.: a quarter car whose spring and damper are the design.

Masses and tyre stiffness as in Allison, Guo and Han, "Co-design of an active suspension using simultaneous dynamic
optimization", Journal of Mechanical Design 136, 2014.
"""

import casadi as ca
import numpy as np

from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.disturbances.disturbance import Gaussian
from ccdtools.disturbances.roads import GeneratedRoad
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.plant import Plant
from ccdtools.studies.study import RealPlant, Study
from invariant_sets import Polytope

SPRUNG, UNSPRUNG = 325.0, 65.0  # kg
TYRE = 232.5e3  # N/m
HARDENING = 0.01  # of k_s [1/m²] and of c_s [s/m], in the real spring and damper


def quarter_car(*, nonlinear: bool = False) -> Plant:
    """x = [tyre deflection, unsprung velocity, suspension deflection, sprung velocity]; u [N]; w = ż₀ [m/s]."""
    x, u, w, p = ca.SX.sym("x", 4), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    tyre, unsprung, deflection, sprung = ca.vertsplit(x)
    spring, damper = ca.vertsplit(p)
    rate = sprung - unsprung
    force = spring * deflection + damper * rate
    if nonlinear:
        force += HARDENING * (spring * deflection**3 + damper * ca.fabs(rate) * rate)
    dynamics = ca.vertcat(
        unsprung - w,
        (-TYRE * tyre + force - u) / UNSPRUNG,
        rate,
        (-force + u) / SPRUNG,
    )
    design = DesignSpace(["k_s", "c_s"], lower=[1e4, 500.0], upper=[4e4, 3000.0], units=["N/m", "N·s/m"])
    names = ["z_us − z₀ [m]", "ż_us [m/s]", "z_s − z_us [m]", "ż_s [m/s]"]
    return Plant(x, u, w, p, dynamics, design, dt=0.05, state_names=names, input_names=["u [N]"])


study = Study(
    name="suspension",
    title="Active suspension",
    plant=quarter_car(),
    X=Polytope.from_bounds([-0.25, -2.5, -0.5, -2.5], [0.25, 2.5, 0.5, 2.5]),
    U=Polytope.from_bounds([-1000.0], [1000.0]),
    objective=QuadraticObjective(Q=np.diag([10.0, 1.0, 50.0, 5.0]), R=[[1e-6]]),
    disturbance=Gaussian(std=[0.3]),
    x0=[-0.1, -1.0, -0.1, -0.5],
    p0=[27692.0, 1906.5],
    real=RealPlant(
        quarter_car(nonlinear=True), GeneratedRoad("mild"), x0=np.zeros(4), runs=1, steps=15000,
        held_out={"mild driver": GeneratedRoad("mild"), "aggressive driver": GeneratedRoad("aggressive")},
    ),
    paper_networks=(16, 32, 32, 16),
    samples=1000,
    sampling_guard="ignore",  # the paper's dt: the wheel oscillates at 9.6 to 10.3 Hz, half the sampling rate is 10 Hz
)
