"""Beliefs of an extended Kalman filter as CasADi expressions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array


def next_belief(
    step: Callable[[Any, Any], Any], output: Callable[[Any, Any], Any], belief: tuple[Any, Any], u: Any, y: Any,
    W: Any, V: Array,
) -> tuple[Any, Any]:  # fmt: skip
    """Estimate (nx,) and covariance (nx, nx) after an input and the output that follows it.

    They are what `predict` and `update` of an `ExtendedKalmanFilter` give.

    Parameters
    ----------
    step, output : callable
        (x, u) → x⁺ and (x, u) → y, of expressions.
    belief : (nx,) and (nx, nx) expressions
        Estimate and covariance.
    u, y : (nu,) and (ny,) expressions
        Input, and what is measured after it.
    W : (nx, nx) expression
        Covariance of the process noise.
    V : (ny, ny) array
        Covariance of the measurement noise, positive definite.

    References
    ----------
    Anderson, Moore (1979), Optimal filtering, section 6.2, for outputs of independent noise, one by one.
    """
    mean, P = belief
    x = ca.SX.sym("x", *mean.shape)
    after, F = ca.substitute([step(x, u), ca.jacobian(step(x, u), x)], [x], [mean])
    seen, H = ca.substitute([output(x, u), ca.jacobian(output(x, u), x)], [x], [after])
    white = ca.DM(np.linalg.inv(np.linalg.cholesky(V)))
    missed, H = white @ (y - seen), white @ H
    moved, spread = ca.SX.zeros(*mean.shape), F @ P @ F.T + W
    for i in range(H.shape[0]):
        column = spread @ H[i, :].T
        variance = H[i, :] @ column + 1
        moved = moved + column * ((missed[i] - H[i, :] @ moved) / variance)
        spread = spread - column @ column.T / variance
    return after + moved, spread
