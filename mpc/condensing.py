"""From a linear MPC to its QP: every input and state is affine in ξ = (θ, z), so cost and constraints follow."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import block_diag

from mpc.checks import Array
from mpc.exceptions import InputError, NotConvexError
from mpc.parametric_qp import Constraint, ParametricQP

if TYPE_CHECKING:
    from mpc.linear_mpc import LinearMPC

_GROWTH = 1e3  # growth of A^k over the horizon above which the free variable is the deviation from an LQR


def condense(mpc: LinearMPC, parameters: tuple[str, ...]) -> ParametricQP:
    """QP of `mpc` in the free inputs, with the states eliminated.

    For unstable plants over long horizons the free variable is v_k = u_k + K x_k instead of u_k, which keeps the
    Hessian well conditioned (Rossiter, Kouvaritakis and Rice, Automatica 34(1), 1998); the problem is the same.

    Parameters
    ----------
    mpc : LinearMPC
        The controller.
    parameters : tuple of str
        What besides the state is left open: "u_prev", "x_ref", "u_ref", "w".

    Raises
    ------
    NotConvexError
        The condensed Hessian is not positive definite.
    """
    sizes = _sizes(mpc, parameters)
    nt = sum(sizes.values())
    free = _blocking(mpc)
    at, column = {}, 0
    for name, size in sizes.items():
        at[name] = slice(column, column + size)
        column += size
    nv = nt + free.shape[1]
    U, X = _predict(mpc, free, at, nt)
    W = _cost(mpc, U, X, at, nv)
    rows, w, labels = _constraints(mpc, U, X, at)
    H, f = 2 * W[nt:, nt:], np.zeros(nv - nt)
    if mpc.soft is not None:
        rows, w, labels, H, f = _soften(mpc, rows, w, labels, H)
    _check_convex(H)
    slack = len(H) - free.shape[1]
    (Lt, Lz), (Xt, Xz) = (np.split(form.reshape(-1, nv), [nt], axis=1) for form in (U, X))
    return ParametricQP(
        H=H, F=np.vstack([2 * W[nt:, :nt], np.zeros((slack, nt))]), f=f, Y=2 * W[:nt, :nt], y=np.zeros(nt), c=0.0,
        G=rows[:, nt:], w=w, S=-rows[:, :nt],
        Lz=np.hstack([Lz, np.zeros((len(Lz), slack))]), Lt=Lt, l=np.zeros(len(Lz)),
        Xz=np.hstack([Xz, np.zeros((len(Xz), slack))]), Xt=Xt, x=np.zeros(len(Xz)),
        nu=mpc.nu, parameters=tuple(sizes.items()), labels=tuple(labels),
    )  # fmt: skip


def _sizes(mpc: LinearMPC, parameters: tuple[str, ...]) -> dict[str, int]:
    known = {"u_prev": mpc.nu, "x_ref": (mpc.horizon + 1) * mpc.nx, "u_ref": mpc.horizon * mpc.nu}
    if mpc.E is not None:
        known["w"] = mpc.horizon * mpc.E.shape[1]
    if mpc.rate_limit is not None:
        parameters = ("u_prev", *(p for p in parameters if p != "u_prev"))
    for name in parameters:
        if name not in known:
            raise InputError(f"unknown parameter {name!r}, expected some of {sorted(known)}.")
    return {"x": mpc.nx, **{name: known[name] for name in parameters}}


def _blocking(mpc: LinearMPC) -> Array:
    """Map from the free inputs to all inputs: blocks of equal moves share a column."""
    lengths = mpc.blocks if mpc.blocks is not None else (1,) * mpc.horizon
    pattern = np.repeat(np.eye(len(lengths)), lengths, axis=0)
    return np.asarray(np.kron(pattern, np.eye(mpc.nu)), dtype=np.float64)


def _predict(mpc: LinearMPC, free: Array, at: dict[str, slice], nt: int) -> tuple[Array, Array]:
    """Inputs (N, nu, nv) and states (N + 1, nx, nv) as matrices acting on ξ."""
    N, nx, nu, nv = mpc.horizon, mpc.nx, mpc.nu, nt + free.shape[1]
    U, X = np.zeros((N, nu, nv)), np.zeros((N + 1, nx, nv))
    U[:, :, nt:] = free.reshape(N, nu, -1)
    X[0, :, at["x"]] = np.eye(nx)
    K = _prestabilising_gain(mpc)
    for k in range(N):
        if K is not None:
            U[k] -= K @ X[k]
        X[k + 1] = mpc.A @ X[k] + mpc.B @ U[k]
        if "w" in at and mpc.E is not None:
            nw = mpc.E.shape[1]
            start = at["w"].start + k * nw
            X[k + 1, :, start : start + nw] += mpc.E
    return U, X


def _prestabilising_gain(mpc: LinearMPC) -> Array | None:
    if mpc.blocks is not None:  # blocks of u are not blocks of v
        return None
    radius = float(np.abs(np.linalg.eigvals(mpc.A)).max())
    return mpc.gain if mpc.horizon * np.log(max(radius, 1.0)) > np.log(_GROWTH) else None


def _cost(mpc: LinearMPC, U: Array, X: Array, at: dict[str, slice], nv: int) -> Array:
    """Matrix W of the cost ξ'Wξ = Σ e'Qe + d'Rd + e_N'Pe_N."""
    N = mpc.horizon
    error, effort = X.copy(), U.copy()
    if "x_ref" in at:
        error[:, :, at["x_ref"]] -= np.eye((N + 1) * mpc.nx).reshape(N + 1, mpc.nx, -1)
    if "u_ref" in at:
        effort[:, :, at["u_ref"]] -= np.eye(N * mpc.nu).reshape(N, mpc.nu, -1)
    W = np.zeros((nv, nv))
    for k in range(N):
        W += error[k].T @ mpc.Q @ error[k] + effort[k].T @ mpc.R @ effort[k]
    W += error[N].T @ mpc.P @ error[N]
    return (W + W.T) / 2


def _constraints(
    mpc: LinearMPC, U: Array, X: Array, at: dict[str, slice]
) -> tuple[Array, Array, list[Constraint]]:
    """Rows (m, nv) with rows ξ <= w, and their labels."""
    nv = U.shape[-1]
    rows, bounds = [np.zeros((0, nv))], [np.zeros(0)]
    labels: list[Constraint] = []

    def impose(kind: str, step: int, halfspaces: tuple[Array, Array], form: Array) -> None:
        H, h = halfspaces
        rows.append(H @ form)
        bounds.append(h)
        labels.extend(Constraint(kind, step, i) for i in range(len(h)))

    for k in range(mpc.horizon):
        impose("input", k, mpc.input_rows, U[k])
        if mpc.rate_limit is not None:
            before = U[k - 1] if k else np.zeros_like(U[0])
            if k == 0:
                before[:, at["u_prev"]] = np.eye(mpc.nu)
            both = np.vstack([np.eye(mpc.nu), -np.eye(mpc.nu)])
            impose("rate", k, (both, np.tile(mpc.rate_limit, 2)), U[k] - before)
        impose("state", k + 1, mpc.state_rows, X[k + 1])
    impose("terminal", mpc.horizon, mpc.terminal_rows, X[mpc.horizon])
    return np.vstack(rows), np.concatenate(bounds), labels


def state_units(mpc: LinearMPC, labels: list[Constraint] | tuple[Constraint, ...]) -> Array:
    """Size of each row's bound, the unit in which violations of different rows are compared."""
    bounds = {"state": mpc.state_rows[1], "terminal": mpc.terminal_rows[1], "input": mpc.input_rows[1]}
    if mpc.rate_limit is not None:
        bounds["rate"] = np.tile(mpc.rate_limit, 2)
    units = []
    for label in labels:
        if label.kind not in bounds:
            units.append(1.0)
            continue
        h = np.abs(bounds[label.kind])
        units.append(float(h[label.row] or h.max() or 1.0))
    return np.array(units)


def _soften(
    mpc: LinearMPC, rows: Array, w: Array, labels: list[Constraint], H: Array
) -> tuple[Array, Array, list[Constraint], Array, Array]:
    """One slack per step, in units of the bounds, with the cost linear * s + quadratic * s²."""
    assert mpc.soft is not None
    linear, quadratic = mpc.soft
    N = mpc.horizon
    columns = np.zeros((len(rows), N))
    for i, (label, unit) in enumerate(zip(labels, state_units(mpc, labels))):
        if label.kind in ("state", "terminal"):
            columns[i, label.step - 1] = -unit
    nonnegative = np.hstack([np.zeros((N, rows.shape[1])), -np.eye(N)])
    rows = np.vstack([np.hstack([rows, columns]), nonnegative])
    labels = labels + [Constraint("slack", k + 1, 0) for k in range(N)]
    f = np.concatenate([np.zeros(len(H)), np.full(N, linear)])
    return rows, np.concatenate([w, np.zeros(N)]), labels, block_diag(H, 2 * quadratic * np.eye(N)), f


def _check_convex(H: Array) -> None:
    d = np.sqrt(np.abs(np.diag(H)))
    scaled = H / np.outer(d, d) if d.all() and np.isfinite(H).all() else None
    smallest = -np.inf if scaled is None else float(np.linalg.eigvalsh(scaled)[0])
    if smallest < 1e-13:
        raise NotConvexError(
            f"the condensed Hessian is not positive definite (scaled smallest eigenvalue {smallest:.3g}, expected "
            "> 1e-13): some input is free of cost. Make R positive definite, or Q and P see every input; an unstable "
            "plant with move blocking needs a shorter horizon."
        )
