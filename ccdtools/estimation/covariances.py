"""Checks of covariances, and where an estimate starts."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, frozen
from ccdtools.checks import as_floats, as_vector, finite
from ccdtools.exceptions import InputError
from mpc.checks import as_weight
from mpc.exceptions import NotConvexError

SINGULAR = 1e-12  # eigenvalue of a covariance with unit diagonal, below which a combination has no variance


def as_covariance(argument: str, value: Any, size: int, *, definite: bool = False, cure: str = "") -> Array:
    """A read-only covariance (size, size), in any units; a vector is its diagonal, the variances."""
    given = np.atleast_1d(finite(argument, as_floats(argument, value)))
    if given.shape not in ((size,), (size, size)):
        raise InputError(argument, f"shape {given.shape}", f"a covariance ({size}, {size}), or variances ({size},)")
    kind = f"positive {'definite' if definite else 'semidefinite'}"
    full = np.diag(given) if given.ndim == 1 else given
    if (np.diag(full) < 0).any():
        raise InputError(argument, "a negative variance", f"a symmetric, {kind} matrix", cure)
    try:
        M = as_weight(argument, full, size)
    except NotConvexError as error:
        got = "a matrix that is not symmetric" if error.eigenvalue is None else "an indefinite matrix"
        raise InputError(argument, got, f"a symmetric, {kind} matrix", cure) from None
    deviation = np.sqrt(np.diag(M))
    if definite and not (deviation > 0).all():
        raise InputError(argument, "a variance of 0", f"a {kind} matrix", cure)
    if definite and np.linalg.eigvalsh(M / deviation / deviation[:, None])[0] < SINGULAR:
        raise InputError(argument, "a singular matrix", f"a {kind} one", cure)
    return frozen(M)


def as_noise_covariances(W: ArrayLike, V: ArrayLike, nx: int, ny: int) -> tuple[Array, Array]:
    """Those of the process noise and of the measurement noise."""
    cure = "Give an output without noise a small variance."
    return as_covariance("W", W, nx), as_covariance("V", V, ny, definite=True, cure=cure)


def as_start(x0: ArrayLike | None, P0: ArrayLike | None, nx: int) -> tuple[Array, Array]:
    """The estimate (nx,) and its covariance before the first measurement; 0 where no estimate is given."""
    if P0 is None:
        cure = "How far the first state may lie from x0; steady=True of a KalmanFilter needs none."
        raise InputError("P0", "nothing", f"the covariance ({nx}, {nx}) of the first state", cure)
    return _estimate(x0, nx), as_covariance("P0", P0, nx)


def _estimate(x0: ArrayLike | None, nx: int) -> Array:
    """The first estimate, (nx,)."""
    return frozen(np.zeros(nx)) if x0 is None else as_vector("x0", x0, nx, of="one per state")
