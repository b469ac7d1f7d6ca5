"""Checks of arguments: shapes, numbers, finiteness."""

from __future__ import annotations

from typing import Any

import numpy as np

from ccdtools_ground.door import as_count, as_finite, as_floats, as_generator, as_number, frozen, shown
from invariant_sets.exceptions import InputError

__all__ = [
    "as_batch",
    "as_bounds",
    "as_coordinates",
    "as_count",
    "as_finite",
    "as_floats",
    "as_generator",
    "as_matrix",
    "as_number",
    "as_vector",
    "check_tolerance",
    "frozen",
    "shown",
]  # fmt: skip
Array = np.ndarray


def as_matrix(value: Any, name: str, *, rows: int | None = None, columns: int | None = None) -> Array:
    """Two-dimensional float64 copy of the required shape."""
    array = as_floats(name, value)
    if array.ndim != 2 or rows not in (None, array.shape[0]) or columns not in (None, array.shape[1]):
        expected = f"({'m' if rows is None else rows}, {'n' if columns is None else columns})"
        raise InputError(name, f"shape {array.shape}", expected)
    as_finite(name, array)
    return array


def as_vector(value: Any, name: str, *, size: int | None = None, finite: bool = True) -> Array:
    """One-dimensional float64 copy of the required size."""
    array = as_floats(name, value)
    if array.ndim == 0:
        array = array.reshape(1)
    if array.ndim != 1 or size not in (None, array.shape[0]):
        raise InputError(name, f"shape {array.shape}", f"({'n' if size is None else size},)")
    if finite:
        as_finite(name, array)
    return array


def as_batch(value: Any, name: str, columns: int, *, finite: bool = True, copy: bool = True) -> tuple[Array, bool]:
    """Array (k, columns), and whether it was one point (columns,)."""
    plain = isinstance(value, np.ndarray) and value.dtype == np.float64 and not copy
    array = value if plain else as_floats(name, value)
    single = array.ndim <= 1
    if single:
        array = array.reshape(1, -1)
    if array.ndim != 2 or array.shape[1] != columns:
        raise InputError(name, f"shape {np.shape(value)}", f"({columns},) or (k, {columns})")
    if finite:
        as_finite(name, array)
    return array, single


def as_bounds(lower: Any, upper: Any) -> tuple[Array, Array]:
    """Bounds (n,) of a box, lower <= upper; ±inf is no bound."""
    lower = as_vector(lower, "lower", finite=False)
    if len(lower) == 0:
        raise InputError("lower", "no bounds", "one for each coordinate")
    upper = as_vector(upper, "upper", size=len(lower), finite=False)
    for name, bound in (("lower", lower), ("upper", upper)):
        as_finite(name, np.where(np.isinf(bound), 0.0, bound))
    if (lower == np.inf).any() or (upper == -np.inf).any():
        name = "lower" if (lower == np.inf).any() else "upper"
        raise InputError(name, "an infinite bound that excludes every point", "lower < inf and upper > -inf")
    reversed_ = np.flatnonzero(lower > upper)
    if len(reversed_):
        i = int(reversed_[0])
        raise InputError(
            "lower",
            f"{lower[i]:g} above upper, {upper[i]:g}, at index {i}",
            "lower <= upper",
            "Exchange them; the empty set is Polytope.empty(n).",
        )
    return lower, upper


def as_coordinates(value: Any, dim: int) -> Array:
    """Distinct indices of coordinates, or raise `InputError`."""
    try:
        index = np.atleast_1d(np.asarray(value))
    except ValueError:  # ragged
        index = np.zeros(0)
    proper = index.ndim == 1 and len(index) > 0 and index.dtype.kind in "iu" and len(np.unique(index)) == len(index)
    if not proper or index.min() < 0 or index.max() >= dim:
        raise InputError("coordinates", shown(value), f"distinct integers from 0 to {dim - 1}")
    return index


def check_tolerance(tol: Any, name: str = "tol") -> float:
    """Tolerance as a float >= 0, or raise `InputError`."""
    return as_number(name, tol, expected="a finite number >= 0", low=0.0)
