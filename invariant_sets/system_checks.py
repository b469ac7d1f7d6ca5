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
        raise InputError(f"A has shape {A.shape}, expected a square matrix (nx, nx).")
    return A


def checked_input_matrix(B: Any, nx: int) -> Array:
    """Return B (nx, nu), or raise `InputError`."""
    B = as_matrix(B, "B", rows=nx)
    if B.shape[1] == 0:
        raise InputError(f"B has shape {B.shape}, expected at least one column; use a zero column for no input.")
    return B


def checked_disturbance(E: Any, W: Any, nx: int) -> Array | None:
    """Return E (nx, nw), the identity if only W is given, None if neither is; or raise `InputError`."""
    if W is None:
        if E is not None:
            raise InputError("E is given without W; give the disturbance set W too.")
        return None
    E = np.eye(nx) if E is None else as_matrix(E, "E", rows=nx)
    check_set(W, "W", E.shape[1])
    if W.is_empty or not W.is_bounded:
        raise InputError(f"W is {'empty' if W.is_empty else 'unbounded'}, expected a bounded, nonempty set.")
    return E


def checked_system(A: Any, B: Any, X: Any, U: Any, E: Any, W: Any, *,
                   state_set: str = "X") -> tuple[Array, Array, Array | None]:
    """Return A, B and E as arrays, or raise `InputError` where shapes, types or numbers do not fit."""
    A = checked_state_matrix(A)
    B = checked_input_matrix(B, len(A))
    check_set(X, state_set, len(A))
    check_set(U, "U", B.shape[1])
    return A, B, checked_disturbance(E, W, len(A))


def check_set(value: Any, name: str, dim: int) -> None:
    """Raise `InputError` unless `value` is a `Polytope` of dimension `dim`."""
    if not isinstance(value, Polytope):
        raise InputError(f"{name} must be a Polytope, got {type(value).__name__}.")
    if value.dim != dim:
        raise InputError(f"{name} has dimension {value.dim}, expected {dim}.")
