"""Checks of arguments: shape, finiteness, symmetry, definiteness."""

from __future__ import annotations

from functools import partial
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ccdtools_ground import door
from ccdtools_ground.door import Immutable as Immutable, as_array as as_array, as_floats as as_floats, shown
from mpc.exceptions import InputError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]
as_count = partial(door.as_count, most=2**31 - 1)  # an int of the solvers


def as_seconds(name: str, value: Any) -> float:
    """Wall time > 0 [s]; None and inf are no limit."""
    if value is None:
        return np.inf
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Real) or not value > 0.0:  # type: ignore[operator]
        raise InputError(name, shown(value), "seconds > 0, or None for no limit")
    try:
        return float(value)
    except OverflowError:
        return np.inf


def as_rate_limit(value: ArrayLike, nu: int) -> Array:
    """Positive rate limits (nu,); a number holds for every input."""
    raw = as_floats("rate_limit", value)
    limit = as_array("rate_limit", np.full(nu, raw) if raw.ndim == 0 else raw, (nu,))
    if (limit <= 0).any():
        raise InputError("rate_limit", limit, "positive numbers")
    return limit


def as_soft(value: Any) -> tuple[float, float]:
    """Weights (linear >= 0, quadratic > 0) of soft constraints."""
    linear, quadratic = as_array("soft", value, (2,))
    if linear < 0 or quadratic <= 0:
        raise InputError("soft", value, "two weights (linear >= 0, quadratic > 0)")
    return float(linear), float(quadratic)


def as_blocks(value: Any, horizon: int) -> tuple[int, ...]:
    """Lengths of the blocks of equal moves; they sum to `horizon`."""
    lengths = tuple(value) if isinstance(value, list | tuple | np.ndarray) else (value,)
    try:
        lengths = tuple(as_count("blocks", length) for length in lengths)
    except InputError:
        lengths = ()
    if not lengths or sum(lengths) != horizon:
        raise InputError("blocks", shown(value), f"whole lengths >= 1 that sum to the horizon {horizon}")
    return lengths


def as_set(name: str, value: Any, n: int) -> Any:
    """None or an object with `.A` and `.b`; bounds become a Polytope."""
    if value is None or (hasattr(value, "A") and hasattr(value, "b")):
        return value
    if not isinstance(value, (tuple, list)) or len(value) != 2:
        raise InputError(name, shown(value), "a Polytope with .A and .b, bounds (lower, upper), or None")
    lower, upper = (_bound(f"{name}[{i}]", side, n) for i, side in enumerate(value))
    if (lower == np.inf).any() or (upper == -np.inf).any():
        raise InputError(name, "an infinite bound that excludes every point", "lower < inf and upper > -inf")
    if not (lower <= upper).all():
        raise InputError(name, f"lower {lower} above upper {upper}", "lower <= upper")
    from invariant_sets import Polytope

    rows = np.vstack([np.eye(n), -np.eye(n)])
    bounds = np.concatenate([upper, -lower])
    finite = np.isfinite(bounds)
    return Polytope(rows[finite], bounds[finite]) if finite.any() else None


def as_halfspaces(name: str, value: Any, n: int) -> tuple[Array, Array]:
    """Half-spaces (H, h) of a set; none for None."""
    value = as_set(name, value, n)
    if value is None:
        return np.zeros((0, n)), np.zeros(0)
    H = as_array(f"{name}.A", value.A, (None, n))
    h = as_array(f"{name}.b", value.b, (H.shape[0],))
    if len(getattr(value, "b_eq", ())):  # an equality is two inequalities
        Heq = as_array(f"{name}.A_eq", value.A_eq, (None, n))
        heq = as_array(f"{name}.b_eq", value.b_eq, (len(Heq),))
        H = np.vstack([H, Heq, -Heq])
        h = np.concatenate([h, heq, -heq])
    return H, h


def _bound(name: str, value: Any, n: int) -> Array:
    """One side (n,) of bounds; entries may be infinite."""
    side = as_floats(name, value)
    if side.ndim > 1 or side.size not in (1, n) or np.isnan(side).any():
        raise InputError(name, f"{side}", f"a number or {n} numbers, no NaN")
    return np.broadcast_to(side, (n,))
