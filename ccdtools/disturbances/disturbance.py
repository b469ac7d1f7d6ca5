"""Disturbances acting on a plant: random or recorded."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass
from functools import lru_cache
from typing import Any, Protocol

import numpy as np

from ccdtools.arrays import Array, ArrayField, Immutable
from ccdtools.exceptions import InputError
from ccdtools_ground.door import as_array, as_count, as_finite, as_floats, as_generator, as_vector, shown


class Disturbance(Protocol):
    """Anything that draws disturbance sequences; `nw` is its number of channels, if known."""

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> Array:
        """Sequences (runs, steps, nw)."""
        ...


@dataclass(frozen=True, eq=False)
class Gaussian(Immutable):
    """Independent normal noise of standard deviation `std` and `mean` (nw,), zero by default."""

    std: ArrayField
    mean: ArrayField = 0.0

    def __post_init__(self) -> None:
        std = as_vector("std", self.std)
        if (std < 0).any():
            raise InputError("std", shown(std), "standard deviations ≥ 0")
        mean = as_array("mean", self.mean, (), (1,), std.shape)
        self._set(std=std, mean=np.broadcast_to(mean, std.shape).copy())

    @property
    def nw(self) -> int:
        """Number of channels."""
        return len(self.std)

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> Array:
        """Sequences (runs, steps, nw)."""
        check_draw(runs, steps, rng)
        return np.asarray(self.mean + self.std * rng.standard_normal((runs, steps, len(self.std))))


NO_DISTURBANCE = Gaussian(())


@dataclass(frozen=True, eq=False)
class Uniform(Immutable):
    """Independent uniform noise between `lower` and `upper` (nw,)."""

    lower: ArrayField
    upper: ArrayField

    def __post_init__(self) -> None:
        lower = as_vector("lower", self.lower)
        upper = as_vector("upper", self.upper, len(lower), of="as many as lower bounds")
        if not (lower <= upper).all():
            raise InputError("lower, upper", f"{shown(lower)} and {shown(upper)}", "lower ≤ upper")
        self._set(lower=lower, upper=upper)

    @property
    def nw(self) -> int:
        """Number of channels."""
        return len(self.lower)

    @property
    def mean(self) -> Array:
        """Middle of the bounds (nw,)."""
        return np.asarray((self.lower + self.upper) / 2)

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> Array:
        """Sequences (runs, steps, nw)."""
        check_draw(runs, steps, rng)
        return rng.uniform(self.lower, self.upper, (runs, steps, len(self.lower)))


@dataclass(frozen=True, eq=False, repr=False)
class Recorded(Immutable):
    """Recorded signal (T, nw) or (T,): from its start for one run, seeded windows for several."""

    signal: ArrayField

    def __post_init__(self) -> None:
        signal = as_floats("signal", self.signal)
        signal = signal[:, None] if signal.ndim == 1 else signal
        if signal.ndim != 2 or signal.size == 0:
            raise InputError("signal", f"shape {signal.shape}", "samples (T,) or (T, nw)")
        self._set(signal=as_finite("signal", signal))

    def __repr__(self) -> str:
        return f"Recorded({len(self.signal)} samples, {self.nw} channels)"

    @property
    def nw(self) -> int:
        """Number of channels."""
        return int(self.signal.shape[1])

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> Array:
        """Sequences (runs, steps, nw).

        Raises
        ------
        InputError
            If the recording is shorter than `steps`.
        """
        check_draw(runs, steps, rng)
        spare = len(self.signal) - steps
        if spare < 0:
            raise InputError("steps", steps, f"at most {len(self.signal)}, the samples of the recording")
        starts = np.zeros(1, dtype=int) if runs == 1 else rng.integers(0, spare + 1, runs)
        return np.asarray(self.signal[starts[:, None] + np.arange(steps)])


def check_draw(runs: int, steps: int, rng: np.random.Generator) -> None:
    """Raise an `InputError` unless arguments of `sample` are valid."""
    as_count("runs", runs)
    as_count("steps", steps)
    as_generator("rng", rng)


def drawn_moments(scenarios: Any, steps: int) -> tuple[Array, Array, Array, Array]:
    """Means and covariances of the starts (nx,), (nx, nx) and of w (nw,), (nw, nw), by a sample.

    Those of scenarios that consist of objects of this library are kept, as these do not change.
    """
    return (_kept_moments if _lasting(scenarios) else _kept_moments.__wrapped__)(scenarios, steps)


def _lasting(one: Any) -> bool:
    """Whether nothing of what is drawn can change."""
    if isinstance(one, tuple):
        return all(map(_lasting, one))
    if is_dataclass(one) and type(one).__module__.startswith(f"{__name__.split('.', 1)[0]}."):
        return all(_lasting(getattr(one, field.name)) for field in fields(one))
    return not hasattr(one, "sample")


@lru_cache
def _kept_moments(scenarios: Any, steps: int) -> tuple[Array, Array, Array, Array]:
    x0, w = scenarios.sample(4096, steps, np.random.default_rng(0))
    mean, drift = x0.mean(axis=0), w.mean(axis=(0, 1))
    away, w = x0 - mean, np.vstack(w - drift)
    found = (mean, away.T @ away / len(x0), drift, w.T @ w / len(w))
    for part in found:
        part.flags.writeable = False
    return found
