"""Classical optimal control problems with published optima, each from a plain initial guess."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import brentq

from mpc.optimal_control import MultipleShooting, OptimalControlProblem, Phase

INF = np.inf
V = ca.vertcat


@dataclass(frozen=True, eq=False)
class Classical:
    """A problem, its optimal cost, where that is published, and how it is refined."""

    phase: Phase | OptimalControlProblem
    cost: float
    source: str
    options: dict[str, Any] = field(default_factory=dict)


def brachistochrone_time(x: float, y: float, g: float) -> float:
    """Time of the cycloid from (0, 0) to (x, y), y down."""
    angle = brentq(lambda a: (a - np.sin(a)) / (1 - np.cos(a)) - x / y, 1e-3, 2 * np.pi - 1e-6)
    return float(angle * np.sqrt(y / (1 - np.cos(angle)) / g))


def _robot(x: ca.SX, u: ca.SX) -> ca.SX:
    length = 5.0
    swing = ((length - x[0]) ** 3 + x[0] ** 3) / 3
    return V(x[3], x[4], x[5], u[0] / length, u[1] / (swing * ca.sin(x[2]) ** 2), u[2] / swing)


def _transfer(x: ca.SX, u: ca.SX, t: ca.SX) -> ca.SX:
    thrust = 0.1405 / (1 - 0.0749 * t)
    radial = x[2] ** 2 / x[0] - 1 / x[0] ** 2 + thrust * ca.sin(u)
    return V(x[1], radial, -x[1] * x[2] / x[0] + thrust * ca.cos(u))


def _goddard(x: ca.SX, u: ca.SX) -> ca.SX:
    drag = 310 * x[1] ** 2 * ca.exp(-500 * (x[0] - 1))
    return V(x[1], (u - drag) / x[2] - 1 / x[0] ** 2, -u / 0.5)


def _protein(x: ca.SX, u: ca.SX) -> ca.SX:
    grows = x[2] / (14.35 + x[2] + x[2] ** 2 / 111.5) * (x[5] + 0.22 / (0.22 + x[4]) * x[6])
    made = 0.233 * x[2] / (14.35 + x[2] + x[2] ** 2 / 111.5) * (0.0005 + x[4]) / (0.022 + x[4])
    shock = 0.09 * x[4] / (0.034 + x[4])
    feed = u[0] + u[1]
    return V(
        feed, grows * x[1], 100 * u[0] / x[0] - grows * x[1] / 0.51, made * x[1], 4 * u[1] / x[0], -shock * x[5],
        shock * (1 - x[6]),
    ) - feed / x[0] * V(0, x[1], x[2], x[3], x[4], 0, 0)  # fmt: skip


def _secreted(x: ca.SX, u: ca.SX) -> ca.SX:
    grows = 21.87 * x[3] / ((x[3] + 0.4) * (x[3] + 62.5))
    made = x[3] / (0.1 + x[3]) * ca.exp(-5 * x[3])
    leaves = 4.75 * grows / (0.12 + grows)
    feed = V(0, 0, 0, 20, 0) - V(x[:4], 0)
    return V(leaves * (x[1] - x[0]), made * x[2], grows * x[2], -7.3 * grows * x[2], u) + u / x[4] * feed


def _flying(x: ca.SX, u: ca.SX) -> ca.SX:
    left, right = u[0] - u[1], u[2] - u[3]
    return V(x[3:], (left + right) * ca.cos(x[2]), (left + right) * ca.sin(x[2]), 0.2 * (left - right))


CLASSICAL = {
    "Bryson-Denham": Classical(
        Phase(
            dynamics=lambda x, u: V(x[1], u),
            states=2,
            inputs=1,
            stage_cost=lambda u: u**2 / 2,
            start=[0, 1],
            end=[0, -1],
            x_bounds=([-INF, -INF], [1 / 9, INF]),
        ),
        4.0,
        "Bryson and Ho, Applied Optimal Control, 1975, section 3.11: 4/(9 l)",
    ),
    "brachistochrone": Classical(
        Phase(
            dynamics=lambda x, u: V(x[2] * ca.sin(u), x[2] * ca.cos(u), 9.81 * ca.cos(u)),
            states=3,
            inputs=1,
            start=[0, 0, 0],
            end=[10, 5, None],
            duration=(0.1, 10),
            u_bounds=(0, np.pi),
            terminal_cost=lambda t: t,
        ),
        brachistochrone_time(10, 5, 9.81),
        "the cycloid (Bernoulli 1696)",
    ),
    "hypersensitive": Classical(
        Phase(
            dynamics=lambda x, u: -(x**3) + u,
            states=1,
            inputs=1,
            stage_cost=lambda x, u: (x**2 + u**2) / 2,
            start=[1.5],
            end=[1.0],
            duration=10_000.0,
        ),
        # far from both ends x rests at 0, so the cost is that of two infinite horizons, by the Hamiltonian's zero
        1.3308068,
        "Rao and Mease, Optimal Control Applications and Methods 21, 2000; cost: see the test of its two ends",
    ),
    "Van der Pol with a bound": Classical(
        Phase(
            dynamics=lambda x, u: V(x[1], -x[0] + x[1] * (1 - x[0] ** 2) + u),
            states=2,
            inputs=1,
            stage_cost=lambda x, u: ca.sumsqr(x) + u**2,
            start=[1, 0],
            duration=5.0,
            x_bounds=([-INF, -0.4], INF),
        ),
        2.95369916,
        "Betts, Practical Methods for Optimal Control, 2nd ed. 2010, problem vpol",
    ),
    "shortest time": Classical(
        Phase(
            dynamics=lambda x, u: V(x[1], u),
            states=2,
            inputs=1,
            start=[0, 0],
            end=[300, 0],
            duration=(1, 100),
            u_bounds=(-2, 1),
            terminal_cost=lambda t: t,
        ),
        30.0,
        "one switch, by hand: Betts, 2nd ed. 2010, section 4.2",
    ),
    "Goddard's rocket": Classical(
        Phase(
            dynamics=_goddard,
            states=3,
            inputs=1,
            start=[1, 0, 1],
            end=[None, None, 0.6],
            x_bounds=([1, 0, 0.6], [INF, INF, 1]),
            u_bounds=(0, 3.5),
            duration=(0.01, 1.0),
            terminal_cost=lambda x: -x[0],
        ),
        -1.01283,
        "Dolan, More and Munson, COPS 3.0, 2004, problem 12",
    ),
    "catalyst mixing": Classical(
        Phase(
            dynamics=lambda x, u: V(u * (10 * x[1] - x[0]), u * (x[0] - 10 * x[1]) - (1 - u) * x[1]),
            states=2,
            inputs=1,
            start=[1, 0],
            u_bounds=(0, 1),
            terminal_cost=lambda x: -1 + x[0] + x[1],
        ),
        -4.80556e-2,
        "COPS 3.0, 2004, problem 14",
    ),
    "Rayleigh with a mixed limit": Classical(
        Phase(
            dynamics=lambda x, u: V(x[1], -x[0] + x[1] * (1.4 - 0.14 * x[1] ** 2) + 4 * u),
            states=2,
            inputs=1,
            stage_cost=lambda x, u: u**2 + x[0] ** 2,
            start=[-5, -5],
            duration=4.5,
            path=lambda x, u: u + x[0] / 6,
        ),
        44.8044433,
        "Betts, 2nd ed. 2010, problem rayleigh; Maurer and Augustin 2001",
    ),
    "batch reactor": Classical(
        Phase(
            dynamics=lambda x, u: V(-u * x[0] - u**2 / 2 * x[0], u * x[0]),
            states=2,
            inputs=1,
            start=[1, 0],
            u_bounds=(0, 5),
            terminal_cost=lambda x: -x[1],
        ),
        -0.57354505,
        "Ray, Advanced Process Control, 1981; value: Dadebo and McAuley 1995",
    ),
    "orbit raising": Classical(
        Phase(
            dynamics=_transfer,
            states=3,
            inputs=1,
            start=[1, 0, 1],
            end=[None, 0, None],
            boundary=lambda x: x[2] - 1 / ca.sqrt(x[0]),
            x_bounds=([0.5, -1, 0.1], [3, 1, 2]),
            duration=3.32,
            terminal_cost=lambda x: -x[0],
            guess=([0, 1], [[1, 0, 1], [1.5, 0, 0.8]], [[0.5], [5.5]]),
        ),
        -1.52528,
        "Bryson and Ho 1975, section 2.7 (1.525)",
    ),
    "particle steering": Classical(
        Phase(
            dynamics=lambda x, u: V(x[2], x[3], 100 * ca.cos(u), 100 * ca.sin(u)),
            states=4,
            inputs=1,
            start=[0, 0, 0, 0],
            end=[None, 5, 45, 0],
            duration=(0.01, 10),
            u_bounds=(-np.pi / 2, np.pi / 2),
            terminal_cost=lambda t: t,
        ),
        0.554577,
        "COPS 3.0, 2004, problem 10",
    ),
    "robot arm": Classical(
        Phase(
            dynamics=_robot,
            states=6,
            inputs=3,
            start=[4.5, 0, np.pi / 4, 0, 0, 0],
            end=[4.5, 2 * np.pi / 3, np.pi / 4, 0, 0, 0],
            x_bounds=([0, -np.pi, 0, -INF, -INF, -INF], [5, np.pi, np.pi, INF, INF, INF]),
            u_bounds=(-1, 1),
            duration=(0.1, 100),
            terminal_cost=lambda t: t,
        ),
        9.14093,
        "COPS 3.0, 2004, problem 8",
    ),
    "Zermelo, from no guess": Classical(
        Phase(
            dynamics=lambda x, u: V(ca.cos(u) - x[1], ca.sin(u)),
            states=2,
            inputs=1,
            start=[3.66, -1.86],
            end=[0, 0],
            duration=(0.1, 20),
            terminal_cost=lambda t: t,
        ),
        5.4579,
        "Bryson and Ho 1975, section 2.7",
    ),
    "Lee-Ramirez bioreactor": Classical(
        Phase(
            dynamics=_protein,
            states=7,
            inputs=2,
            start=[1, 0.1, 40, 0, 0, 1, 0],
            u_bounds=(0, 1),
            x_bounds=(0, None),
            duration=10.0,
            terminal_cost=lambda x: -x[0] * x[3],
        ),
        -6.1516,
        "Lee and Ramirez, AIChE Journal 40(5), 1994; value: PROPT collection",
        {"scheme": MultipleShooting(4), "intervals": 20},
    ),
    "Park-Ramirez bioreactor": Classical(
        Phase(
            dynamics=_secreted,
            states=5,
            inputs=1,
            start=[0, 0, 1, 5, 1],
            u_bounds=(0, 2),
            x_bounds=(0, None),
            duration=15.0,
            terminal_cost=lambda x: -x[0] * x[4],
            guess=([0, 1], [[0, 0, 1, 5, 1], [0.5, 1, 1.5, 0.1, 14]], [[1], [1]]),
        ),
        -32.69,
        "Park and Ramirez, AIChE Journal 34(9), 1988; value: PROPT collection",
        {"scheme": MultipleShooting(4), "intervals": 40},
    ),
}
FREE_FLYING_ROBOT = Classical(
    Phase(
        dynamics=_flying,
        states=6,
        inputs=4,
        stage_cost=lambda u: ca.sum1(u),
        start=[-10, -10, np.pi / 2, 0, 0, 0],
        end=[0] * 6,
        duration=12.0,
        u_bounds=(0, 1),
        path=lambda u: V(u[0] + u[1], u[2] + u[3]) - 1,
    ),
    7.91014874,
    "Betts, 2nd ed. 2010, section 6.13; Sakawa 1999",
)
