"""Checks at the public door: shape, finiteness, symmetry and definiteness, each once."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpc.exceptions import InputError, NotConvexError

Array = NDArray[np.float64]


def as_floats(name: str, value: ArrayLike) -> Array:
    """Return a C-contiguous float64 copy of `value`, of any shape, finite or not."""
    try:
        if np.iscomplexobj(value):
            raise TypeError("got complex ones")
        return np.array(value, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be an array of real numbers: {error}") from None


def as_array(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """Return a read-only, C-contiguous float64 copy of `value`; None in `shape` matches any length."""
    array = as_floats(name, value)
    expected = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ("," if len(shape) == 1 else "") + ")"
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape)):
        raise InputError(f"{name} has shape {array.shape}, expected {expected}.")
    if not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise InputError(f"{name} is not finite at index {where}: got {array[where]}.")
    array.flags.writeable = False
    return array


def as_weight(name: str, value: ArrayLike, n: int) -> Array:
    """Return a symmetric positive semidefinite (n, n) weight, read-only; a vector is taken as its diagonal."""
    raw = as_floats(name, value)
    weight = as_array(name, np.diag(raw) if raw.ndim == 1 else np.atleast_2d(raw), (n, n))
    size = max(float(np.abs(weight).max(initial=0.0)), np.finfo(float).tiny)
    gap = float(np.abs(weight - weight.T).max(initial=0.0))
    if gap > 1e-9 * size:
        raise NotConvexError(f"{name} is not symmetric: max |{name} - {name}'| = {gap:.3g}. Pass ({name} + {name}')/2.")
    # congruence with the diagonal keeps the test meaningful for entries of very different size
    d = np.sqrt(np.abs(np.diag(weight)))
    d[d == 0] = np.sqrt(size)
    smallest = float(np.linalg.eigvalsh((weight + weight.T) / 2 / np.outer(d, d)).min(initial=0.0))
    if smallest < -1e-10:
        raise NotConvexError(
            f"{name} has a negative direction (scaled eigenvalue {smallest:.3g}), expected {name} ⪰ 0."
        )
    symmetric: Array = (weight + weight.T) / 2
    symmetric.flags.writeable = False
    return symmetric


def as_horizon(value: int) -> int:
    """Return the horizon as a positive int."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or not 1 <= value < 2**31 or value % 1:
        raise InputError(f"horizon must be an integer >= 1, got {value!r}.")
    return int(value)


def as_rate_limit(value: ArrayLike, nu: int) -> Array:
    """Return the rate limits (nu,), positive; a number holds for every input."""
    raw = as_floats("rate_limit", value)
    limit = as_array("rate_limit", np.full(nu, raw) if raw.ndim == 0 else raw, (nu,))
    if (limit <= 0).any():
        raise InputError(f"rate_limit must be positive, got {limit}.")
    return limit


def as_soft(value: Any) -> tuple[float, float]:
    """Return the weights (linear >= 0, quadratic > 0) of soft constraints."""
    linear, quadratic = as_array("soft", value, (2,))
    if linear < 0:
        raise InputError(f"soft must not be negative, got {value}.")
    if quadratic <= 0:
        raise InputError(f"soft must be positive in its second, quadratic weight, got {value}.")
    return float(linear), float(quadratic)


def as_blocks(value: Any, horizon: int) -> tuple[int, ...]:
    """Return the lengths of the blocks of equal moves, which sum to the horizon."""
    lengths = np.atleast_1d(as_floats("blocks", value))
    if lengths.ndim != 1 or not (lengths >= 1).all() or (lengths % 1).any() or lengths.sum() != horizon:
        raise InputError(f"blocks are {value}, expected whole lengths >= 1 that sum to the horizon {horizon}.")
    return tuple(int(n) for n in lengths)


def as_halfspaces(name: str, value: Any, n: int) -> tuple[Array, Array]:
    """Return (H, h) of {v : Hv <= h}, a `Polytope` or anything with `.A` and `.b`; None is the whole space."""
    if value is None:
        return np.zeros((0, n)), np.zeros(0)
    if not (hasattr(value, "A") and hasattr(value, "b")):
        raise InputError(f"{name} must be a Polytope with .A and .b, or None; got {type(value).__name__}.")
    H = as_array(f"{name}.A", value.A, (None, n))
    h = as_array(f"{name}.b", value.b, (H.shape[0],))
    if len(getattr(value, "b_eq", ())):  # an equality is two inequalities
        Heq, heq = as_array(f"{name}.A_eq", value.A_eq, (None, n)), as_array(f"{name}.b_eq", value.b_eq, (None,))
        H, h = np.vstack([H, Heq, -Heq]), np.concatenate([h, heq, -heq])
    return H, h


def as_pair(A: Any, B: ArrayLike | None) -> tuple[Array, Array]:
    """Return (A, B) as arrays; A may be a discrete-time `control.StateSpace`, with B left out."""
    if B is None:
        if not (hasattr(A, "A") and hasattr(A, "B")):
            raise InputError("B is missing: pass A and B, or a discrete-time control.StateSpace.")
        if not getattr(A, "dt", None):
            raise InputError(f"the StateSpace has dt = {A.dt}, expected a discrete-time system.")
        A, B = A.A, A.B
    A = as_array("A", A, (None, None))
    if A.shape[0] != A.shape[1] or A.shape[0] == 0:
        raise InputError(f"A has shape {A.shape}, expected a square matrix.")
    B = as_array("B", B, (A.shape[0], None))
    if B.shape[1] == 0:
        raise InputError(f"B has shape {B.shape}, expected at least one input.")
    return A, B
