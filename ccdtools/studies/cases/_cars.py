"""Common parts of the half-car and full-car studies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.comparison.metrics import Metrics
from ccdtools.plants.library import Car
from ccdtools.plants.plant import Plant
from ccdtools.studies.real_plant import RealPlant
from ccdtools.studies.study import Study
from ccdtools.vehicles.iso8608 import RoadClass
from ccdtools.vehicles.iso_road import ISORoad
from ccdtools.vehicles.ride import Ride
from invariant_sets import Polytope

CAR = Car()
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
    return study_on_roads(name, title, nominal, real, X, np.diag(good**-2), _ride(nominal), track=track)


def study_on_roads(
    name: str, title: str, nominal: Plant, real: Plant, X: Polytope, Q: Array, metrics: Metrics, *,
    track: float | None = None, heights: bool = False,
) -> Study:  # fmt: skip
    """Study of a car on an average road, with limits X and cost Q."""
    start = np.zeros(nominal.nx)

    def road(road_class: RoadClass) -> ISORoad:
        """Road of an ISO 8608 class under all wheels."""
        wheelbase = CAR.front + CAR.rear
        return ISORoad(road_class, speed=SPEED, dt=nominal.dt, track=track, wheelbase=wheelbase, heights=heights)

    return Study(
        name=name,
        title=title,
        plant=nominal,
        X=X,
        U=Polytope.from_bounds(np.full(nominal.nu, -FORCE), np.full(nominal.nu, FORCE)),
        objective=QuadraticObjective(Q=Q, R=np.eye(nominal.nu) * FORCE**-2),
        disturbance=road("C"),
        x0=start,
        p0=SPREAD,
        steps=300,
        real=RealPlant(
            real, road("C"), x0=start, runs=1, steps=12000,
            held_out={"average road (C)": road("C"), "poor road (D)": road("D")},
        ),
        metrics=metrics,
    )  # fmt: skip


def _ride(plant: Plant) -> Ride:
    """Ride of a car."""
    names = plant.state_names
    tyres, travels = ([i for i, name in enumerate(names) if kind in name] for kind in ("tyre", "travel"))
    front, rear = CAR.loads
    loads = [front if "front" in names[i] else rear for i in tyres]
    body = next(i for i, name in enumerate(names) if "heave rate" in name)
    return Ride(body, travels, tyres, CAR.tyre, loads, WHEEL["travel"])


def by_kind(names: Sequence[str], values: dict[str, float]) -> Array:
    """Value of each quantity, by the words in its name."""
    return np.array([next(value for kind, value in values.items() if kind in name) for name in names])
