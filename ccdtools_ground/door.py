"""Checks of numbers at every package's public door; Booleans are no numbers."""

from __future__ import annotations

import contextlib
import math
import numbers
import os
import warnings
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np

from ccdtools_ground.errors import InputError

Array = np.ndarray
T = TypeVar("T")
KINDS: dict[Any, type] = {"Array": float, "Indices": np.int64, "Ints": np.int64, "Mask": np.bool_}  # of array fields


def shown(value: Any) -> str:
    """Short text of a value: itself, or its type or shape."""
    if value is None:
        return "nothing"
    if isinstance(value, np.ndarray) and value.ndim > 0:
        return f"an array of shape {value.shape}" if value.size > 6 else _one_line(value.tolist())
    if isinstance(value, bool | numbers.Number | str | np.generic | os.PathLike | list | tuple | dict | set):
        return _one_line(value)
    if isinstance(value, type):
        return f"the class {value.__name__}"
    return f"a {type(value).__name__}"


def _one_line(value: Any) -> str:
    """Text of `repr` on one line, cut where long."""
    return brief(" ".join(repr(value.item() if isinstance(value, np.generic) else value).split()), 60)


def weight_faults(weight: Array) -> tuple[float, float]:
    """Asymmetry of a square matrix, beside its largest entry, and its least eigenvalue at a unit diagonal."""
    size = max(float(np.abs(weight).max(initial=0.0)), np.finfo(float).tiny)
    # congruence with the diagonal keeps the test meaningful for entries of very different size
    d = np.sqrt(np.abs(np.diag(weight)))
    d[d == 0] = np.sqrt(size)
    smallest = np.linalg.eigvalsh((weight + weight.T) / 2 / d / d[:, None]).min(initial=0.0)
    return float(np.abs(weight - weight.T).max(initial=0.0)) / size, float(smallest)


def brief(text: str, most: int = 120) -> str:
    """`text` cut to `most` characters."""
    return text if len(text) <= most else text[: most - 1] + "…"


def as_floats(argument: str, value: Any, *, expected: str = "an array of real numbers") -> Array:
    """New C-contiguous float64 array of `value`; only real numbers are accepted."""
    if type(value) is np.ndarray and value.dtype == np.float64:  # the common case, in every step of a simulation
        return np.array(value, order="C")
    if _holds_truth(value):
        raise InputError(argument, shown(value), f"{expected}, not True or False")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            array = np.asarray(value)
            real = array.dtype.kind == "O" and all(isinstance(v, numbers.Real) for v in array.flat)
            if real or array.dtype.kind in "iuf":
                return np.array(array, dtype=np.float64, order="C")
    except Exception:  # ragged, beyond double precision, or whatever the object raises when it is read as an array
        pass
    complex_ = isinstance(value, np.ndarray) and value.dtype.kind == "c"
    raise InputError(argument, "complex numbers" if complex_ else shown(value), expected)


def _holds_truth(value: Any) -> bool:
    """Whether a number, an array or a list holds a True or False."""
    if isinstance(value, np.ndarray | np.generic):
        return value.dtype.kind == "b" or (value.dtype.kind == "O" and any(map(_holds_truth, value.flat)))
    return isinstance(value, bool) or (isinstance(value, list | tuple) and any(map(_holds_truth, value)))


def check_finite(array: Array, name: str) -> None:
    """Raise an `InputError` where `array` holds NaN or infinity."""
    if not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise InputError(name, f"{array[index]} at index {index}", "finite numbers")


def frozen(value: T) -> T:
    """`value`, read-only if it is an array."""
    if isinstance(value, np.ndarray):
        value.setflags(write=False)
    return value


def array_fields(kind: type) -> dict[str, type]:
    """Names of a dataclass's fields that are arrays, and the types of their entries."""
    return {field.name: KINDS[field.type] for field in fields(kind) if field.type in KINDS}


@dataclass(frozen=True, eq=False, repr=False)
class Immutable:
    """Dataclass whose arrays are read-only copies, also once it is unpickled; what it has cached is not pickled."""

    def __post_init__(self) -> None:
        for name, kind in array_fields(type(self)).items():
            value = getattr(self, name)
            array = as_floats(name, value) if kind is float else np.array(value, dtype=kind, order="C")
            self._set(**{name: array})

    def _set(self, **values: Any) -> None:
        """Store checked values, arrays read-only, before the object is complete."""
        for name, value in values.items():
            object.__setattr__(self, name, frozen(value))

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._set(**state)


def as_number(argument: str, value: Any, *, expected: str = "a finite number", low: float = -math.inf,
              high: float = math.inf, strict: bool = False) -> float:  # fmt: skip
    """Finite number between `low` and `high`; `strict` excludes both ends."""
    real = isinstance(value, numbers.Real) and not isinstance(value, bool | np.bool_)
    number = math.nan
    with contextlib.suppress(OverflowError):  # of an int beyond doubles
        number = float(value) if real else math.nan
    inside = low < number < high if strict else low <= number <= high
    if not (math.isfinite(number) and inside):
        raise InputError(argument, shown(value), expected)
    return number


def as_count(argument: str, value: Any, *, least: int = 1, most: float = math.inf) -> int:
    """Whole number from `least` to `most`; floats are refused."""
    whole = isinstance(value, numbers.Integral) and not isinstance(value, bool | np.bool_)
    if not whole or not least <= int(value) <= most:
        floating = isinstance(value, float | np.floating) and float(value).is_integer() and value >= least
        cure = f"Pass the int {int(value)}." if floating else ""
        end = f" and at most {most}" if whole and value > most else ""
        raise InputError(argument, shown(value), f"a whole number, at least {least}{end}", cure)
    return int(value)


def as_instance(argument: str, value: Any, kind: type | tuple[type, ...], expected: str, cure: str = "") -> Any:
    """`value`, if it is of that kind."""
    if not isinstance(value, kind):
        raise InputError(argument, shown(value), expected, cure)
    return value


def as_generator(argument: str, value: Any) -> np.random.Generator:
    """NumPy generator; a seed is refused."""
    if not isinstance(value, np.random.Generator):
        seed = value if isinstance(value, int) and not isinstance(value, bool) and value >= 0 else 0
        cure = f"Pass {argument}=np.random.default_rng({seed})."
        raise InputError(argument, shown(value), "a numpy.random.Generator", cure)
    return value
