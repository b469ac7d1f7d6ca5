"""Three masses in a row on a wall, pushed at the first; really, every mass is heavier than the model says."""

import casadi as ca
import numpy as np

from ccdtools import DesignSpace, Gaussian, Plant, QuadraticObjective, RealPlant, Study
from invariant_sets import Polytope

MASSES = (1.0, 1.0, 0.5)  # kg
WALL = 50.0  # N/m, between the wall and the first mass
HEAVIER = 1.3  # the real masses, relative to the model's


def chain(*, heavier: float = 1.0) -> Plant:
    """x = [positions, velocities], u = force on the first mass, w = force on the last, p = [k, c] of the links."""
    x, u, w, p = ca.SX.sym("x", 6), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    q, v = x[:3], x[3:]
    stiffness, damping = ca.vertsplit(p)
    links = [WALL * q[0] + damping * v[0]]
    links += [stiffness * (q[i] - q[i - 1]) + damping * (v[i] - v[i - 1]) for i in (1, 2)]
    forces = ca.vertcat(u - links[0] + links[1], links[2] - links[1], w - links[2])
    design = DesignSpace(["k", "c"], lower=[10.0, 0.1], upper=[150.0, 4.0], units=["N/m", "N·s/m"])
    names = [f"position {i} [m]" for i in (1, 2, 3)] + [f"velocity {i} [m/s]" for i in (1, 2, 3)]
    dynamics = ca.vertcat(v, forces / (heavier * ca.DM(MASSES)))
    return Plant(x, u, w, p, dynamics, design, dt=0.05, state_names=names, input_names=["force [N]"])


noise = Gaussian(std=[2.0])
start = [0.0, 0.0, 0.3, 0.0, 0.0, 0.0]
limits = np.array([0.3, 0.4, 0.6, 2.0, 2.0, 5.0])

study = Study(
    name="chain_of_3",
    title="Chain of three masses",
    plant=chain(),
    X=Polytope.from_bounds(-limits, limits),
    U=Polytope.from_bounds([-60.0], [60.0]),
    objective=QuadraticObjective(Q=np.diag([1.0, 1.0, 20.0, 0.1, 0.1, 1.0]), R=[[0.01]]),
    disturbance=noise,
    x0=start,
    p0=[30.0, 0.5],
    real=RealPlant(chain(heavier=HEAVIER), noise, x0=start, runs=200, steps=100),
    samples=800,
)
