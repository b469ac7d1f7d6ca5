"""The checks that every function of a linear system and its sets shares."""

from __future__ import annotations

from typing import Any

import numpy as np

from invariant_sets.exceptions import InputError
from invariant_sets.polytope import Polytope
from invariant_sets.validation import as_matrix

Array = np.ndarray


def checked_state_matrix(A: Any) -> Array:
    """Return the square matrix A (nx, nx), or raise `InputError`."""
    A = as_matrix(A, "A")
    if A.shape[0] != A.shape[1] or A.shape[0] == 0:
        raise InputError("A", f"shape {A.shape}", "a square matrix (nx, nx)")
    return A


def checked_input_matrix(B: Any, nx: int) -> Array:
    """Return B (nx, nu), or raise `InputError`."""
    B = as_matrix(B, "B", rows=nx)
    if B.shape[1] == 0:
        raise InputError("B", f"shape {B.shape}", "at least one column", "Use a zero column for no input.")
    return B


def checked_disturbance(E: Any, W: Any, nx: int) -> Array | None:
    """Return E (nx, nw), the identity if only W is given, None if neither is; or raise `InputError`."""
    if W is None:
        if E is not None:
            raise InputError("E", "a matrix without W", "both or neither", "Give the disturbance set W too.")
        return None
    E = np.eye(nx) if E is None else as_matrix(E, "E", rows=nx)
    check_set(W, "W", E.shape[1])
    if W.is_empty or not W.is_bounded:
        raise InputError("W", "an empty set" if W.is_empty else "an unbounded set", "a bounded, nonempty set")
    return E


def checked_system(A: Any, B: Any, X: Any, U: Any, E: Any, W: Any, *,
                   state_set: str = "X") -> tuple[Array, Array, Array | None]:
    """Return A, B and E as arrays, or raise `InputError` where shapes, types or numbers do not fit."""
    A = checked_state_matrix(A)
    B = checked_input_matrix(B, len(A))
    check_set(X, state_set, len(A))
    check_set(U, "U", B.shape[1])
    return A, B, checked_disturbance(E, W, len(A))


def disturbance_vertices(E: Array | None, W: Polytope | None) -> Array | None:
    """Return the vertices (k, nx) of E W, None without a disturbance."""
    return None if E is None or W is None else W.vertices @ E.T


def check_set(value: Any, name: str, dim: int) -> None:
    """Raise `InputError` unless `value` is a `Polytope` of dimension `dim`."""
    if not isinstance(value, Polytope):
        raise InputError(name, type(value).__name__, "a Polytope")
    if value.dim != dim:
        raise InputError(name, f"a set of dimension {value.dim}", f"dimension {dim}")
