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


def car_study(name: str, title: str, nominal: Plant, real: Plant, *, track: float | None = None) -> Study:
    """Study of a car on an average road, from rest."""
    names = nominal.state_names
    limits, good = by_kind(names)
    X = Polytope.from_bounds(-limits, limits)
    tyres, travels = ([i for i, name in enumerate(names) if kind in name] for kind in ("tyre", "travel"))
    front, rear = CAR.loads
    loads = [front if "front" in names[i] else rear for i in tyres]
    body = next(i for i, name in enumerate(names) if "heave rate" in name)
    ride = Ride(body, travels, tyres, CAR.tyre, loads, stop())
    return study_on_roads(name, title, nominal, real, X, np.diag(good**-2), ride, wheelbase=WHEELBASE, track=track)


def quarter_car_study(name: str, title: str, *, nonlinear: bool = False, actuator_lag: bool = False) -> Study:
    """Study of a quarter car on an average road, from rest."""
    nominal = quarter_car(nonlinear=nonlinear, actuator_lag=actuator_lag)
    limits, good = by_kind(["tyre", "wheel speed", "travel", "heave rate", *["active force"] * actuator_lag])
    return study_on_roads(
        name, title, nominal, quarter_car(actuator_lag=actuator_lag, real=True), Polytope.from_bounds(-limits, limits),
        np.diag(good**-2), quarter_car_ride(stop=stop(), forces=[4] if actuator_lag else None),
        p0=[27692.0, 1906.5], one_wheel=True,  # where the study of the suspension starts, too
    )  # fmt: skip


def quarter_car_ride(*, stop: float, forces: list[int] | None = None) -> Ride:
    """Ride of a quarter car with stops at a travel [m]."""
    car = QuarterCar()
    load = GRAVITY * (car.sprung + car.unsprung)
    return Ride(body=3, travels=[2], tyres=[0], stiffness=car.tyre, loads=[load], stop=stop, forces=forces)


def study_on_roads(
    name: str, title: str, nominal: Plant, real: Plant, X: Polytope, Q: Array, metrics: Metrics, *,
    p0: Sequence[float] = (28000.0, 2500.0, 21000.0, 2000.0), one_wheel: bool = False, **road: Any,
) -> Study:  # fmt: skip
    """Study of a car on an average road, with limits X and cost Q; `road` as for `ISORoad`.

    The first design is the spread of `Car`'s source by default.
    """
    start = np.zeros(nominal.nx)
    force = np.full(nominal.nu, 1000.0)  # N, of each strut; below the 2500 N at which the real actuator ends

    def of_class(road_class: RoadClass) -> ISORoad:
        return ISORoad(road_class, speed=20.0, dt=nominal.dt, **road)

    return Study(
        name=name,
        title=title,
        plant=nominal,
        X=X,
        U=Polytope.from_bounds(-force, force),
        objective=QuadraticObjective(Q=Q, R=np.diag(force**-2)),  # Bryson's rule
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


def by_kind(names: Sequence[str]) -> Array:
    """Limits and tolerable sizes (2, n) of quantities, by the words in their names."""
    kinds = {  # m, m (to the stops), m/s, rad/s; m and rad of the place of the car, N, both of which cost nothing
        "tyre": (0.04, 0.01), "travel": (0.1, 0.05), "wheel speed": (2.5, 1.0), "heave rate": (1.0, 0.2),
        "pitch rate": (1.0, 0.2), "roll rate": (1.0, 0.2), "place": (0.25, np.inf), "active force": (2500.0, np.inf),
    }  # fmt: skip
    return np.array([next(pair for kind, pair in kinds.items() if kind in name) for name in names]).T


def stop() -> float:
    """Travel [m] at which a suspension meets its stop: the limit of travels."""
    return float(by_kind(["travel"])[0, 0])
