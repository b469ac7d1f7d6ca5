"""Beliefs of a cubature Kalman filter as CasADi expressions.

A function of a belief is its mean, its slope over the belief, and the covariance that the slope misses. With these the
rest is the Kalman filter; a row that is linear has its own slope and misses nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from ccdtools_ground.operations import bent_rows

Regressed = tuple[Any, Any, Any]  # mean (m,), slope (m, n), covariance (m, m) that the slope misses


NEGLIGIBLE, SMALL = (float(np.finfo(float).eps) ** power for power in (2 / 3, 1 / 3))


@cache
def root(n: int) -> ca.Function:
    """Function P (n, n) → lower L, L Lᵀ = P to all that counts.

    It is smooth where a part of the state follows from others, too: such a state has an axis of its own, which is all
    but 0, also where rounding leaves less than 0. A column is 0 where its variance is.
    """
    P, L = ca.SX.sym("P", n, n), ca.SX.zeros(n, n)
    for j in range(n):
        column = P[j:, j] - L[j:, :j] @ L[j, :j].T
        column[0] = ca.hypot(column[0], NEGLIGIBLE * P[j, j])
        unknown = P[j, j] > 0
        L[j:, j] = ca.if_else(unknown, column / ca.sqrt(ca.if_else(unknown, column[0], 1.0)), 0.0)
    return ca.Function("root", [P], [L])


def _counted(L: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Weights (1, n) of axes of a root, whose squares are the shares that count, and how many do.

    What is known does not count, and what is all but known in every state counts smoothly, as a likelihood has to be.
    """
    size = ca.sum2(L**2)
    part = ca.fmin((1 / ca.if_else(size > 0, size, 1.0)).T @ L**2 / SMALL, 1.0)
    weight = part * ca.sqrt(3 - 2 * part)
    return weight, ca.fmax(ca.sum2(weight**2), 1)


@cache
def points(n: int) -> ca.Function:
    """Function x (n,), L (n, n) → cubature points (n, 2 n), which are x along what is known."""
    x, L = ca.SX.sym("x", n), ca.SX.sym("L", n, n)
    away = ca.sqrt(_counted(L)[1]) * L
    return ca.Function("points", [x, L], [x + ca.horzcat(away, -away)])


@cache
def regressed(m: int, n: int) -> ca.Function:
    """Function of values (m, 2 n) at cubature points, L (n, n) → mean, slope, covariance that it misses.

    References
    ----------
    Arasaratnam and Haykin, "Cubature Kalman filters", IEEE Transactions on Automatic Control 54, 2009; Lefebvre,
    Bruyninckx and De Schutter (2002), for the slope, which is that of least squares over the points.
    """
    values, L = ca.SX.sym("values", m, 2 * n), ca.SX.sym("L", n, n)
    up, down = ca.horzsplit(values, n)
    weight, count = _counted(L)
    middle = (up + down) / 2 - values[:, 0]
    moved = middle @ weight.T**2 / count
    left = (middle - moved) @ ca.diag(weight) / ca.sqrt(count)
    H = (up - down) / (2 * ca.sqrt(count))
    for j in reversed(range(n)):  # H L are the differences
        rest = H[:, j] - H[:, j + 1 :] @ L[j + 1 :, j]
        H[:, j] = ca.if_else(L[j, j] > 0, rest / ca.if_else(L[j, j] > 0, L[j, j], 1.0), 0.0)
    return ca.Function("regressed", [values, L], [values[:, 0] + moved, H, left @ left.T])


def regression(function: Callable[[Any], Any], x: Any, P: Any) -> Regressed:
    """Mean, slope and what it misses of a function of expressions (n,) over a belief."""
    n, z = x.numel(), type(x).sym("z", x.numel())
    value = function(z)
    m, curved = value.numel(), bent_rows(value, z)
    straight, bent = (ca.DM.eye(m)[:, rows] for rows in (sorted({*range(m)} - {*curved}), curved))
    exact = ca.substitute([straight.T @ value, straight.T @ ca.jacobian(value, z)], [z], [x])
    mean, slope = (straight @ part for part in exact)
    if not curved:
        return mean, slope, ca.DM.zeros(m, m)
    L = root(n)(P)
    values = ca.horzcat(*(bent.T @ function(point) for point in ca.horzsplit(points(n)(x, L))))
    over, by, missed = regressed(len(curved), n)(values, L)
    return mean + bent @ over, slope + bent @ by, bent @ missed @ bent.T


def regressed_step(step: Callable[[Any, Any], Any], x: Any, P: Any, disturbance: tuple[Any, Any]) -> Regressed:
    """Mean, slope in x and covariance beside it of a step (x, w) → x⁺."""
    mean, S = disturbance
    n = x.numel()
    both = ca.vertcat(x, mean)
    parts = [0, n, both.numel()]
    after, slope, missed = regression(lambda z: step(*ca.vertsplit(z, parts)), both, ca.diagcat(P, S))
    F, G = ca.horzsplit(slope, parts)
    return after, F, missed + G @ S @ G.T


def predicted(step: Callable[[Any, Any], Any], x: Any, P: Any, disturbance: tuple[Any, Any]) -> tuple[Any, Any]:
    """Mean and covariance after a step, as `regressed_step`."""
    after, F, missed = regressed_step(step, x, P, disturbance)
    return after, F @ P @ F.T + missed


def updated(output: Callable[[Any], Any], x: Any, P: Any, y: Any, V: Any) -> tuple[Any, Any, list[tuple[Any, Any]]]:
    """Estimate and covariance after y of noise V, and innovations with their variances, each given those before.

    References
    ----------
    Anderson, Moore (1979), Optimal filtering, section 6.2.
    """
    n = x.numel()
    expected, H, missed = regression(output, x, P)
    both = ca.vertcat(ca.DM.eye(n), H)
    known, spread = ca.vertcat(x, expected - y), both @ P @ both.T + ca.diagcat(ca.DM.zeros(n, n), missed + V)
    told = []
    for i in range(n, n + y.numel()):  # what an output misses becomes 0, one by one
        told.append((-known[i], spread[i, i]))
        gain = spread[:, i] / spread[i, i]
        known, spread = known - gain * known[i], spread - gain @ spread[i, :]
    return known[:n], spread[:n, :n], told
