"""Controllers: anything with ``u = controller(x)``, batched."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, ArrayField
from ccdtools.exceptions import InputError


class Controller(Protocol):
    """States (n, nx) to inputs (n, nu); a single state (nx,) to (nu,)."""

    def __call__(self, x: Array) -> Array:
        """The inputs."""
        ...


@dataclass(frozen=True, eq=False)
class Passive:
    """u = 0: what the plant does alone."""

    nu: int = 1

    def __call__(self, x: ArrayLike) -> Array:
        """Zeros (n, nu) or (nu,)."""
        return np.zeros((*np.shape(x)[:-1], self.nu))


@dataclass(frozen=True, eq=False)
class LinearFeedback:
    """u = clip(−K x, lower, upper): an LQR, or any static gain, with saturation.

    Parameters
    ----------
    K : (nu, nx) array_like
    lower, upper : (nu,) array_like
        Input bounds, in the units of u.
    """

    K: ArrayField
    lower: ArrayField = field(default_factory=lambda: np.array(-np.inf))
    upper: ArrayField = field(default_factory=lambda: np.array(np.inf))

    def __post_init__(self) -> None:
        K = np.atleast_2d(np.array(self.K, dtype=float))
        if not np.isfinite(K).all():
            raise InputError("K: got a gain that is not finite, expected a finite (nu, nx) array.")
        object.__setattr__(self, "K", K)

    def __call__(self, x: ArrayLike) -> Array:
        """Saturated inputs (n, nu) or (nu,)."""
        return np.clip(-np.asarray(x, dtype=float) @ self.K.T, self.lower, self.upper)


class PID:
    """u = clip(−(kp y + ki ∫y dt + kd dy/dt)) with y = C x, clamping anti-windup; one gain row per input.

    The integral and the last output are memory: `reset` clears them.

    Parameters
    ----------
    C : (ny, nx) array_like
        Measured outputs, one per input.
    kp, ki, kd : (ny,) array_like
    dt : float
        Sampling time [s].
    lower, upper : (ny,) array_like
        Input bounds.
    """

    def __init__(self, C, kp, ki, kd, *, dt: float, lower, upper) -> None:
        self.C = np.atleast_2d(np.array(C, dtype=float))
        self.kp, self.ki, self.kd = (np.array(g, dtype=float).reshape(-1) for g in (kp, ki, kd))
        self.dt, self.lower, self.upper = float(dt), np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
        self._integral: Array | None = None
        self._last: Array | None = None

    def reset(self, n: int) -> None:
        """Forget the past of `n` runs."""
        self._integral = np.zeros((n, len(self.C)))
        self._last = None

    def __call__(self, x: ArrayLike) -> Array:
        """Inputs (n, nu) or (nu,); advances the memory by one sample."""
        x = np.asarray(x, dtype=float)
        y = np.atleast_2d(x) @ self.C.T
        if self._integral is None or len(self._integral) != len(y):
            self.reset(len(y))
        assert self._integral is not None
        rate = np.zeros_like(y) if self._last is None else (y - self._last) / self.dt
        integral = self._integral + self.dt * y
        wanted = -(self.kp * y + self.ki * integral + self.kd * rate)
        u = np.clip(wanted, self.lower, self.upper)
        self._integral = np.where(wanted == u, integral, self._integral)
        self._last = y
        return u if x.ndim == 2 else u[0]
