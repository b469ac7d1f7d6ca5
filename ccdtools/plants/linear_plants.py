"""Plants from matrices and from `python-control`."""

from __future__ import annotations

from typing import Any

import casadi as ca
from numpy.typing import ArrayLike

from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import NO_DESIGN, DesignSpace
from ccdtools.plants.linear_model import sampling_time, state_space_matrices
from ccdtools.plants.plant import Plant
from ccdtools.plants.symbols import as_expression
from ccdtools_ground.door import as_array, as_floats, shown

OPTIONS = ("continuous", "state_names", "input_names", "output_names", "output_limits", "substeps")  # of Plant


def plant_from_matrices(
    A: Any,
    B: Any,
    E: Any = None,
    *,
    dt: float,
    p: ca.SX | None = None,
    design: DesignSpace = NO_DESIGN,
    c: Any = None,
    C: Any = None,
    D: Any = None,
    **options: Any,
) -> Plant:
    """Plant with dynamics A(p) x + B(p) u + E(p) w + c(p) and linear outputs.

    Parameters
    ----------
    A, B, E : (nx, nx), (nx, nu) and (nx, nw)
        Arrays, or expressions in `p`. Without E there is no disturbance.
    dt : float
        Sampling time [s].
    p : casadi.SX (np, 1), optional
        The symbols of the design in the expressions.
    design : DesignSpace, optional
        Its box; none by default.
    c : (nx,), optional
        Constant term.
    C, D : (ny, nx) and (ny, nu), optional
        Outputs; D is 0 by default.
    **options
        `continuous`, `state_names`, `input_names`, `output_names`, `output_limits` and `substeps` of `Plant`.

    Raises
    ------
    InputError
        If the shapes disagree, or an expression has symbols that are not in `p`.
    """
    unknown = sorted(set(options) - set(OPTIONS))
    if unknown:
        raise InputError(unknown[0], shown(options[unknown[0]]), f"nothing of that name, but {', '.join(OPTIONS)}")
    A, B = _matrix("A", A), _matrix("B", B)
    nx = A.shape[0]
    if A.shape != (nx, nx):
        raise InputError("A", f"shape {A.shape}", "a square matrix (nx, nx)")
    E = ca.SX(nx, 0) if E is None else _matrix("E", E)
    offset = ca.SX.zeros(nx, 1) if c is None else _matrix("c", c)
    for name, M in (("B", B), ("E", E)):
        if M.shape[0] != nx:
            raise InputError(name, f"shape {M.shape}", f"{nx} rows, one per state")
    if offset.shape != (nx, 1):
        raise InputError("c", f"shape {offset.shape}", f"({nx},), one number per state")
    x, u, w = (ca.SX.sym(name, M.shape[1]) for name, M in (("x", A), ("u", B), ("w", E)))
    if C is None and D is not None:
        raise InputError("C", "nothing, beside D", "the matrix (ny, nx) of the outputs")
    outputs: Any = ()
    if C is not None:
        C = _matrix("C", C)
        D = ca.SX.zeros(C.shape[0], B.shape[1]) if D is None else _matrix("D", D)
        for name, M, shape in (("C", C, (C.shape[0], nx)), ("D", D, (C.shape[0], B.shape[1]))):
            if M.shape != shape:
                raise InputError(name, f"shape {M.shape}", f"{shape}")
        outputs = C @ x + D @ u
    symbols = ca.SX(0, 1) if p is None else p
    return Plant(x, u, w, symbols, A @ x + B @ u + E @ w + offset, design, dt, outputs=outputs, **options)


def plant_from_state_space(system: Any, *, dt: float | None = None, E: ArrayLike | None = None) -> Plant:
    """Plant of a `control.StateSpace`, without a design.

    Parameters
    ----------
    system : control.StateSpace
        Continuous together with `dt`, or discrete.
    dt : float, optional
        Sampling time [s] of a continuous system.
    E : (nx, nw) array_like, optional
        Disturbance matrix.

    Raises
    ------
    InputError
        If `system` is no state space, or a continuous one comes without a positive `dt`.
    """
    A, B = state_space_matrices(system)
    return plant_from_matrices(
        A, B, E, dt=sampling_time(system, dt), C=system.C, D=system.D, continuous=not system.dt,
        state_names=list(system.state_labels), input_names=list(system.input_labels),
        output_names=list(system.output_labels),
    )  # fmt: skip


def _matrix(name: str, value: Any) -> ca.SX:
    """Matrix of numbers or expressions; a vector is a column."""
    if isinstance(value, ca.SX | ca.DM):
        return as_expression(name, value)
    array = as_floats(name, value, expected="an array or a casadi.SX; stack expressions by vertcat and horzcat")
    array = as_array(name, array[:, None] if array.ndim == 1 else array, ("rows", "columns"))
    return ca.SX(ca.DM(array)) if array.size else ca.SX(*array.shape)
