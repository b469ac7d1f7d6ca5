"""Roads and drivers, recorded or generated."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import cumulative_trapezoid
from scipy.signal import lfilter

from ccdtools.arrays import Array
from ccdtools.disturbances.disturbance import check_draw
from ccdtools.exceptions import InputError
from ccdtools.vehicles.iso8608 import REFERENCE_FREQUENCY, road_roughness
from ccdtools_ground.door import as_choice, as_count, as_floats, as_generator, as_positive

Driver: TypeAlias = Literal["mild", "aggressive"]


def road_disturbance(
    distance: ArrayLike, elevation: ArrayLike, time: ArrayLike, speed: ArrayLike, *, dt: float, steps: int | None = None
) -> Array:
    """Vertical velocity ż₀ = dz₀/ds · v of the road under the wheel [m/s].

    Each value is the mean of dz₀/ds · v over its step, (z₀(s(t_k + dt)) − z₀(s(t_k))) / dt: what a model that
    holds its disturbance over a step must be fed. Their sum gives the elevation back exactly, and no edge
    shorter than v dt is missed; values read at t_k alone would do neither. Road and speed are linear between
    samples. The drive begins at `distance[0]` and `time[0]`.

    Parameters
    ----------
    distance, elevation : (S,) arrays
        Road [m]; the distance strictly increasing.
    time, speed : (M,) arrays
        Driver [s], strictly increasing, and [m/s], not negative.
    dt : float
        Time step [s].
    steps : int, optional
        Number of steps T; all that the speed covers if not given.

    Returns
    -------
    (T,) array
        ż₀ [m/s].

    Raises
    ------
    InputError
        If an input is not as described, or the speed or the road ends before the drive.
    """
    distance, elevation = _curve("distance", distance, "elevation", elevation)
    time, speed = _curve("time", time, "speed", speed)
    if (speed < 0).any():
        row = int(np.argmax(speed < 0))
        got = f"{speed[row]:g} m/s at index {row}"
        raise InputError("speed", got, "speeds ≥ 0", "Driving backwards is not supported.")
    instants = _instants(time, as_positive("dt", dt, unit="s"), steps)
    knots = np.union1d(time, instants)
    covered = cumulative_trapezoid(np.interp(knots, time, speed), knots, initial=0.0)  # exact for linear speed
    travelled = distance[0] + covered[np.searchsorted(knots, instants)]
    if travelled[-1] > distance[-1] + 1e-9 * abs(travelled[-1]):
        driven = f"at least the {travelled[-1] - distance[0]:.6g} m of the drive of {len(instants) - 1} steps"
        cure = "Take a longer road, or fewer steps."
        raise InputError("distance", f"a road of {distance[-1] - distance[0]:.6g} m", driven, cure)
    return np.asarray(np.diff(np.interp(travelled, distance, elevation)) / dt)


def _curve(x_name: str, x: ArrayLike, y_name: str, y: ArrayLike) -> tuple[Array, Array]:
    """Two finite vectors of one length, the first strictly increasing."""
    x = as_floats(x_name, x)
    y = as_floats(y_name, y)
    if x.ndim != 1 or x.shape != y.shape or len(x) < 2:
        shapes = f"shapes {x.shape} and {y.shape}"
        raise InputError(f"{x_name}, {y_name}", shapes, "two vectors of one length, at least 2")
    for name, values in ((x_name, x), (y_name, y)):
        if not np.isfinite(values).all():
            row = int(np.argmin(np.isfinite(values)))
            raise InputError(name, f"{values[row]} at index {row}", "finite numbers", "Fill or remove it.")
    if (np.diff(x) <= 0).any():
        row = int(np.argmax(np.diff(x) <= 0)) + 1
        got = f"{x[row - 1]:g} then {x[row]:g} at index {row}"
        raise InputError(x_name, got, "strictly increasing values", "Sort them and remove duplicates.")
    return x, y


def _instants(time: Array, dt: float, steps: int | None) -> Array:
    """Instants (T+1,) [s] of the steps' beginnings and the last end."""
    duration = time[-1] - time[0]
    available = math.floor(duration / dt * (1 + 1e-9))
    if available < 1:
        longer = "Take a longer speed record."
        raise InputError("time", f"{duration:.6g} s", f"at least one step of {dt:g} s", longer)
    steps = available if steps is None else as_count("steps", steps)
    if steps > available:
        most = f"at most {available}, as many as the {duration:.6g} s of speed cover"
        raise InputError("steps", f"{steps} of {dt:g} s", most, "Take a longer speed record, or fewer steps.")
    return np.asarray(np.minimum(time[0] + dt * np.arange(steps + 1), time[-1]))


# ── a road ──


Range: TypeAlias = tuple[float, float]
Profile: TypeAlias = Callable[[Array, float], Array]  # share of the height by distance into an obstacle and its length


def _plateau(x: Array, length: float, edge: float) -> Array:
    """Plateau: up over `edge`, flat, down over `edge`."""
    return np.clip(np.minimum(x, length - x) / edge, 0.0, 1.0)


def _sinusoid(x: Array, length: float) -> Array:
    """One period of a raised cosine, from 0 to 1 and back."""
    return 0.5 - 0.5 * np.cos(2 * np.pi * x / length)


OBSTACLES: dict[str, tuple[Range, Range, tuple[int, ...], Profile]] = {  # lengths and heights [m], signs, profile
    "jump": ((2.0, 10.0), (0.05, 0.13), (-1, 1), lambda x, length: _plateau(x, length, 0.4)),  # a steep slope
    "bump": ((3.0, 8.0), (0.03, 0.12), (1,), _sinusoid),
    "dent": ((0.8, 2.5), (0.03, 0.08), (-1,), _sinusoid),
    "ramp": ((20.0, 60.0), (0.1, 0.5), (-1, 1), lambda x, length: _plateau(x, length, length / 3)),
}


def generate_road(length: float, *, rng: np.random.Generator, spacing: float = 0.05) -> tuple[Array, Array]:
    """Road of jumps, bumps, dents and ramps on filtered noise.

    Parameters
    ----------
    length : float
        Length the road covers at least [m].
    rng : Generator
        Source of the randomness; the same state gives the same road.
    spacing : float
        Distance between samples [m].

    Returns
    -------
    distance, elevation : (S,) arrays
        Both in [m], from (0, 0). Every slope is finite: a jump rises over 0.4 m.

    Raises
    ------
    InputError
        If `length` or `spacing` is not a finite number > 0.

    References
    ----------
    ISO 8608 (spectrum and classes of road roughness; here −2 as its exponent).
    """
    intervals = math.ceil(as_positive("length", length, unit="m") / as_positive("spacing", spacing, unit="m") - 1e-9)
    as_generator("rng", rng)
    distance = spacing * np.arange(intervals + 1, dtype=np.float64)
    return distance, _rough(intervals + 1, spacing, rng) + generate_obstacles(distance, rng)


def _rough(samples: int, spacing: float, rng: np.random.Generator) -> Array:
    """First-order noise dz = −α z ds + σ dW, with spectrum 2σ² / (α² + (2πn)²)."""
    alpha = 2 * np.pi * 0.01  # flat below 0.01 1/m, so that the elevation stays bounded
    sigma = 2 * np.pi * REFERENCE_FREQUENCY * math.sqrt(road_roughness("C") / 2)
    decay = math.exp(-alpha * spacing)
    gain = sigma * math.sqrt((1 - decay**2) / (2 * alpha))
    noise = gain * rng.standard_normal(samples)
    noise[0] = 0.0
    return np.asarray(lfilter([1.0], [1.0, -decay], noise))


def generate_obstacles(distance: Array, rng: np.random.Generator) -> Array:
    """Elevation (S,) [m] of random obstacles with plain road between."""
    elevation = np.zeros_like(distance)
    kinds = tuple(OBSTACLES.values())
    gap = (5.0, 45.0)  # lengths of the plain road between two obstacles [m], above 0, which bounds the number of turns
    begin = rng.uniform(*gap)
    while begin < distance[-1]:
        lengths, heights, signs, profile = kinds[rng.integers(len(kinds))]
        length = rng.uniform(*lengths)
        height = rng.choice(signs) * rng.uniform(*heights)
        here = slice(*np.searchsorted(distance, (begin, begin + length)))
        elevation[here] += height * profile(distance[here] - begin, length)
        begin += length + rng.uniform(*gap)
    return elevation


# ── a driver ──


STYLES: dict[str, tuple[Range, Range, float]] = {  # speeds aimed at [m/s], for how long [s], acceleration [m/s²]
    "mild": ((8.0, 22.0), (20.0, 60.0), 0.5),
    "aggressive": ((18.0, 36.0), (6.0, 20.0), 3.0),
}


def generate_speed(
    duration: float, *, rng: np.random.Generator, driver: Driver = "mild", dt: float = 0.05
) -> tuple[Array, Array]:
    """Speed of a driver with random aims.

    Parameters
    ----------
    duration : float
        Time the drive covers at least [s].
    rng : Generator
        Source of the randomness; the same state gives the same drive.
    driver : "mild" or "aggressive"
        The aggressive one is faster, changes more often and brakes harder.
    dt : float
        Time between samples [s].

    Returns
    -------
    time, speed : (S,) arrays
        In [s], from 0, and [m/s]. The drive begins at the first speed aimed at.

    Raises
    ------
    InputError
        If `driver` is unknown, or `duration` or `dt` is not a finite number > 0.
    """
    as_choice("driver", driver, get_args(Driver))
    as_generator("rng", rng)
    intervals = math.ceil(as_positive("duration", duration, unit="s") / as_positive("dt", dt, unit="s") - 1e-9)
    time = dt * np.arange(intervals + 1, dtype=np.float64)
    knots, aims = _plan(time[-1], driver, rng)
    return time, np.interp(time, knots, aims)


def _plan(duration: float, driver: Driver, rng: np.random.Generator) -> tuple[Array, Array]:
    """Knots of the speed: hold, change, hold, …"""
    speeds, hold, acceleration = STYLES[driver]
    speed = rng.uniform(*speeds)
    knots = [0.0]
    aims = [speed]
    while knots[-1] < duration:  # hold[0] > 0 bounds the number of turns
        knots.append(knots[-1] + rng.uniform(*hold))
        aims.append(speed)
        change = rng.uniform(*speeds) - speed
        rate = acceleration * rng.uniform(0.3, 1.0)
        speed += change
        knots.append(knots[-1] + abs(change) / rate)
        aims.append(speed)
    return np.array(knots), np.array(aims)


def drives(one: Callable[[int, np.random.Generator], Array], runs: int, steps: int, rng: np.random.Generator) -> Array:
    """Drives (runs, steps, nw), each of a generator of its own."""
    check_draw(runs, steps, rng)
    return np.stack([one(steps, child) for child in rng.spawn(runs)])


@dataclass(frozen=True)
class GeneratedRoad:
    """Disturbance ż₀ [m/s] of a fresh road and drive per run.

    Attributes
    ----------
    driver : {"mild", "aggressive"}
    dt : float
        Sampling time [s].
    """

    driver: Driver = "mild"
    dt: float = 0.05

    def __post_init__(self) -> None:
        as_choice("driver", self.driver, get_args(Driver))
        as_positive("dt", self.dt, unit="s")

    @property
    def nw(self) -> int:
        """Number of channels."""
        return 1

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> Array:
        """Sequences (runs, steps, 1)."""
        return drives(self._drive, runs, steps, rng)

    def _drive(self, steps: int, rng: np.random.Generator) -> Array:
        """One drive on a fresh road, (steps, 1)."""
        time, speed = generate_speed(steps * self.dt, rng=rng, driver=self.driver, dt=self.dt)
        distance, elevation = generate_road(float(np.trapezoid(speed, time)) + 1.0, rng=rng)
        return road_disturbance(distance, elevation, time, speed, dt=self.dt, steps=steps)[:, None]
