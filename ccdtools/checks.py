"""Checks of arguments that return the value or raise an `InputError`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ccdtools_ground.door import as_count, as_floats, as_generator, as_instance, as_number, frozen, shown, weight_faults
from ccdtools_ground.errors import InputError
from ccdtools_ground.tolerances import WEIGHT_ROUNDING

if TYPE_CHECKING:
    from ccdtools.arrays import Array

__all__ = ["TOLERANCES", "as_array", "as_choice", "as_count", "as_different", "as_flag", "as_floats", "as_generator",
           "as_instance", "as_limit_tolerance", "as_mapping", "as_names", "as_number", "as_positive", "as_share",
           "as_vector", "as_weight", "finite", "has_method", "nearest", "shown", "writable_path"]  # fmt: skip
TOLERANCES = ("mpc", "off")  # of the state limits, in words


def as_array(argument: str, value: Any, *shapes: tuple[int | str, ...]) -> Array:
    """Read-only float64 array of finite numbers in one of `shapes`; words match any length ≥ 1."""
    wanted = " or ".join(_shape_text(shape) for shape in shapes)
    array = as_floats(argument, value, expected=f"numbers of shape {wanted}" if shapes else "numbers")
    if shapes and not any(_fits(array.shape, shape) for shape in shapes):
        raise InputError(argument, f"shape {array.shape}", wanted)
    return frozen(finite(argument, array))


def finite(argument: str, array: Array) -> Array:
    """`array`, if all of it is finite."""
    if not np.isfinite(array).all():
        raise InputError(argument, "a value that is not finite", "finite numbers")
    return array


def as_vector(argument: str, value: Any, size: int | None = None, *, of: str = "") -> Array:
    """Read-only vector of `size` finite numbers; a single number counts as one."""
    array = np.atleast_1d(as_floats(argument, value))
    if array.ndim != 1 or (size is not None and len(array) != size):
        one = f"{size} number{'' if size == 1 else 's'}" if size is not None else "a vector of numbers"
        raise InputError(argument, f"shape {array.shape}", one + (f", {of}" if of else ""))
    return frozen(finite(argument, array))


def as_weight(argument: str, value: Any, size: int | None = None) -> Array:
    """Read-only symmetric positive semidefinite matrix; a number is 1 × 1."""
    M = np.atleast_2d(as_floats(argument, value))
    n = len(M) if size is None else size
    if M.shape != (n, n):
        raise InputError(argument, f"shape {M.shape}", "a square matrix" if size is None else f"({n}, {n})")
    finite(argument, M)
    gap, smallest = weight_faults(M)
    if gap > WEIGHT_ROUNDING:
        raise InputError(argument, "a matrix that is not symmetric", f"{argument} = {argument}ᵀ")
    if smallest < -WEIGHT_ROUNDING:
        got = f"smallest eigenvalue {smallest:.3g} at a unit diagonal"
        raise InputError(argument, got, "a positive semidefinite matrix")
    return frozen((M + M.T) / 2)


def as_positive(argument: str, value: Any, *, unit: str = "") -> float:
    """Finite number above zero."""
    return as_number(argument, value, expected=f"a positive number{unit and f' [{unit}]'}", low=0.0, strict=True)


def as_share(argument: str, value: Any) -> float:
    """Fraction between 0 and 1, both excluded."""
    return as_number(argument, value, expected="a fraction between 0 and 1", low=0.0, high=1.0, strict=True)


def as_flag(argument: str, value: Any) -> bool:
    """True or False."""
    if not isinstance(value, bool | np.bool_):
        raise InputError(argument, shown(value), "True or False")
    return bool(value)


def as_choice(argument: str, value: Any, choices: Sequence[str]) -> str:
    """One of the words in `choices`."""
    if not isinstance(value, str) or value not in choices:
        raise InputError(argument, shown(value), f"one of {', '.join(choices)}", nearest(value, choices))
    return value


def nearest(value: Any, choices: Sequence[str]) -> str:
    """Question for a word like the given one; empty if none."""
    words = {choice.lower(): choice for choice in choices}
    found = get_close_matches(value.lower(), words, n=1) if isinstance(value, str) else []
    return f"Did you mean {words[found[0]]}?" if found else ""


def as_limit_tolerance(argument: str, value: Any) -> str | tuple[float, float]:
    """Tolerance of limits: "mpc", "off", or (fraction of states, depth in half-widths) ≥ 0."""
    expected = "mpc, off, or (fraction of the states outside X, peak depth in half-widths of X), both ≥ 0"
    if isinstance(value, str):
        if value not in TOLERANCES:
            raise InputError(argument, shown(value), expected)
        return value
    if not isinstance(value, list | tuple | np.ndarray) or len(value) != 2:
        raise InputError(argument, shown(value), expected)
    fraction = as_number(argument, value[0], expected=expected, low=0.0, high=1.0)
    return (fraction, as_number(argument, value[1], expected=expected, low=0.0))


def as_names(argument: str, value: Any, size: int, default: str = "") -> tuple[str, ...]:
    """Names, as many as `size`; of an empty tuple `default` with numbers from 1, if there is one."""
    if default and isinstance(value, tuple) and not value:
        return tuple(f"{default}{i + 1}" for i in range(size))
    if isinstance(value, str):
        raise InputError(argument, shown(value), f"a list of {size} name{'' if size == 1 else 's'}")
    try:
        names = tuple(value)
    except TypeError:
        names = ()
    if len(names) != size or not all(isinstance(name, str) for name in names):
        raise InputError(argument, shown(value), f"{size} name{'' if size == 1 else 's'}")
    return names


def as_different(argument: str, value: Any, low: int, high: int) -> tuple[int, ...]:
    """Different whole numbers from `low` to `high`."""
    expected = f"different whole numbers from {low} to {high}"
    if isinstance(value, str) or not isinstance(value, Sequence | np.ndarray):
        raise InputError(argument, shown(value), expected)
    numbers = tuple(as_count(argument, number, least=low) for number in value)
    if len(set(numbers)) != len(numbers) or max(numbers, default=low) > high:
        raise InputError(argument, shown(list(numbers)), expected)
    return numbers


def as_mapping(argument: str, value: Any, expected: str) -> dict[str, Any]:
    """New dictionary of a mapping from names."""
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise InputError(argument, shown(value), expected)
    return dict(value)


def has_method(argument: str, value: Any, method: str, expected: str) -> Any:
    """`value`, if it is an object with that method."""
    if isinstance(value, type) or not callable(getattr(value, method, None)):
        raise InputError(argument, shown(value), expected)
    return value


def writable_path(argument: str, value: Any) -> Path:
    """Path of a file to write, in an existing folder."""
    if not isinstance(value, str | os.PathLike) or not str(value):
        raise InputError(argument, shown(value), "the path of a file")
    path = Path(value)
    if path.is_dir():
        raise InputError(argument, f"{path}, which is a folder", "the path of a file")
    if not path.absolute().parent.is_dir():
        raise InputError(argument, str(path), "a path in a folder that exists", f"Make {path.parent} first.")
    return path


def _fits(shape: tuple[int, ...], wanted: tuple[int | str, ...]) -> bool:
    """Whether a shape has the wanted lengths."""
    return len(shape) == len(wanted) and all(
        length >= 1 if isinstance(want, str) else length == want for length, want in zip(shape, wanted)
    )


def _shape_text(shape: tuple[int | str, ...]) -> str:
    """Shape as written in a docstring."""
    return f"({shape[0]},)" if len(shape) == 1 else f"({', '.join(str(length) for length in shape)})"
