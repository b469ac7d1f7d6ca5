"""Four masses in a row on a wall, pushed at the first; the real links harden."""

import casadi as ca
import numpy as np

from ccdtools import DesignSpace, Gaussian, Plant, QuadraticObjective, RealPlant, Study
from invariant_sets import Polytope

WALL = 80.0  # N/m, between the wall and the first mass
DAMPING = 0.8  # N·s/m, of every link
HARDENING = 1.5  # of the links between masses [1/m²]


def chain(*, hardening: float = 0.0) -> Plant:
    """x = [positions, velocities], u = force on the first mass, w = force on the last, p = [k, last mass]."""
    x, u, w, p = ca.SX.sym("x", 8), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    q, v = x[:4], x[4:]
    stiffness, last = ca.vertsplit(p)
    links = [WALL * q[0] + DAMPING * v[0]]
    for i in (1, 2, 3):
        stretch = q[i] - q[i - 1]
        links.append(stiffness * (stretch + hardening * stretch**3) + DAMPING * (v[i] - v[i - 1]))
    forces = [u - links[0] + links[1], links[2] - links[1], links[3] - links[2], (w - links[3]) / last]
    design = DesignSpace(["k", "m_4"], lower=[20.0, 0.3], upper=[200.0, 2.0], units=["N/m", "kg"])
    names = [f"position {i} [m]" for i in (1, 2, 3, 4)] + [f"velocity {i} [m/s]" for i in (1, 2, 3, 4)]
    return Plant(x, u, w, p, ca.vertcat(v, *forces), design, dt=0.05, state_names=names, input_names=["force [N]"])


noise = Gaussian(std=[2.0])
start = [0.0, 0.0, 0.0, 0.3, 0.0, 0.0, 0.0, 0.0]
limits = np.array([0.4, 0.4, 0.5, 0.6, 3.0, 3.0, 4.0, 10.0])

study = Study(
    name="chain_of_4",
    title="Chain of four masses",
    plant=chain(),
    X=Polytope.from_bounds(-limits, limits),
    U=Polytope.from_bounds([-60.0], [60.0]),
    objective=QuadraticObjective(Q=np.diag([1.0, 1.0, 1.0, 20.0, 0.1, 0.1, 0.1, 1.0]), R=[[0.01]]),
    disturbance=noise,
    x0=start,
    p0=[60.0, 1.5],
    real=RealPlant(chain(hardening=HARDENING), noise, x0=start, runs=200, steps=100),
    samples=1000,
)
