"""Parameter estimation with published data and optima, simulated logs, and random linear plants."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

from ccdtools import KalmanFilter
from mpc.optimal_control.estimation import Experiment, MovingHorizonEstimator

NAN = np.nan


@dataclass(frozen=True, eq=False)
class Published:
    """Data, with the sum of squared residuals and the parameters that are published."""

    experiment: Experiment
    dynamics: Callable[..., Any]
    output: Callable[..., Any]
    options: dict[str, Any]
    residuals: float
    p: tuple[float, ...]
    source: str


def _cracking(x: ca.SX, p: ca.SX) -> ca.SX:
    return ca.vertcat(-(p[0] + p[2]) * x[0] ** 2, p[0] * x[0] ** 2 - p[1] * x[1])


def _isomerisation(x: ca.SX, p: ca.SX) -> ca.SX:
    lost, back = (p[2] + p[3]) * x[2], p[4] * x[4]
    return ca.vertcat(-(p[0] + p[1]) * x[0], p[0] * x[0], p[1] * x[0] - lost + back, p[2] * x[2], p[3] * x[2] - back)


GAS_OIL = np.array([
    [0.000, 1.0000, 0.0000], [0.025, 0.8105, 0.2000], [0.050, 0.6208, 0.2886], [0.075, 0.5258, 0.3010],
    [0.100, 0.4345, 0.3215], [0.125, 0.3903, 0.3123], [0.150, 0.3342, 0.2716], [0.175, 0.3034, 0.2551],
    [0.200, 0.2735, 0.2258], [0.225, 0.2405, 0.1959], [0.250, 0.2283, 0.1789], [0.300, 0.2071, 0.1457],
    [0.350, 0.1669, 0.1198], [0.400, 0.1530, 0.0909], [0.450, 0.1339, 0.0719], [0.500, 0.1265, 0.0561],
    [0.550, 0.1200, 0.0460], [0.650, 0.0990, 0.0280], [0.750, 0.0870, 0.0190], [0.850, 0.0770, 0.0140],
    [0.950, 0.0690, 0.0100],
])  # fmt: skip
PINENE = np.array([
    [0, NAN, NAN, NAN, NAN, NAN], [1230, 88.35, 7.3, 2.3, 0.4, 1.75], [3060, 76.4, 15.6, 4.5, 0.7, 2.8],
    [4920, 65.1, 23.1, 5.3, 1.1, 5.8], [7800, 50.4, 32.9, 6.0, 1.5, 9.3], [10680, 37.5, 42.7, 6.0, 1.9, 12.0],
    [15030, 25.9, 49.1, 5.9, 2.2, 17.0], [22620, 14.0, 57.4, 5.1, 2.6, 21.0], [36420, 4.5, 63.1, 3.8, 2.9, 25.7],
])  # fmt: skip
COPS = "Dolan, Moré and Munson, Benchmarking optimization software with COPS 3.0, ANL/MCS-TM-273, 2004"
PUBLISHED = {
    "gas oil cracking": Published(
        Experiment(GAS_OIL[:, 0], GAS_OIL[:, 1:], start=[1, 0]), _cracking, lambda x: x,
        {"states": 2, "p_bounds": ([0] * 3, [None] * 3)}, 5.2366e-3, (11.847, 8.345, 1.001),
        f"{COPS}, problem 12; parameters: Tjoa and Biegler, Ind. Eng. Chem. Res. 30, 1991",
    ),
    "gas oil cracking, first states free": Published(
        Experiment(GAS_OIL[:, 0], GAS_OIL[:, 1:]), _cracking, lambda x: x,
        {"states": 2, "p_bounds": ([0] * 3, [None] * 3)}, 4.3260205e-3, (11.424, 8.130, 1.655),
        "PROPT's example of catalytic cracking, which leaves the first states free; parameters measured here",
    ),
    "α-pinene": Published(
        Experiment(PINENE[:, 0], PINENE[:, 1:], start=[100, 0, 0, 0, 0]), _isomerisation, lambda x: x,
        {"states": 5, "p_bounds": ([0] * 5, [None] * 5)}, 19.872, (5.926e-5, 2.963e-5, 2.047e-5, 27.45e-5, 3.998e-5),
        f"{COPS}, problem 5; parameters: Rodriguez-Fernandez, Egea and Banga, BMC Bioinformatics 7, 2006",
    ),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Simulated:
    """Truth of simulated logs, and the statement that looks for it."""

    p: np.ndarray
    start: np.ndarray
    times: np.ndarray
    statement: dict[str, Any]


def _populations(x: ca.SX, p: ca.SX) -> ca.SX:
    return ca.vertcat(p[0] * x[0] - p[1] * x[0] * x[1], p[3] * x[0] * x[1] - p[2] * x[1])


LOTKA_VOLTERRA = Simulated(
    np.array([0.8, 0.04, 0.9, 0.03]), np.array([30.0, 12.0]), np.linspace(0, 12, 31),
    {
        "dynamics": _populations, "output": lambda x: x, "states": 2, "p_bounds": ([0] * 4, [5] * 4),
        "p_guess": [1, 0.1, 1, 0.1],
    },
)  # fmt: skip


@cache
def _course() -> np.ndarray:
    """Populations (n, 2) by an integrator of scipy."""
    a, b, c, d = LOTKA_VOLTERRA.p
    times = LOTKA_VOLTERRA.times
    rates = lambda t, x: [a * x[0] - b * x[0] * x[1], d * x[0] * x[1] - c * x[1]]  # noqa: E731
    return solve_ivp(rates, times[[0, -1]], LOTKA_VOLTERRA.start, t_eval=times, rtol=1e-11, atol=1e-11).y.T


def lotka_volterra_log(seed: int) -> Experiment:
    """Log of both populations with normal noise of deviation 1."""
    course = _course()
    return Experiment(LOTKA_VOLTERRA.times, course + np.random.default_rng(seed).normal(size=course.shape))


def lotka_volterra_with_product() -> dict[str, Any]:
    """Statement with a product of two parameters in the place of the second."""

    def rates(x: ca.SX, p: ca.SX) -> ca.SX:
        return _populations(x, ca.vertcat(p[0], p[1] * p[4], p[2:4]))

    own = {"dynamics": rates, "p_bounds": ([0] * 5, [5] * 5), "p_guess": [1, 0.1, 1, 0.1, 1]}
    return LOTKA_VOLTERRA.statement | own


def kalman_difference(seed: int, window: int, samples: int = 60) -> float:
    """Largest difference of moving-horizon estimates from Kalman's, in his deviations, on a random linear plant.

    Its units are drawn, too; the plant may be unstable, and some samples have no outputs.
    """
    rng = np.random.default_rng(seed)
    nx, nu, ny = (int(size) for size in (rng.integers(1, 5), rng.integers(1, 3), rng.integers(1, 3)))
    unit, scale = 10 ** rng.uniform(-3, 3, nx), 10 ** rng.uniform(-3, 3, ny)
    A = rng.normal(size=(nx, nx))
    A *= rng.uniform(0.5, 1.05) / np.abs(np.linalg.eigvals(A)).max() / unit * unit[:, None]
    B, C = unit[:, None] * rng.normal(size=(nx, nu)), scale[:, None] * rng.normal(size=(ny, nx)) / unit
    root, own = unit[:, None] * rng.normal(size=(nx, nx)), scale[:, None] * rng.normal(size=(ny, ny))
    W, V, P0 = 0.1 * root @ root.T, own @ own.T, np.diag(unit**2)
    kalman = KalmanFilter(A, B, C, W, V, steady=False, P0=P0)
    horizon = MovingHorizonEstimator(
        lambda x, u, w: A @ x + B @ u + w, lambda x: C @ x, nx, nu, window=window, W=W, V=V, P0=P0
    )
    first, second = kalman.start(1), horizon.start(1)
    x, u, apart = unit * rng.normal(size=nx), np.zeros((1, nu)), 0.0
    for k in range(samples):
        if k:
            first, second = kalman.predict(first, u), horizon.predict(second, u)
        y = (C @ x + own @ rng.normal(size=ny))[None]
        if rng.uniform() < 0.1:
            second = horizon.update(second, np.full((1, ny), np.nan), u)
        else:
            first, second = kalman.update(first, y, u), horizon.update(second, y, u)
        deviation = np.sqrt(np.diag(first.covariance))
        apart = max(apart, float(np.abs((first.mean - second.mean) / deviation).max()))
        if {status.name for status in second.status} != {"SOLVED"}:
            apart = np.inf
        u = rng.normal(size=(1, nu))
        x = A @ x + B @ u[0] + np.sqrt(0.1) * root @ rng.normal(size=nx)
    return apart
