"""Drives on ISO 8608 roads, for one, two or four wheels."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import get_args

import numpy as np

from ccdtools.arrays import Array
from ccdtools.vehicles.iso8608 import BAND, SPACING, RoadClass, as_band, as_spacing, generate_profile, road_roughness
from ccdtools.vehicles.roads import Driver, drives, generate_obstacles, generate_speed, road_disturbance
from ccdtools_ground.door import as_choice, as_flag, as_positive


@dataclass(frozen=True)
class ISORoad:
    """Disturbance ż₀ [m/s] or z₀ [m] under every wheel, on fresh ISO 8608 roads.

    `ISORoad("C", speed=20.0, dt=0.01).sample(runs, steps, rng)` is ż₀ (runs, steps, nw). Each value is the mean of
    the vertical velocity of the road over its step, as `road_disturbance` says; the tyre touches the road in a point.
    Run i is the same for any number of runs.

    Attributes
    ----------
    road_class : {"A", …, "H"}
        From very smooth to hardly passable; C is an average road.
    speed : float, or {"mild", "aggressive"}
        Constant [m/s], or that of a driver, see `generate_speed`.
    dt : float
        Sampling time [s].
    track : float, optional
        Distance between the left and the right wheels [m]; their coherence is that of an isotropic road.
    wheelbase : float, optional
        Distance between the front and the rear wheels [m]; the rear ones meet the same road later.
    obstacles : bool
        Adds the jumps, bumps, dents and ramps of `generate_road`, the same in both tracks.
    band : (2,) tuple
        Lowest and highest frequency of the road [1/m].
    spacing : float
        Distance between the samples of the road, which is linear between them [m].
    heights : bool
        Whether what is felt is z₀ [m], the mean of the heights at which a step begins and ends, instead of ż₀. Each
        wheel begins at a height of 0; a band that begins above 0 keeps the heights bounded.
    """

    road_class: RoadClass = "C"
    speed: float | Driver = 20.0
    dt: float = 0.05
    _: KW_ONLY
    track: float | None = None
    wheelbase: float | None = None
    obstacles: bool = False
    band: tuple[float, float] = BAND
    spacing: float = SPACING
    heights: bool = False

    def __post_init__(self) -> None:
        road_roughness(self.road_class)
        if isinstance(self.speed, str):
            as_choice("speed", self.speed, get_args(Driver))
        else:
            as_positive("speed", self.speed, unit="m/s")
        as_positive("dt", self.dt, unit="s")
        for name in ("track", "wheelbase"):
            if getattr(self, name) is not None:
                as_positive(name, getattr(self, name), unit="m")
        as_flag("obstacles", self.obstacles)
        as_flag("heights", self.heights)
        object.__setattr__(self, "band", as_band("band", self.band))
        as_spacing("spacing", self.spacing, self.band[1])

    @property
    def wheels(self) -> tuple[str, ...]:
        """Names of the channels, front before rear and left before right."""
        sides = ("",) if self.track is None else ("left", "right")
        axles = ("",) if self.wheelbase is None else ("front", "rear")
        return tuple(f"{axle} {side}".strip() or "wheel" for axle in axles for side in sides)

    @property
    def nw(self) -> int:
        """Number of channels: 1, 2 or 4."""
        return len(self.wheels)

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> Array:
        """Sequences (runs, steps, nw)."""
        return drives(self._drive, runs, steps, rng)

    def _drive(self, steps: int, rng: np.random.Generator) -> Array:
        """One drive on a fresh road, (steps, nw)."""
        duration = steps * self.dt
        if isinstance(self.speed, str):
            time, speed = generate_speed(duration, rng=rng, driver=self.speed, dt=self.dt)
        else:
            time, speed = np.array([0.0, duration]), np.full(2, float(self.speed))
        wheelbase = self.wheelbase or 0.0
        length = float(np.trapezoid(speed, time)) + wheelbase + 2 * self.spacing
        distance, elevation = generate_profile(
            length, self.road_class, rng=rng, track=self.track, band=self.band, spacing=self.spacing
        )
        if self.obstacles:
            elevation = elevation + generate_obstacles(distance, rng)
        starts = (0.0,) if self.wheelbase is None else (wheelbase, 0.0)
        felt = [
            road_disturbance(*_from(start, distance, track), time, speed, dt=self.dt, steps=steps)
            for start in starts
            for track in np.atleast_2d(elevation)
        ]
        speeds = np.stack(felt, axis=-1)
        return self.dt * (np.cumsum(speeds, axis=0) - 0.5 * speeds) if self.heights else speeds


def _from(start: float, distance: Array, elevation: Array) -> tuple[Array, Array]:
    """Road that begins at a distance between two samples."""
    if start == distance[0]:
        return distance, elevation
    ahead = distance > start
    height = np.interp(start, distance, elevation)
    return np.concatenate([[start], distance[ahead]]), np.concatenate([[height], elevation[ahead]])
