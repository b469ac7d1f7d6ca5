"""A, B and E of a model as functions of the design, with their derivatives."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.exceptions import InputError


def evaluated(function: ca.Function, p: Array, nu: int) -> tuple[Array, Array, Array]:
    """A (nx, nx), B (nx, nu) and E (nx, nw) of p → [A B E] at a design (np,), or stacked for designs (n, np).

    Raises
    ------
    InputError
        If one of them is not finite.
    """
    stacked = np.asarray(function(np.atleast_2d(p).T), dtype=float)
    if not np.isfinite(stacked).all():
        where = f"a design at which the model is not finite: {p.tolist()}"
        raise InputError("design", where, "one where A, B and E are finite", "Leave it out of the design bounds.")
    nx, columns = function.size_out(0)
    matrices = np.ascontiguousarray(stacked.reshape(nx, -1, columns).transpose(1, 0, 2))
    M = matrices if p.ndim == 2 else matrices[0]
    parts = (M[..., :nx], M[..., nx : nx + nu], M[..., nx + nu :])
    A, B, E = (np.ascontiguousarray(part) for part in parts)
    return A, B, E


def derivative(function: ca.Function) -> ca.Function:
    """p → ∂vec[A B E]/∂p of p → [A B E], vec by columns."""
    kind: Any = ca.SX if function.is_a("SXFunction") else ca.MX
    p = kind.sym("p", *function.size_in(0))
    return ca.Function("jacobian", [p], [ca.densify(ca.jacobian(ca.vec(function(p)), p))])


def derivatives_at(jacobian: ca.Function, p: Array, nx: int, nu: int) -> tuple[Array, Array, Array]:
    """∂A/∂p (nx, nx, np), ∂B/∂p (nx, nu, np) and ∂E/∂p (nx, nw, np), of p → ∂vec[A B E]/∂p at a design (np,)."""
    T = np.asarray(jacobian(p), dtype=float).reshape(-1, nx, len(p)).transpose(1, 0, 2)
    return T[:, :nx], T[:, nx : nx + nu], T[:, nx + nu :]
