"""The full car of 14 states, on ISO 8608 roads given by heights.

The states are where the car is, and follow the road: heights of a band that begins above 0 are bounded, and so is X.
What is judged are suspension travels and speeds, of which the first are differences of states.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ccdtools.plants.library import full_car
from ccdtools.studies.cases._cars import CAR, WHEELBASE, by_kind, stop, study_on_roads
from ccdtools.trajectory import Trajectory
from ccdtools.vehicles.car import WHEELS, heights_of_corners
from ccdtools.vehicles.ride import Ride
from invariant_sets import Polytope

plant = full_car(road="height")
places = np.eye(plant.nx)[:7]
speeds = np.eye(plant.nx)[7:]
travels = heights_of_corners(CAR).full() @ places[4:] - places[:4]
judged = np.vstack([places, travels, speeds])
names = [*["place"] * 7, *["travel"] * 4, *["wheel speed"] * 4, "heave rate", "pitch rate", "roll rate"]
limits, good = by_kind(names)
front, rear = CAR.loads
ride = Ride(8, range(4, 8), range(4), CAR.tyre, [front, front, rear, rear], stop())


def metrics(run: Trajectory) -> Mapping[str, float]:
    """Ride metrics from tyre deflections, travels and heave rate."""
    under = run.disturbances[..., : len(WHEELS)]
    road = np.concatenate([0.0 * under[:, :1], 0.5 * (under[:, 1:] + under[:, :-1]), under[:, -1:]], axis=1)
    parts = [run.states[..., :4] - road, run.states @ travels.T, run.states[..., 11:12]]
    return ride(replace(run, states=np.concatenate(parts, axis=-1)))


study = study_on_roads(
    "full_car_heights", "Full car on heights", plant, full_car(road="height", real=True),
    Polytope(np.vstack([judged, -judged]), np.tile(limits, 2)), judged.T @ np.diag(good**-2) @ judged, metrics,
    wheelbase=WHEELBASE, track=2 * CAR.half_track, heights=True,
)  # fmt: skip
