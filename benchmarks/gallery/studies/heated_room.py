"""A room and its wall, heated from within; the real heater is weaker, and warm air is lost by convection."""

import casadi as ca
import numpy as np

from ccdtools import DesignSpace, Gaussian, Plant, QuadraticObjective, RealPlant, Study
from invariant_sets import Polytope

AREA = 60.0  # m², of the wall
CONDUCTIVITY = 0.5  # W/(m·K)
VOLUMETRIC = 1.2e6  # J/(m³·K), heat capacity of the wall
AIR = 6e5  # J/K, of the air and what stands in the room
FILM = 3.0  # W/(m²·K), between air and wall
HEATER = 0.7  # part of the heat asked for that the real heater gives
CONVECTION = 1.5e-5  # 1/(K·s), of the real room


def room(*, real: bool = False) -> Plant:
    """x = deviations of air and wall [K], u = heat [kW], w = [gains in the room [kW], outside [K]], p = thickness."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w", 2), ca.SX.sym("p")
    air, wall = ca.vertsplit(x)
    half = 2 * CONDUCTIVITY * AREA / p
    inside = 1 / (1 / (FILM * AREA) + 1 / half)
    heat = (HEATER if real else 1.0) * u
    into_air = (1e3 * (heat + w[0]) + inside * (wall - air)) / AIR
    if real:
        into_air -= CONVECTION * ca.fabs(air) * air
    into_wall = (inside * (air - wall) + half * (w[1] - wall)) / (VOLUMETRIC * AREA * p)
    design = DesignSpace(["d"], lower=[0.05], upper=[0.6], units=["m"])
    names = ["air [K]", "wall [K]"]
    return Plant(
        x, u, w, p, ca.vertcat(into_air, into_wall), design, dt=900.0, state_names=names, input_names=["heat [kW]"]
    )


noise = Gaussian(std=[0.6, 6.0])
start = [-3.0, -4.0]

study = Study(
    name="heated_room",
    title="Heated room",
    plant=room(),
    X=Polytope.from_bounds([-8.0, -8.0], [8.0, 8.0]),
    U=Polytope.from_bounds([-10.0], [10.0]),
    objective=QuadraticObjective(Q=np.diag([1.0, 0.1]), R=[[0.05]]),
    disturbance=noise,
    x0=start,
    p0=[0.4],
    real=RealPlant(room(real=True), noise, x0=start, runs=200, steps=100),
    samples=500,
)
