"""A controller and a disturbance of a user, both of two levels."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class TwoLevels:
    """u = −level sign(C x), for states (n, nx)."""

    C: tuple[float, ...]
    level: float

    def __call__(self, x):
        """Inputs (n, 1)."""
        return -self.level * np.sign(np.atleast_2d(x) @ np.array(self.C))[:, None]


@dataclass(frozen=True)
class SquareWave:
    """A wave of one channel with a random phase in every run."""

    height: float
    period: int
    nw: int = 1

    def sample(self, runs, steps, rng):
        """Sequences (runs, steps, 1)."""
        phase = rng.integers(self.period, size=(runs, 1))
        return self.height * np.where((np.arange(steps) + phase) % self.period < self.period // 2, 1.0, -1.0)[..., None]
