"""A platform on two struts, each with an actuator, one of which is really weaker and both of which harden."""

import casadi as ca
import numpy as np

from ccdtools import DesignSpace, Gaussian, Plant, QuadraticObjective, RealPlant, Study
from invariant_sets import Polytope

MASS = 20.0  # kg
INERTIA = 1.5  # kg·m²
DAMPING = 30.0  # N·s/m, of each strut
FRONT = 0.4  # m, of the front strut from the centre of mass
HARDENING = 20.0  # 1/m²
GAINS = (1.0, 0.6)  # parts of the forces asked for that the real actuators give


def platform(*, real: bool = False) -> Plant:
    """x = [heave, pitch, their rates], u = strut forces, w = [force, moment] on the platform, p = [b, k]."""
    x, u, w, p = ca.SX.sym("x", 4), ca.SX.sym("u", 2), ca.SX.sym("w", 2), ca.SX.sym("p", 2)
    heave, pitch, heave_rate, pitch_rate = ca.vertsplit(x)
    rear, stiffness = ca.vertsplit(p)
    forces = []
    for number, arm in enumerate((FRONT, -rear)):
        stretch = heave + arm * pitch
        spring = stiffness * stretch
        push = u[number]
        if real:
            spring = stiffness * (stretch + HARDENING * stretch**3)
            push = GAINS[number] * u[number]
        forces.append(push - spring - DAMPING * (heave_rate + arm * pitch_rate))
    dynamics = ca.vertcat(
        heave_rate,
        pitch_rate,
        (forces[0] + forces[1] + w[0]) / MASS,
        (FRONT * forces[0] - rear * forces[1] + w[1]) / INERTIA,
    )
    design = DesignSpace(["b", "k"], lower=[0.1, 100.0], upper=[1.0, 3000.0], units=["m", "N/m"])
    return Plant(
        x, u, w, p, dynamics, design, dt=0.05,
        state_names=["heave [m]", "pitch [rad]", "heave rate [m/s]", "pitch rate [rad/s]"],
        input_names=["front force [N]", "rear force [N]"],
    )  # fmt: skip


noise = Gaussian(std=[40.0, 8.0])
start = [0.1, -0.1, 0.0, 0.0]

study = Study(
    name="platform",
    title="Platform on two struts",
    plant=platform(),
    X=Polytope.from_bounds([-0.2, -0.2, -1.5, -2.0], [0.2, 0.2, 1.5, 2.0]),
    U=Polytope.from_bounds([-400.0, -400.0], [400.0, 400.0]),
    objective=QuadraticObjective(Q=np.diag([400.0, 200.0, 5.0, 1.0]), R=np.diag([2e-4, 2e-4])),
    disturbance=noise,
    x0=start,
    p0=[0.8, 1500.0],
    real=RealPlant(platform(real=True), noise, x0=start, runs=200, steps=100),
    samples=800,
)
