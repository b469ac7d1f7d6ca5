"""Expected returns: exact where inputs do not saturate, by Monte Carlo with common random numbers where they do."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gallery.oracle.statement import Array, Statement

SUBSTEPS = 10
LOST = 1e3  # half-widths of X beyond which a run is frozen, its cost with it


def linear_return(s: Statement, p: Array) -> float:
    """Expected return of the LQR at a design if no input saturates: second moments E[x xᵀ] carried along."""
    A, B, E = s.sampled(p)
    K = s.gain(A, B)
    F = A - B @ K
    W = E @ np.diag(s.std**2) @ E.T
    weight_u = K.T @ np.diag(s.R) @ K
    moment = np.outer(s.x0, s.x0)
    cost = 0.0
    for _ in range(s.steps):
        cost += np.sum(weight_u * moment)
        moment = F @ moment @ F.T + W
        cost += s.Q @ np.diag(moment)
    return -float(cost)


def highest_linear_return(s: Statement, p: Array) -> float:
    """Expected return of the best causal policy without input limits at a design: the Riccati difference equation."""
    A, B, E = s.sampled(p)
    W = E @ np.diag(s.std**2) @ E.T
    P = np.zeros_like(A)
    noise = 0.0
    for _ in range(s.steps):
        P = P + np.diag(s.Q)
        noise += np.sum(P * W)
        G = B.T @ P
        P = A.T @ P @ A - (G @ A).T @ np.linalg.solve(np.diag(s.R) + G @ B, G @ A)
    return -float(s.x0 @ P @ s.x0 + noise)


def model_step(s: Statement, p: Array) -> Callable[[Array, Array, Array], Array]:
    """(x, u, w) → x⁺ of the model."""
    A, B, E = s.sampled(p)
    return lambda x, u, w: x @ A.T + u @ B.T + w @ E.T


def real_step(s: Statement, p: Array, substeps: int = SUBSTEPS) -> Callable[[Array, Array, Array], Array]:
    """(x, u, w) → x⁺ of the real plant, by Runge–Kutta 4."""
    if s.real is None:
        return model_step(s, p)
    f = s.real
    h = s.dt / substeps

    def step(x: Array, u: Array, w: Array) -> Array:
        for _ in range(substeps):
            k1 = f(x, u, w, p)
            k2 = f(x + h / 2 * k1, u, w, p)
            k3 = f(x + h / 2 * k2, u, w, p)
            k4 = f(x + h * k3, u, w, p)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return x

    return step


def simulated(
    s: Statement, step: Callable[[Array, Array, Array], Array], policy: Callable[[Array], Array], w: Array
) -> tuple[Array, Array, Array]:
    """Returns (n,), states (n, T, nx) and inputs (n, T, nu) of a policy whose inputs are clipped."""
    x = np.tile(s.x0, (len(w), 1))
    total = np.zeros(len(w))
    states = np.empty((len(w), w.shape[1], len(s.x0)))
    inputs = np.empty((len(w), w.shape[1], len(s.R)))
    for k in range(w.shape[1]):
        u = np.clip(policy(x), -s.u_max, s.u_max)
        with np.errstate(over="ignore", invalid="ignore"):
            x = np.clip(np.nan_to_num(step(x, u, w[:, k])), -LOST * s.x_max, LOST * s.x_max)
        total -= x**2 @ s.Q + u**2 @ s.R
        states[:, k] = x
        inputs[:, k] = u
    return total, states, inputs


def saturated_return(s: Statement, p: Array, w: Array) -> float:
    """Mean return of the clipped LQR on the model under disturbances w (n, T, nw)."""
    A, B, _ = s.sampled(p)
    K = s.gain(A, B)
    return float(simulated(s, model_step(s, p), lambda x: -x @ K.T, w)[0].mean())
