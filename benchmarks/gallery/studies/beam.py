"""Where on a beam to put its actuator: J has two valleys, one at either side of the middle; the real beam hardens."""

import casadi as ca
import numpy as np

from ccdtools import DesignSpace, Gaussian, Plant, QuadraticObjective, RealPlant, Study
from invariant_sets import Polytope

FREQUENCIES = (0.8, 1.6)  # Hz, of the two modes
DAMPING_RATIO = 0.02
LOAD = 0.3  # place of the disturbance, as a part of the length
HARDENING = 8.0  # of the first mode [1/(m² s²)]


def beam(*, hardening: float = 0.0) -> Plant:
    """x = [modal amplitudes, their rates], u = force per modal mass at `place`, w = such a force at the load."""
    x, u, w, p = ca.SX.sym("x", 4), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    accelerations = []
    for mode, frequency in enumerate(FREQUENCIES):
        rate = 2 * np.pi * frequency
        shape = (mode + 1) * np.pi
        push = ca.sin(shape * p) * u + np.sin(shape * LOAD) * w
        accelerations.append(push - rate**2 * x[mode] - 2 * DAMPING_RATIO * rate * x[2 + mode])
    accelerations[0] -= hardening * x[0] ** 3
    design = DesignSpace(["place"], lower=[0.05], upper=[0.95])
    names = ["mode 1 [m]", "mode 2 [m]", "rate 1 [m/s]", "rate 2 [m/s]"]
    return Plant(
        x, u, w, p, ca.vertcat(x[2], x[3], *accelerations), design, dt=0.05, state_names=names,
        input_names=["force [N/kg]"],
    )  # fmt: skip


noise = Gaussian(std=[5.0])
start = [0.2, 0.3, 0.0, 0.0]

study = Study(
    name="beam",
    title="Actuator on a beam, two valleys",
    plant=beam(),
    X=Polytope.from_bounds([-0.8, -0.8, -5.0, -8.0], [0.8, 0.8, 5.0, 8.0]),
    U=Polytope.from_bounds([-60.0], [60.0]),
    objective=QuadraticObjective(Q=np.diag([100.0, 100.0, 1.0, 1.0]), R=[[0.02]]),
    disturbance=noise,
    x0=start,
    p0=[0.8],
    real=RealPlant(beam(hardening=HARDENING), noise, x0=start, runs=200, steps=100),
    samples=800,
)
