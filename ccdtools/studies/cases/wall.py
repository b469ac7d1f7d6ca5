"""A mass that flies towards a wall; the mass is the design.

The wall may serve as a brake. In the model the speed jumps there; the real wall gives way, as Hunt and Crossley have
it ("Coefficient of restitution interpreted as damping in vibroimpact", J. Appl. Mech. 42, 1975).
"""

import warnings

import casadi as ca
import numpy as np

from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.disturbances.disturbance import Gaussian, Uniform
from ccdtools.exceptions import JumpWarning
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.plant import Plant
from ccdtools.studies.real_plant import RealPlant
from ccdtools.studies.study import Study
from invariant_sets import Polytope

DESIGN = DesignSpace(["m"], [0.5], [2.0], ["kg"])
NAMES = ["position [m]", "speed [m/s]"]


def bouncing(*, wall: float = -0.5, restitution: float = 0.8, dt: float = 0.1) -> Plant:
    """Mass that is thrown back at once by a wall."""
    x, u, w, m = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("m")
    pull = u / m + w
    place, speed = x[0] + dt * x[1] + dt**2 / 2 * pull, x[1] + dt * pull
    hit = place < wall
    after = ca.vertcat(ca.if_else(hit, 2 * wall - place, place), ca.if_else(hit, -restitution * speed, speed))
    return Plant(x, u, w, m, after, DESIGN, dt=dt, continuous=False, state_names=NAMES)


def yielding(*, wall: float = -0.5, stiffness: float = 2000.0, loss: float = 0.15, dt: float = 0.1) -> Plant:
    """Mass that presses a spring with losses."""
    x, u, w, m = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("m")
    depth = ca.fmax(wall - x[0], 0)
    force = ca.fmax(stiffness * depth * (1 - loss * x[1]), 0)
    return Plant(x, u, w, m, ca.vertcat(x[1], (u + force) / m + w), DESIGN, dt=dt, substeps=40, state_names=NAMES)


with warnings.catch_warnings():
    warnings.simplefilter("ignore", JumpWarning)  # the jump is what this study is about
    study = Study(
        name="wall",
        title="Mass against a wall",
        plant=bouncing(),
        X=Polytope.from_bounds([-5.0, -8.0], [5.0, 8.0]),
        U=Polytope.from_bounds([-3.0], [3.0]),
        objective=QuadraticObjective(Q=np.diag([1.0, 0.1]), R=[[0.5]], design_cost=lambda p: 30 / p[0]),
        disturbance=Gaussian(std=[0.3]),  # m/s²
        starts=Uniform([1.5, -4.0], [3.0, -2.0]),
        x0=[2.25, -3.0],
        p0=[1.0],
        steps=60,
        real=RealPlant(yielding(), Gaussian(std=[0.3]), x0=[2.25, -3.0], runs=100, steps=60),
        sampling_guard="ignore",  # it asks at the end of X, 4.5 m within the real wall: runs come 0.1 m deep
    )  # fmt: skip
