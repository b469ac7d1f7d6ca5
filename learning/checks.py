"""Checks of numbers, layers, bounds and samples in `learning`."""

from __future__ import annotations

import numbers
from typing import Any

import numpy as np

from ccdtools_ground.door import as_count, as_floats, as_instance, as_number
from learning.exceptions import InputError
from learning.tolerances import ROUNDING

Array = np.ndarray


def check_number(value: Any, name: str, low: float = 0.0, high: float = np.inf, *, closed: bool = False) -> float:
    """Return a finite number between `low` and `high`, both excluded unless `closed`."""
    return as_number(name, value, expected=_interval(low, high, closed=closed), low=low, high=high, strict=not closed)


def _interval(low: float, high: float, *, closed: bool) -> str:
    """Return the text of an interval."""
    relation = "at least" if closed else "above"
    if np.isinf(high):
        return f"a finite number {relation} {low:g}"
    return f"a number from {low:g} to {high:g}" + ("" if closed else ", both excluded")


def as_sizes(value: Any, name: str) -> tuple[int, ...]:
    """Return the widths of hidden layers as positive integers."""
    try:
        sizes = tuple(value)
    except TypeError:
        sizes = ()
    if not sizes or any(isinstance(size, bool) or not isinstance(size, numbers.Integral) or size < 1 for size in sizes):
        raise InputError(name, repr(value), "at least one layer of at least one neuron, such as (64, 64)")
    return tuple(int(size) for size in sizes)


def as_lengths(value: Any, name: str, total: int) -> list[int]:
    """Return the lengths of stretches of `total` samples; one if None."""
    if value is None:
        return [total]
    if not isinstance(value, (list, tuple, np.ndarray)):
        raise InputError(name, repr(value)[:60], "a list of lengths")
    lengths = [as_count(name, length) for length in value]
    if sum(lengths) != total:
        raise InputError(name, f"lengths that sum to {sum(lengths)}", f"{total}, the number of samples")
    return lengths


def check_instance(value: Any, name: str, kind: type) -> Any:
    """Return `value`, if it is of that class."""
    return as_instance(name, value, kind, f"an object of {kind.__name__}")


def as_bounds(value: Any, name: str, size: int) -> tuple[Array, Array]:
    """Return (lower, upper), each (size,), not checked for order."""
    bounds = tuple(value) if isinstance(value, (tuple, list, np.ndarray)) else ()
    if len(bounds) != 2:
        raise InputError(name, repr(value)[:60], f"(lower, upper), each ({size},)")
    lower, upper = (np.atleast_1d(as_floats(name, bound)) for bound in bounds)
    if not lower.shape == upper.shape == (size,):
        raise InputError(name, f"shapes {lower.shape} and {upper.shape}", f"(lower, upper), each ({size},)")
    return lower, upper


def spread(samples: Array, constant: float = 1.0) -> Array:
    """Return the standard deviation of each column, `constant` where that is rounding."""
    deviation = samples.std(axis=0)
    return np.where(deviation > ROUNDING * np.abs(samples).max(axis=0), deviation, constant)


def as_samples(inputs: Any, targets: Any, *, least: int = 20) -> tuple[Array, Array]:
    """Return finite inputs (n, d) and targets (n, m), of enough samples."""
    x = as_floats("inputs", inputs)
    y = as_floats("targets", targets)
    y = y[:, None] if y.ndim == 1 else y
    if x.ndim != 2 or y.ndim != 2 or len(x) != len(y) or len(x) < least or not (x.shape[1] and y.shape[1]):
        size = f", {len(x)} sample(s) of {x.shape[1]} feature(s)" if x.ndim == 2 else ""
        raise InputError("inputs, targets", f"shapes {x.shape} and {y.shape}{size}", f"(n, d), (n, m), n ≥ {least}")
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise InputError("inputs, targets", "values that are not finite", "finite samples")
    return x, y
