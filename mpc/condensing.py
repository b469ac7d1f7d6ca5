"""Condensed QP of an MPC problem, affine in ξ = (θ, z)."""

from __future__ import annotations

import numpy as np

from mpc.budgets import MOST_MATRIX_ENTRIES
from mpc.checks import Array
from mpc.exceptions import InputError, NotConvexError
from mpc.feedback import along_horizon, block_lengths, stabilising_feedback
from mpc.parametric_qp import Constraint, ParametricQP, places
from mpc.problem import MPCProblem
from mpc.tolerances import ROUNDED_SUM


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
    sizes = _sizes(problem, parameters)
    at = places({**sizes, "z": len(block_lengths(problem)) * problem.nu, "s": number_of_slacks(problem)})
    nt, nv = at["z"].start, at["z"].stop
    N = problem.horizon
    if N * problem.nx * nv + nv**2 > MOST_MATRIX_ENTRIES:
        raise InputError(
            "horizon", N, f"matrices of at most {MOST_MATRIX_ENTRIES:.0e} numbers",
            'Shorten it, block moves, or keep the states with solver="osqp".',
        )  # fmt: skip
    driven = np.broadcast_to(0.0, (N, problem.nx, at["s"].stop))
    if "w" in at:
        driven = np.zeros(driven.shape)
        for k, push in enumerate(driven):
            push[:, at["w"]][:, k * problem.nw : (k + 1) * problem.nw] = problem.E
    U, X = predict(problem, *along_horizon(problem), driven, nt, stabilising_feedback(problem))
    W = _cost(problem, U, X, at)
    rows, w, labels = constraints_of(problem, U, X, at)
    H = 2 * W[nt:, nt:]
    f = np.zeros(len(H))
    if problem.soft is not None:
        linear, quadratic = problem.soft
        f[nv - nt :] = linear
        H[nv - nt :, nv - nt :] = 2 * quadratic * np.eye(N)
    _check_convex(H)
    (Lt, Lz), (Xt, Xz) = (np.split(form.reshape(-1, len(W)), [nt], axis=1) for form in (U, X))
    return ParametricQP(
        H=H, F=2 * W[nt:, :nt], f=f, Y=2 * W[:nt, :nt], y=np.zeros(nt), c=0.0, G=rows[:, nt:], w=w, S=-rows[:, :nt],
        Lz=Lz, Lt=Lt, l=np.zeros(len(Lz)), Xz=Xz, Xt=Xt, x=np.zeros(len(Xz)),
        nu=problem.nu, parameters=tuple(sizes.items()), labels=tuple(labels),
    )  # fmt: skip


def _sizes(problem: MPCProblem, parameters: tuple[str, ...]) -> dict[str, int]:
    """Name and length of each parameter, the state first."""
    known = {name: rows * columns for name, (rows, columns) in problem.signal_shapes.items()}
    if problem.rate_limit is not None:
        parameters = ("u_prev", *(p for p in parameters if p != "u_prev"))
    for name in parameters:
        if name not in known:
            raise InputError("parameters", f"unknown parameter {name!r}", f"some of {sorted(known)}")
    return {"x": problem.nx, **{name: known[name] for name in parameters}}


def predict(
    problem: MPCProblem, A: Array, B: Array, driven: Array, free: int, feedback: Array | None
) -> tuple[Array, Array]:
    """Inputs (N, nu, n) and states (N + 1, nx, n) as matrices on ξ.

    ξ begins with x and ends with the free inputs.
    A, B : (N, nx, nx) and (N, nx, nu); driven : (N, nx, n), what else moves each next state; free : the first column of
    the inputs, one for each block; feedback : see `stabilising_feedback`.
    """
    n = driven.shape[-1]
    U = np.zeros((problem.horizon, problem.nu, n))
    X = np.zeros((problem.horizon + 1, problem.nx, n))
    X[0, :, : problem.nx] = np.eye(problem.nx)
    k = 0
    for b, length in enumerate(block_lengths(problem)):
        form = np.zeros((problem.nu, n))
        form[:, free + b * problem.nu : free + (b + 1) * problem.nu] = np.eye(problem.nu)
        if feedback is not None:
            form -= feedback[b] @ X[k]
        for _ in range(length):
            U[k] = form
            X[k + 1] = A[k] @ X[k] + B[k] @ form + driven[k]
            k += 1
    return U, X


def _cost(problem: MPCProblem, U: Array, X: Array, at: dict[str, slice]) -> Array:
    """Matrix W of the quadratic cost ξ'Wξ."""
    N = problem.horizon
    error = X.copy()
    effort = U.copy()
    if "x_ref" in at:
        error[:, :, at["x_ref"]] -= np.eye((N + 1) * problem.nx).reshape(N + 1, problem.nx, -1)
    if "u_ref" in at:
        effort[:, :, at["u_ref"]] -= np.eye(N * problem.nu).reshape(N, problem.nu, -1)
    weighed = np.concatenate([problem.Q @ error[:N], (problem.P @ error[N])[None]])
    flat, acting = (part.reshape(-1, U.shape[-1]) for part in (error, effort))
    W = flat.T @ weighed.reshape(flat.shape) + acting.T @ (problem.R @ effort).reshape(acting.shape)
    cross = flat[: N * problem.nx].T @ (problem.cross @ effort).reshape(-1, U.shape[-1])
    W += cross + cross.T
    return np.asarray((W + W.T) / 2)


def constraints_of(
    problem: MPCProblem, U: Array, X: Array, at: dict[str, slice]
) -> tuple[Array, Array, list[Constraint]]:
    """Rows (m, nv) with rows ξ <= w, and their labels.

    With soft limits there is one slack per step, relative to their units.
    """
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
        impose("input", k, problem.rows_at("input", k), U[k])
        if problem.rate_limit is not None:
            before = U[k - 1] if k else np.zeros_like(U[0])
            if k == 0:
                before[:, at["u_prev"]] = np.eye(problem.nu)
            both = np.vstack([np.eye(problem.nu), -np.eye(problem.nu)])
            impose("rate", k, (both, np.tile(problem.rate_limit, 2)), U[k] - before)
        impose("state", k + 1, problem.rows_at("state", k + 1), X[k + 1])
    impose("terminal", problem.horizon, problem.rows_at("terminal", problem.horizon), X[problem.horizon])
    if problem.soft is not None:
        for k in range(problem.horizon):
            impose("slack", k + 1, (-np.eye(1), np.zeros(1)), np.eye(1, nv, at["s"].start + k))
    matrix = np.vstack(rows)
    for row, (kind, step, number) in zip(matrix, labels):
        if problem.soft is not None and kind in ("state", "terminal"):
            row[at["s"].start + step - 1] = -problem.price_units[kind][number]
    return matrix, np.concatenate(bounds), labels


def number_of_slacks(problem: MPCProblem) -> int:
    """One for each step where limits are soft."""
    return 0 if problem.soft is None else problem.horizon


def row_units(problem: MPCProblem, labels: list[Constraint] | tuple[Constraint, ...]) -> Array:
    """Unit of each row for comparing violations; 1 for a slack."""
    units = problem.row_units
    return np.array([units[label.kind][label.row] if label.kind in units else 1.0 for label in labels])


def _check_convex(H: Array) -> None:
    """Raise where the scaled Hessian is not positive definite."""
    d = np.sqrt(np.abs(np.diag(H)))
    scaled = H / d / d[:, None] if d.all() and np.isfinite(H).all() else None
    smallest = -np.inf if scaled is None else float(np.linalg.eigvalsh(scaled)[0])
    if smallest < ROUNDED_SUM:
        got = f"a condensed one with the smallest scaled eigenvalue {smallest:.3g}; some input is free of cost"
        cure = "Make R positive definite, or let Q and P see every input."
        raise NotConvexError("Hessian", got, f"a positive definite one, above {ROUNDED_SUM:.0e}", cure, smallest)
