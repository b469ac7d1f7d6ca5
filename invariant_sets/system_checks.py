"""Linear systems and their sets, checked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from invariant_sets.exceptions import InputError
from invariant_sets.polytope import Polytope
from invariant_sets.validation import as_floats, as_matrix, shown

Array = np.ndarray
Set = Polytope | tuple[Any, Any]  # a polytope, or bounds (lower, upper): numbers, or one number a coordinate


@dataclass(frozen=True)
class LinearSystem:
    """System x⁺ = A x + B u + w; `disturbances` are vertices, or None."""

    A: Array
    B: Array
    disturbances: Array | None = None


def checked_state_matrix(A: Any) -> Array:
    """Square matrix A (nx, nx), or raise `InputError`."""
    matrix = as_matrix(A, "A")
    if matrix.shape[0] != matrix.shape[1] or matrix.shape[0] == 0:
        raise InputError("A", f"shape {matrix.shape}", "a square matrix (nx, nx)")
    return matrix


def checked_disturbance(E: Any, W: Any, nx: int) -> tuple[Array, Polytope] | tuple[None, None]:
    """E (nx, nw), by default the identity, and W, or Nones."""
    if W is None:
        if E is not None:
            raise InputError("E", "a matrix without W", "both or neither", "Give the disturbance set W too.")
        return None, None
    E = np.eye(nx) if E is None else as_matrix(E, "E", rows=nx)
    W = as_set(W, "W", E.shape[1])
    if W.is_empty or not W.is_bounded:
        raise InputError("W", "an empty set" if W.is_empty else "an unbounded set", "a bounded, nonempty set")
    return E, W


def disturbance_vertices(E: Any, W: Any, nx: int) -> Array | None:
    """Vertices (k, nx) of E W, None without a disturbance."""
    E, W = checked_disturbance(E, W, nx)
    return None if W is None else W.vertices @ E.T


def checked_system(
    A: Any, B: Any, states: Any, U: Any, E: Any, W: Any, *, name: str = "X"
) -> tuple[LinearSystem, Polytope, Polytope]:
    """System x⁺ = A x + B u + w with w in E W, its set of states and U, or raise `InputError`.

    `states` are what the caller means by them: constraints X, a start, or a set S to stay in.
    """
    A = checked_state_matrix(A)
    B = as_matrix(B, "B", rows=len(A))
    if B.shape[1] == 0:
        raise InputError("B", f"shape {B.shape}", "at least one column", "Use a zero column for no input.")
    states = as_set(states, name, len(A))
    U = as_set(U, "U", B.shape[1])
    return LinearSystem(A, B, disturbance_vertices(E, W, len(A))), states, U


def as_set(value: Any, name: str, dim: int | None = None) -> Polytope:
    """`Polytope` of dimension `dim` (any if None), or raise `InputError`.

    Bounds (lower, upper), each a number or one number a coordinate, become a box; a number holds for every coordinate.
    """
    if isinstance(value, (tuple, list)) and len(value) == 2:
        return _box(value, name, dim)
    if not isinstance(value, Polytope):
        got = shown(value) if isinstance(value, (tuple, list, int, float)) else type(value).__name__
        raise InputError(name, got, "a Polytope or bounds (lower, upper)")
    if dim is not None and value.dim != dim:
        raise InputError(name, f"a set of dimension {value.dim}", f"dimension {dim}")
    return value


def as_set_or_numbers(value: Any, name: str) -> Set:
    """`Polytope`, or two numbers that hold for every coordinate.

    Raises `InputError` for whatever is no set in any dimension.
    """
    box = as_set(value, name)
    open_ = not isinstance(value, Polytope) and all(np.ndim(side) == 0 for side in value)
    return (float(value[0]), float(value[1])) if open_ else box


def _box(value: Any, name: str, dim: int | None) -> Polytope:
    """Box of two bounds; errors name the set and the side."""
    sides = [as_floats(f"{name}[{i}]", side) for i, side in enumerate(value)]
    n = max(side.size for side in sides) if dim is None else dim
    for i, side in enumerate(sides):
        if side.ndim > 1 or side.size not in (1, n):
            raise InputError(f"{name}[{i}]", f"shape {side.shape}", f"a number or {n} numbers" if n > 1 else "a number")
    try:
        return Polytope.from_bounds(*(np.broadcast_to(side, (n,)) for side in sides))
    except InputError as error:
        which = 0 if error.argument == "lower" else 1
        raise InputError(f"{name}[{which}]", error.got, error.expected, error.cure) from None
