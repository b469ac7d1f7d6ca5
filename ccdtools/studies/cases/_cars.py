"""Common parts of the studies of cars on roads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.comparison.metrics import Metrics
from ccdtools.plants.library import Car, QuarterCar, quarter_car
from ccdtools.plants.library.elements import GRAVITY
from ccdtools.plants.plant import Plant
from ccdtools.studies.real_plant import RealPlant
from ccdtools.studies.study import Study
from ccdtools.vehicles.iso8608 import RoadClass
from ccdtools.vehicles.iso_road import ISORoad
from ccdtools.vehicles.ride import Ride
from invariant_sets import Polytope

CAR = Car()
WHEELBASE = CAR.front + CAR.rear
SPEED = 20.0  # m/s
FORCE = 1000.0  # N, of each strut; below the 2500 N at which the real actuator ends
WHEEL = {"tyre": 0.04, "travel": 0.1, "wheel speed": 2.5}  # limits: m, m (to the stops), m/s
BODY = {"heave rate": 1.0, "pitch rate": 1.0, "roll rate": 1.0}  # limits: m/s, rad/s, rad/s
PLACE = {"place": 0.25}  # limit: m, rad; where the car is costs nothing
GOOD = {"tyre": 0.01, "travel": 0.05, "wheel speed": 1.0, "heave rate": 0.2, "pitch rate": 0.2, "roll rate": 0.2,
        "place": np.inf}  # fmt: skip
SPREAD = [28000.0, 2500.0, 21000.0, 2000.0]  # This is the spread of `Car`'s source.


def car_study(name: str, title: str, nominal: Plant, real: Plant, *, track: float | None = None) -> Study:
    """Study of a car on an average road, from rest."""
    limits, good = (by_kind(nominal.state_names, values) for values in (WHEEL | BODY, GOOD))
    X = Polytope.from_bounds(-limits, limits)
    names = nominal.state_names
    tyres, travels = ([i for i, name in enumerate(names) if kind in name] for kind in ("tyre", "travel"))
    front, rear = CAR.loads
    loads = [front if "front" in names[i] else rear for i in tyres]
    body = next(i for i, name in enumerate(names) if "heave rate" in name)
    ride = Ride(body, travels, tyres, CAR.tyre, loads, WHEEL["travel"])
    return study_on_roads(
        name, title, nominal, real, X, np.diag(good**-2), ride, p0=SPREAD, wheelbase=WHEELBASE, track=track
    )


def quarter_car_study(name: str, title: str, *, nonlinear: bool = False, actuator_lag: bool = False) -> Study:
    """Study of a quarter car on an average road, from rest."""
    nominal = quarter_car(nonlinear=nonlinear, actuator_lag=actuator_lag)
    kinds = ("tyre", "wheel speed", "travel", "heave rate")
    limits, good = (np.array([values[kind] for kind in kinds]) for values in (WHEEL | BODY, GOOD))
    weights = good**-2
    if actuator_lag:
        limits = np.append(limits, 2500.0)  # N, of the state that follows the demanded force with a lag
        weights = np.append(weights, 0.0)
    return study_on_roads(
        name, title, nominal, quarter_car(actuator_lag=actuator_lag, real=True), Polytope.from_bounds(-limits, limits),
        np.diag(weights), quarter_car_ride(stop=WHEEL["travel"], forces=[4] if actuator_lag else None),
        p0=[27692.0, 1906.5], one_wheel=True,  # where the study of the suspension starts, too
    )  # fmt: skip


def quarter_car_ride(*, stop: float, forces: list[int] | None = None) -> Ride:
    """Ride of a quarter car with stops at a travel [m]."""
    car = QuarterCar()
    load = GRAVITY * (car.sprung + car.unsprung)
    return Ride(body=3, travels=[2], tyres=[0], stiffness=car.tyre, loads=[load], stop=stop, forces=forces)


def study_on_roads(
    name: str, title: str, nominal: Plant, real: Plant, X: Polytope, Q: Array, metrics: Metrics, *,
    p0: Sequence[float], one_wheel: bool = False, **road: Any,
) -> Study:  # fmt: skip
    """Study of a car on an average road, with limits X and cost Q; `road` as for `ISORoad`."""
    start = np.zeros(nominal.nx)

    def of_class(road_class: RoadClass) -> ISORoad:
        """Road of an ISO 8608 class under all wheels."""
        return ISORoad(road_class, speed=SPEED, dt=nominal.dt, **road)

    return Study(
        name=name,
        title=title,
        plant=nominal,
        X=X,
        U=Polytope.from_bounds(np.full(nominal.nu, -FORCE), np.full(nominal.nu, FORCE)),
        objective=QuadraticObjective(Q=Q, R=np.eye(nominal.nu) * FORCE**-2),  # Bryson's rule
        disturbance=of_class("C"),
        x0=start,
        p0=p0,
        steps=300,
        real=RealPlant(
            real, of_class("C"), x0=start, runs=1, steps=12000, road=one_wheel,
            held_out={"average road (C)": of_class("C"), "poor road (D)": of_class("D")},
        ),
        metrics=metrics,
    )  # fmt: skip


def by_kind(names: Sequence[str], values: dict[str, float]) -> Array:
    """Value of each quantity, by the words in its name."""
    return np.array([next(value for kind, value in values.items() if kind in name) for name in names])
