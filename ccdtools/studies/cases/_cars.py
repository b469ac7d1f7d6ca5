"""What the studies of the library's half car and full car share."""

from __future__ import annotations

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.comparison.ride import Ride
from ccdtools.disturbances.iso8608 import RoadClass
from ccdtools.disturbances.iso_road import ISORoad
from ccdtools.plants.library import Car
from ccdtools.plants.plant import Plant
from ccdtools.studies.real_plant import RealPlant
from ccdtools.studies.study import Study
from invariant_sets import Polytope

CAR = Car()
SPEED = 20.0  # m/s
FORCE = 1000.0  # N, of each strut; below the 2500 N at which the real actuator ends
WHEEL = {"tyre": 0.04, "travel": 0.1, "wheel speed": 2.5}  # limits: m, m (to the stops), m/s
BODY = {"heave rate": 1.0, "pitch rate": 1.0, "roll rate": 1.0}  # limits: m/s, rad/s, rad/s
GOOD = {"tyre": 0.01, "travel": 0.05, "wheel speed": 1.0, "heave rate": 0.2, "pitch rate": 0.2, "roll rate": 0.2}
SPREAD = [28000.0, 2500.0, 21000.0, 2000.0]  # of `Car`'s source


def car_study(name: str, title: str, nominal: Plant, real: Plant, *, track: float | None = None) -> Study:
    """A car that drives on an average road, from a rest; each state is limited and judged by what it is."""
    start = np.zeros(nominal.nx)
    limits = _by_kind(nominal, WHEEL | BODY)

    def road(road_class: RoadClass) -> ISORoad:
        """A road of a class of ISO 8608 under all wheels."""
        return ISORoad(road_class, speed=SPEED, dt=nominal.dt, track=track, wheelbase=CAR.front + CAR.rear)

    return Study(
        name=name,
        title=title,
        plant=nominal,
        X=Polytope.from_bounds(-limits, limits),
        U=Polytope.from_bounds(np.full(nominal.nu, -FORCE), np.full(nominal.nu, FORCE)),
        objective=QuadraticObjective(
            Q=np.diag(_by_kind(nominal, GOOD) ** -2), R=np.eye(nominal.nu) * FORCE**-2
        ),  # Bryson's rule: what is tolerable on an average road costs one
        disturbance=road("C"),
        x0=start,
        p0=SPREAD,
        steps=300,
        real=RealPlant(
            real, road("C"), x0=start, runs=1, steps=12000,
            held_out={"average road (C)": road("C"), "poor road (D)": road("D")},
        ),
        metrics=_ride(nominal),
    )  # fmt: skip


def _ride(plant: Plant) -> Ride:
    """How a car rides at its centre of mass, and on its wheels."""
    names = plant.state_names
    tyres, travels = ([i for i, name in enumerate(names) if kind in name] for kind in ("tyre", "travel"))
    front, rear = CAR.loads
    loads = [front if "front" in names[i] else rear for i in tyres]
    body = next(i for i, name in enumerate(names) if "heave rate" in name)
    return Ride(body, travels, tyres, CAR.tyre, loads, WHEEL["travel"])


def _by_kind(plant: Plant, values: dict[str, float]) -> Array:
    """The value of each state of a plant, by the words that its name holds."""
    return np.array([next(value for kind, value in values.items() if kind in name) for name in plant.state_names])
