"""Common parts of the quarter-car studies."""

from __future__ import annotations

import numpy as np

from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.plants.library import QuarterCar, quarter_car
from ccdtools.plants.library.elements import GRAVITY
from ccdtools.studies.real_plant import RealPlant
from ccdtools.studies.study import Study
from ccdtools.vehicles.iso8608 import RoadClass
from ccdtools.vehicles.iso_road import ISORoad
from ccdtools.vehicles.ride import Ride
from invariant_sets import Polytope

SPEED = 20.0  # m/s
STATES = np.array([0.04, 2.5, 0.1, 1.0])  # limits: m, m/s, m (to the stops), m/s
GOOD = np.array([0.01, 1.0, 0.05, 0.2])  # what is tolerable on an average road, in the same units
FORCE = 1000.0  # N, for GOOD and as the limit; below the 2500 N at which the real actuator ends
LAGGING_FORCE = 2500.0  # N, of the state that follows it with a lag; it costs nothing beside the demanded one


def quarter_car_study(name: str, title: str, *, nonlinear: bool = False, actuator_lag: bool = False) -> Study:
    """Study of a quarter car on an average road, from rest."""
    plant = quarter_car(nonlinear=nonlinear, actuator_lag=actuator_lag)
    limits = np.append(STATES, LAGGING_FORCE) if actuator_lag else STATES
    weights = np.append(GOOD**-2, 0.0) if actuator_lag else GOOD**-2
    start = np.zeros(plant.nx)
    return Study(
        name=name,
        title=title,
        plant=plant,
        X=Polytope.from_bounds(-limits, limits),
        U=Polytope.from_bounds([-FORCE], [FORCE]),
        objective=QuadraticObjective(Q=np.diag(weights), R=[[FORCE**-2]]),  # Bryson's rule
        disturbance=_road("C"),
        x0=start,
        p0=[27692.0, 1906.5],  # where the study of the suspension starts, too
        steps=300,
        real=RealPlant(
            quarter_car(actuator_lag=actuator_lag, real=True), _road("C"), x0=start, runs=1, steps=12000,
            held_out={"average road (C)": _road("C"), "poor road (D)": _road("D")}, road=True,
        ),
        metrics=quarter_car_ride(stop=STATES[2], forces=[4] if actuator_lag else None),
    )  # fmt: skip


def quarter_car_ride(*, stop: float, forces: list[int] | None = None) -> Ride:
    """Ride of a quarter car with stops at a travel [m]."""
    car = QuarterCar()
    load = GRAVITY * (car.sprung + car.unsprung)
    return Ride(body=3, travels=[2], tyres=[0], stiffness=car.tyre, loads=[load], stop=stop, forces=forces)


def _road(road_class: RoadClass) -> ISORoad:
    """Road of an ISO 8608 class at the cars' sampling time."""
    return ISORoad(road_class, speed=SPEED, dt=0.01)
