"""A semi-active car with bump stops, off the road.

Spring and damper are the design.
"""

from typing import Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.custom_objective import CustomObjective
from ccdtools.plants.library import QuarterCar, quarter_car
from ccdtools.studies.cases._cars import by_kind, quarter_car_ride, stop
from ccdtools.studies.real_plant import RealPlant
from ccdtools.studies.study import Study
from ccdtools.trajectory import Trajectory
from ccdtools.vehicles.corner import RealStrut
from ccdtools.vehicles.iso_road import ISORoad
from ccdtools.vehicles.semi_active import clipped_lqr, skyhook
from invariant_sets import Polytope

GOOD = {"acceleration": 1.0, "tyre": 0.005, "travel": 0.05}  # tolerable sizes [m/s², m, m], by Bryson's rule
STOPS = RealStrut(hardening=0.0, asymmetry=0.0, stop=3e5)
NOMINAL = quarter_car(semi_active=True, nonlinear=True, strut=STOPS)
REAL = quarter_car(semi_active=True, real=True, strut=RealStrut(stop=4e5, friction=60.0))
LIMITS, _ = by_kind(["tyre", "wheel speed", "travel", "heave rate"])


def stage_cost(x: Any, u: Any, p: Any) -> Any:
    """Squares of body acceleration, tyre deflection and travel, beside tolerable ones."""
    acceleration = NOMINAL.right_hand_side(x, u, 0, p)[3]
    return (acceleration / GOOD["acceleration"]) ** 2 + (x[0] / GOOD["tyre"]) ** 2 + (x[2] / GOOD["travel"]) ** 2


def weights(design: Array) -> tuple[Array, Array, Array]:
    """Weights of the same cost for a force in the damper's place."""
    inertia = QuarterCar().sprung * GOOD["acceleration"]
    spring = np.array([0.0, 0.0, -design[0] / inertia, 0.0])
    Q = np.outer(spring, spring) + np.diag([GOOD["tyre"] ** -2, 0.0, GOOD["travel"] ** -2, 0.0])
    return Q, np.array([[inertia**-2]]), spring[:, None] / inertia


def ride(run: Trajectory) -> dict[str, float]:
    """Ride metrics; the damper has no power."""
    found = quarter_car_ride(stop=stop())(run)
    return {name: value for name, value in found.items() if "power" not in name}


def road(road_class: str) -> ISORoad:
    """Road under one wheel at 15 m/s."""
    return ISORoad(road_class, speed=15.0, dt=NOMINAL.dt)  # type: ignore[arg-type]


study = Study(
    name="semi_active_damper",
    title="Semi-active damper",
    plant=NOMINAL,
    X=Polytope.from_bounds(-LIMITS, LIMITS),
    U=Polytope.from_bounds([-1.0], [1.0]),
    objective=CustomObjective(stage_cost, Q=weights(np.array([27692.0, 0.0]))[0], R=[[1.0]]),
    disturbance=road("E"),
    x0=np.zeros(4),
    p0=[27692.0, 3000.0],
    steps=200,
    real=RealPlant(
        REAL, road("E"), x0=np.zeros(4), runs=1, steps=12000, road=True,
        held_out={"very poor road (E)": road("E"), "poor road (D)": road("D")},
    ),
    limit_tolerance="off",
    metrics=ride,
    laws={
        "skyhook": skyhook, "clipped LQR": clipped_lqr(weights),
        "clipped LQR, tuned": clipped_lqr(weights, tuned=True),
    },
    expert="clipped LQR",
    accuracy=1e-3,
)  # fmt: skip
