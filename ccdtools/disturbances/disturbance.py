"""Disturbances acting on a plant: random, recorded, or a sum of both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ccdtools.arrays import Array, ArrayField
from ccdtools.exceptions import InputError


class Disturbance(Protocol):
    """Anything that draws disturbance sequences."""

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> Array:
        """Sequences (runs, steps, nw)."""
        ...


@dataclass(frozen=True, eq=False)
class Gaussian:
    """Independent normal noise with standard deviations `std` (nw,) and `mean` (nw,), zero by default."""

    std: ArrayField
    mean: ArrayField = 0.0

    def __post_init__(self) -> None:
        std = np.array(self.std, dtype=float).reshape(-1)
        if not (np.isfinite(std).all() and (std >= 0).all()):
            raise InputError(f"disturbance std: got {std}, expected finite values ≥ 0.")
        object.__setattr__(self, "std", std)

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> Array:
        """Sequences (runs, steps, nw)."""
        return self.mean + self.std * rng.standard_normal((runs, steps, len(self.std)))


@dataclass(frozen=True, eq=False)
class Uniform:
    """Independent uniform noise between `lower` and `upper` (nw,)."""

    lower: ArrayField
    upper: ArrayField

    def __post_init__(self) -> None:
        lower, upper = (np.array(b, dtype=float).reshape(-1) for b in (self.lower, self.upper))
        if lower.shape != upper.shape or not (lower <= upper).all():
            raise InputError(f"disturbance bounds: got {lower} and {upper}, expected lower ≤ upper, one per channel.")
        object.__setattr__(self, "lower", lower)
        object.__setattr__(self, "upper", upper)

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> Array:
        """Sequences (runs, steps, nw)."""
        return rng.uniform(self.lower, self.upper, (runs, steps, len(self.lower)))


@dataclass(frozen=True, eq=False)
class Sum:
    """The sum of independent disturbances with the same channels."""

    terms: tuple[Disturbance, ...]

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> Array:
        """Sequences (runs, steps, nw)."""
        return np.sum([term.sample(runs, steps, rng) for term in self.terms], axis=0)


@dataclass(frozen=True, eq=False)
class Recorded:
    """A recorded signal (T, nw) or (T,): one run replays it from its start, several take seeded windows of it."""

    signal: ArrayField

    def __post_init__(self) -> None:
        signal = np.array(self.signal, dtype=float)
        signal = signal[:, None] if signal.ndim == 1 else signal
        if signal.ndim != 2 or not np.isfinite(signal).all():
            raise InputError(f"disturbance: got shape {signal.shape}, expected finite samples (T, nw).")
        signal.setflags(write=False)
        object.__setattr__(self, "signal", signal)

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> Array:
        """Sequences (runs, steps, nw).

        Raises
        ------
        InputError
            If the recording is shorter than `steps`.
        """
        spare = len(self.signal) - steps
        if spare < 0:
            raise InputError(f"disturbance: got {len(self.signal)} samples, expected at least {steps}.")
        starts = np.zeros(1, dtype=int) if runs == 1 else rng.integers(0, spare + 1, runs)
        return self.signal[starts[:, None] + np.arange(steps)]
