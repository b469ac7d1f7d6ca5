"""Checks of numbers at every package's public door; Booleans are no numbers."""

from __future__ import annotations

import contextlib
import math
import numbers
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from difflib import get_close_matches
from itertools import repeat
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ccdtools_ground.errors import InputError, NotConvexError
from ccdtools_ground.tolerances import WEIGHT_ROUNDING

Array = np.ndarray
T = TypeVar("T")
_OUTPUTS = "Outputs y = Cx + Du with a weight W ⪰ 0 have Q = C'WC, S = C'WD and R = D'WD."
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


def as_finite(argument: str, array: Array) -> Array:
    """`array`, if all of it is finite."""
    if not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise InputError(argument, f"{array[index]}{f' at index {index}' if index else ''}", "finite numbers")
    return array


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


def as_array(argument: str, value: Any, *shapes: tuple[int | str | None, ...]) -> Array:
    """Read-only float64 array of finite numbers in one of `shapes`; words match any length ≥ 1, None any length."""
    wanted = " or ".join(map(_shape_text, shapes))
    array = as_floats(argument, value, expected=f"numbers of shape {wanted}" if shapes else "numbers")
    if shapes and not any(map(_fits, repeat(array.shape), shapes)):
        raise InputError(argument, f"shape {array.shape}", wanted)
    return frozen(as_finite(argument, array))


def as_vector(argument: str, value: Any, size: int | None = None, *, of: str = "") -> Array:
    """Read-only vector of `size` finite numbers; a single number counts as one."""
    array = np.atleast_1d(as_floats(argument, value))
    if array.ndim != 1 or (size is not None and len(array) != size):
        one = f"{size} number{'' if size == 1 else 's'}" if size is not None else "a vector of numbers"
        raise InputError(argument, f"shape {array.shape}", one + (f", {of}" if of else ""))
    return frozen(as_finite(argument, array))


def as_weight(name: str, value: Any, size: int | None = None) -> Array:
    """Read-only semidefinite weight; a number or vector is its diagonal."""
    raw = as_floats(name, value)
    diagonal = np.full(size or 1, raw) if raw.ndim == 0 else raw
    full = np.diag(diagonal) if diagonal.ndim == 1 else diagonal
    n = max(len(full), 1) if size is None else size
    weight = as_array(name, full, (n, n))
    gap, smallest = weight_faults(weight)
    if gap > WEIGHT_ROUNDING:
        off = float(np.abs(weight - weight.T).max())
        got, cure = f"max |{name} - {name}'| = {off:.3g}", f"Pass ({name} + {name}')/2."
        raise NotConvexError(name, got, "a symmetric matrix", cure)
    if smallest < -WEIGHT_ROUNDING:
        got = f"a negative direction (scaled eigenvalue {smallest:.3g})"
        raise NotConvexError(name, got, f"{name} ⪰ 0", eigenvalue=smallest)
    return frozen((weight + weight.T) / 2)


def as_cross_weight(value: Any, Q: Array, R: Array) -> Array | None:
    """Read-only cross weight S (nx, nu) of 2 x'Su; None for None.

    Q and R are weights that `as_weight` has checked. [Q S; S' R] is positive semidefinite.
    """
    if value is None:
        return None
    S = as_array("S", value, (len(Q), len(R)))
    d = np.sqrt(np.abs(np.concatenate([np.diag(Q), np.diag(R)])))
    dx, du = np.split(d, [len(Q)])
    stray = (S != 0) & ((dx == 0)[:, None] | (du == 0))  # no scale says how small these would have to be
    if stray.any():
        i, j = (int(k) for k in np.argwhere(stray)[0])
        free = f"Q[{i}, {i}]" if dx[i] == 0 else f"R[{j}, {j}]"
        raise NotConvexError("S", f"{S[i, j]:.3g} at index {(i, j)} where {free} = 0", "[Q S; S' R] ⪰ 0", _OUTPUTS)
    d[d == 0] = np.inf
    smallest = float(np.linalg.eigvalsh(np.block([[Q, S], [S.T, R]]) / d / d[:, None])[0])
    if smallest < -WEIGHT_ROUNDING:
        got = f"a stage cost [Q S; S' R] with a negative direction (scaled eigenvalue {smallest:.3g})"
        raise NotConvexError("S", got, "[Q S; S' R] ⪰ 0", _OUTPUTS, smallest)
    return S


def as_pair(A: Any, B: Any) -> tuple[Array, Array]:
    """Arrays (A, B); A may be a discrete-time `control.StateSpace` without B."""
    if B is None:
        if not (hasattr(A, "A") and hasattr(A, "B")):
            raise InputError("B", "nothing", "A and B, or a discrete-time control.StateSpace in place of both")
        if not getattr(A, "dt", None):
            raise InputError("A", f"a StateSpace with dt = {getattr(A, 'dt', None)}", "a discrete-time system")
        B = A.B
        A = A.A
    A = as_array("A", A, (None, None))
    if A.shape[0] != A.shape[1] or A.shape[0] == 0:
        raise InputError("A", f"shape {A.shape}", "a square matrix")
    B = as_array("B", B, (A.shape[0], None))
    if B.shape[1] == 0:
        raise InputError("B", f"shape {B.shape}", "at least one input")
    return A, B


def as_number(argument: str, value: Any, *, expected: str = "a finite number", low: float = -math.inf,
              high: float = math.inf, strict: bool = False) -> float:  # fmt: skip
    """Finite number between `low` and `high`; `strict` excludes both ends."""
    value = value[()] if isinstance(value, np.ndarray) and value.ndim == 0 else value
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


def _fits(shape: tuple[int, ...], wanted: tuple[int | str | None, ...]) -> bool:
    """Whether a shape has the wanted lengths."""
    return len(shape) == len(wanted) and all(
        want is None or (length >= 1 if isinstance(want, str) else length == want)
        for length, want in zip(shape, wanted)
    )


def _shape_text(shape: tuple[int | str | None, ...]) -> str:
    """Shape as written in a docstring."""
    lengths = ", ".join(map(str, shape)).replace("None", "any")
    return f"({lengths},)" if len(shape) == 1 else f"({lengths})"


def as_record(argument: str, value: Any, size: int) -> Array:
    """Record (n, T, size), also of one run (T, size), or (T,) if size 1; NaN is kept."""
    array = as_floats(argument, value)
    array = array[:, None] if array.ndim == size == 1 else array
    array = array[None] if array.ndim == 2 else array
    if array.ndim != 3 or array.shape[2] != size or 0 in array.shape[:2]:
        raise InputError(argument, f"shape {array.shape}", _shape_text(("n", "T", size)))
    return array
