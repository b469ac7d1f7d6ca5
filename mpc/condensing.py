"""Condensed QP of an MPC problem, affine in ξ = (θ, z)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import block_diag

from mpc.checks import Array
from mpc.exceptions import InputError, NotConvexError
from mpc.feedback import block_lengths, stabilising_feedback
from mpc.parametric_qp import Constraint, ParametricQP
from mpc.problem import MPCProblem
from mpc.tolerances import DEFINITE, MOST_MATRIX_ENTRIES


def condense(problem: MPCProblem, parameters: tuple[str, ...] = ()) -> ParametricQP:
    """QP of `problem` in the inputs, states eliminated.

    For unstable plants over long horizons the free variable is v = u + K x instead of u, see `stabilising_feedback`.

    Parameters
    ----------
    problem : MPCProblem
        The statement.
    parameters : tuple of str
        What besides the state is left open: "u_prev", "x_ref", "u_ref", "w".

    Raises
    ------
    InputError
        An unknown parameter.
    NotConvexError
        The condensed Hessian is not positive definite.
    """
    layout = _Layout(problem, _sizes(problem, parameters))
    if problem.horizon * problem.nx * layout.nv + layout.nv**2 > MOST_MATRIX_ENTRIES:
        raise InputError(
            "horizon", problem.horizon, f"matrices of at most {MOST_MATRIX_ENTRIES:.0e} numbers",
            'Shorten it, block moves, or keep the states with solver="osqp".',
        )  # fmt: skip
    nt = layout.nt
    nv = layout.nv
    at = layout.at
    U, X = _predict(problem, layout)
    W = _cost(problem, U, X, at, nv)
    rows, w, labels = constraints_of(problem, U, X, at)
    H = 2 * W[nt:, nt:]
    f = np.zeros(nv - nt)
    if problem.soft is not None:
        rows, w, labels, H, f = soften(problem, rows, w, labels, H)
    _check_convex(H)
    slack = len(H) - (nv - nt)
    (Lt, Lz), (Xt, Xz) = (np.split(form.reshape(-1, nv), [nt], axis=1) for form in (U, X))
    return ParametricQP(
        H=H, F=np.vstack([2 * W[nt:, :nt], np.zeros((slack, nt))]), f=f, Y=2 * W[:nt, :nt], y=np.zeros(nt), c=0.0,
        G=rows[:, nt:], w=w, S=-rows[:, :nt],
        Lz=np.hstack([Lz, np.zeros((len(Lz), slack))]), Lt=Lt, l=np.zeros(len(Lz)),
        Xz=np.hstack([Xz, np.zeros((len(Xz), slack))]), Xt=Xt, x=np.zeros(len(Xz)),
        nu=problem.nu, parameters=tuple(layout.sizes.items()), labels=tuple(labels),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Layout:
    """Places of the parameters in ξ = (θ, z), one input per block."""

    problem: MPCProblem
    sizes: dict[str, int]
    at: dict[str, slice] = field(init=False)
    nt: int = field(init=False)
    nv: int = field(init=False)

    def __post_init__(self) -> None:
        ends = np.cumsum([0, *self.sizes.values()])
        at = {name: slice(int(a), int(b)) for name, a, b in zip(self.sizes, ends[:-1], ends[1:])}
        object.__setattr__(self, "at", at)
        object.__setattr__(self, "nt", int(ends[-1]))
        object.__setattr__(self, "nv", int(ends[-1]) + len(block_lengths(self.problem)) * self.problem.nu)


def _sizes(problem: MPCProblem, parameters: tuple[str, ...]) -> dict[str, int]:
    """Name and length of each parameter, the state first."""
    known = {name: rows * columns for name, (rows, columns) in problem.signal_shapes.items()}
    if problem.rate_limit is not None:
        parameters = ("u_prev", *(p for p in parameters if p != "u_prev"))
    for name in parameters:
        if name not in known:
            raise InputError("parameters", f"unknown parameter {name!r}", f"some of {sorted(known)}")
    return {"x": problem.nx, **{name: known[name] for name in parameters}}


def _predict(problem: MPCProblem, layout: _Layout) -> tuple[Array, Array]:
    """Inputs (N, nu, nv) and states (N + 1, nx, nv) as matrices on ξ."""
    N = problem.horizon
    nx = problem.nx
    nu = problem.nu
    nv = layout.nv
    U = np.zeros((N, nu, nv))
    X = np.zeros((N + 1, nx, nv))
    X[0, :, layout.at["x"]] = np.eye(nx)
    feedback = stabilising_feedback(problem)
    block_of = np.repeat(np.arange(len(block_lengths(problem))), block_lengths(problem))
    for k, b in enumerate(block_of):
        if k and b == block_of[k - 1]:
            U[k] = U[k - 1]
        else:
            column = layout.nt + b * nu
            U[k, :, column : column + nu] = np.eye(nu)
            if feedback is not None:
                U[k] -= feedback[b] @ X[k]
        X[k + 1] = problem.A @ X[k] + problem.B @ U[k]
        if "w" in layout.at:
            start = layout.at["w"].start + k * problem.nw
            X[k + 1, :, start : start + problem.nw] += problem.E
    return U, X


def _cost(problem: MPCProblem, U: Array, X: Array, at: dict[str, slice], nv: int) -> Array:
    """Matrix W of the quadratic cost ξ'Wξ."""
    N = problem.horizon
    error = X.copy()
    effort = U.copy()
    if "x_ref" in at:
        error[:, :, at["x_ref"]] -= np.eye((N + 1) * problem.nx).reshape(N + 1, problem.nx, -1)
    if "u_ref" in at:
        effort[:, :, at["u_ref"]] -= np.eye(N * problem.nu).reshape(N, problem.nu, -1)
    W = np.zeros((nv, nv))
    for k in range(N):
        W += error[k].T @ problem.Q @ error[k] + effort[k].T @ problem.R @ effort[k]
        if problem.S is not None:
            cross = error[k].T @ problem.S @ effort[k]
            W += cross + cross.T
    W += error[N].T @ problem.P @ error[N]
    return (W + W.T) / 2


def constraints_of(
    problem: MPCProblem, U: Array, X: Array, at: dict[str, slice]
) -> tuple[Array, Array, list[Constraint]]:
    """Rows (m, nv) with rows ξ <= w, and their labels."""
    nv = U.shape[-1]
    rows = [np.zeros((0, nv))]
    bounds = [np.zeros(0)]
    labels: list[Constraint] = []

    def impose(kind: str, step: int, halfspaces: tuple[Array, Array], form: Array) -> None:
        """Append the rows H (form ξ) <= h of one step."""
        H, h = halfspaces
        rows.append(H @ form)
        bounds.append(h)
        labels.extend(Constraint(kind, step, i) for i in range(len(h)))

    for k in range(problem.horizon):
        impose("input", k, problem.input_rows, U[k])
        if problem.rate_limit is not None:
            before = U[k - 1] if k else np.zeros_like(U[0])
            if k == 0:
                before[:, at["u_prev"]] = np.eye(problem.nu)
            both = np.vstack([np.eye(problem.nu), -np.eye(problem.nu)])
            impose("rate", k, (both, np.tile(problem.rate_limit, 2)), U[k] - before)
        impose("state", k + 1, problem.state_rows, X[k + 1])
    impose("terminal", problem.horizon, problem.terminal_rows, X[problem.horizon])
    return np.vstack(rows), np.concatenate(bounds), labels


def row_units(problem: MPCProblem, labels: list[Constraint] | tuple[Constraint, ...]) -> Array:
    """Unit of each row for comparing violations; 1 for a slack."""
    units = problem.row_units
    return np.array([units[label.kind][label.row] if label.kind in units else 1.0 for label in labels])


def soften(
    problem: MPCProblem, rows: Array, w: Array, labels: list[Constraint], H: Array
) -> tuple[Array, Array, list[Constraint], Array, Array]:
    """One slack per step, priced linear * s + quadratic * s²."""
    assert problem.soft is not None
    linear, quadratic = problem.soft
    N = problem.horizon
    columns = np.zeros((len(rows), N))
    for i, label in enumerate(labels):
        if label.kind in ("state", "terminal"):
            columns[i, label.step - 1] = -problem.price_units[label.kind][label.row]
    nonnegative = np.hstack([np.zeros((N, rows.shape[1])), -np.eye(N)])
    rows = np.vstack([np.hstack([rows, columns]), nonnegative])
    labels = labels + [Constraint("slack", k + 1, 0) for k in range(N)]
    f = np.concatenate([np.zeros(len(H)), np.full(N, linear)])
    return rows, np.concatenate([w, np.zeros(N)]), labels, block_diag(H, 2 * quadratic * np.eye(N)), f


def _check_convex(H: Array) -> None:
    """Raise where the scaled Hessian is not positive definite."""
    d = np.sqrt(np.abs(np.diag(H)))
    scaled = H / d / d[:, None] if d.all() and np.isfinite(H).all() else None
    smallest = -np.inf if scaled is None else float(np.linalg.eigvalsh(scaled)[0])
    if smallest < DEFINITE:
        raise NotConvexError(
            f"the condensed Hessian is not positive definite: got a scaled smallest eigenvalue of {smallest:.3g}, "
            f"expected > {DEFINITE:.0e}; some input is free of cost. Make R positive definite, or let Q and P see "
            "every input.",
            "Hessian",
            smallest,
        )
