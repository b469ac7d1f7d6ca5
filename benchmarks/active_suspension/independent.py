"""Rules, dynamics and cost of the suspension once more, in NumPy alone, and a simulation: they check the solutions.

Written after the formulas and values of Allison, Guo and Han 2014 and of the code of Sundarrajan and Herber 2021, with
nothing from the plant of the library.
"""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp

from active_suspension.statement import COMFORT, EFFORT, TYRE

SPRUNG, UNSPRUNG, TYRE_STIFFNESS, G = 325.0, 65.0, 232.5e3, 9.81
SHEAR, STRENGTH, POWER = 77.2e9, 1974e6, 0.108
ALLOWED = {"oil pressure": 4.75e6, "valve lift": 0.03, "piston speed": 5.0}
POINTS = 20  # of every interval, at which rules are looked at


def stiffness(p) -> float:
    """Of the spring [N/m]."""
    d, D, _, turns = p[:4]
    return SHEAR * d**4 / (4 * D * turns * (2 * D**2 + d**2))


def damping(p) -> float:
    """Of the damper [N·s/m]."""
    valve, piston = p[4:6]
    return 7500 * np.sqrt(850 / (2 * 4.75e6)) / (4 * 0.7 * 0.9 * 0.1) * piston**4 / valve**3


def room(p) -> float:
    """From unloaded to solid [m]."""
    d, _, pitch, turns = p[:4]
    return pitch * turns + 2 * d - d * (turns + 0.75)


def stress(p, force):
    """Shear stress [Pa]."""
    C = p[1] / p[0]
    return (4 * C + 2) / (4 * C - 3) * 8 * force * p[1] / (np.pi * p[0] ** 3)


def strength(p) -> float:
    """In tension [Pa]."""
    return STRENGTH / (1000 * p[0]) ** POWER


def rules_of_design(p) -> dict[str, float]:
    """Each ≤ 0."""
    d, D, pitch, turns, _, piston, stroke = p
    length = pitch * turns + 2 * d
    return {
        "coiling": 4 * d / D - 1,
        "tangling": D / (12 * d) - 1,
        "buckling": length / (5.26 * D) - 1,
        "pocket length": length / 0.4 - 1,
        "pocket diameter": (d + D) / 0.25 - 1,
        "damper inside spring": (d + piston + 2 * (0.009 + 0.002)) / D - 1,
        "stress when solid": 1.2 * stress(p, stiffness(p) * room(p)) / (0.65 * strength(p)) - 1,
        "damper stroke": room(p) / stroke - 1,
        "damper length": 2 * stroke / (0.4 - 0.02 - 0.04) - 1,
    }


def rules_along(p, states, published: bool) -> dict[str, np.ndarray]:
    """Each ≤ 0, at states (n, 4)."""
    travel, speed = states[:, 2], states[:, 3] - states[:, 1]
    sag = SPRUNG * G / stiffness(p)
    bump = travel if published else -travel
    rules = {"bump stop": (bump + sag + 0.02) / room(p) - 1, "linear range": 1.15 * (sag + 1.1 * bump) / room(p) - 1}
    amplitude = stress(p, stiffness(p) * (travel if published else np.abs(travel)))
    rules["Soderberg"] = 1.2 * amplitude / (0.24 * strength(p)) + stress(p, SPRUNG * G) / (0.65 * strength(p)) - 1
    rules["Zimmerli"] = 1.2 * amplitude / 241e6 - 1
    pressure = damping(p) * np.abs(speed) / (np.pi * p[5] ** 2 / 4)
    lift = np.pi * p[4] ** 2 / 4 * pressure / 7500
    for name, value in {"oil pressure": pressure, "valve lift": lift, "piston speed": np.abs(speed)}.items():
        rules[name] = value / ALLOWED[name] - 1
    return rules


def simulated(p, phase, road) -> tuple[np.ndarray, float]:
    """States (n, 4) under the inputs of a phase's solution, and the cost: at many points between those of the mesh."""
    k, c = stiffness(p), damping(p)

    def rates(t, y):
        u = float(phase.u(t)[0])
        lift = u - k * y[2] - c * (y[3] - y[1])
        cost = TYRE * y[0] ** 2 + COMFORT * (lift / SPRUNG) ** 2 + EFFORT * u**2
        return [y[1] - float(road(np.array([t]))[0]), (-TYRE_STIFFNESS * y[0] - lift) / UNSPRUNG, y[3] - y[1],
                lift / SPRUNG, cost]  # fmt: skip

    y = np.zeros(5)
    states = []
    for begin, end in zip(phase.times[:-1], phase.times[1:]):
        inside = end - 1e-12 * (end - begin)  # inputs may jump at the ends of intervals
        at = np.linspace(begin, inside, POINTS)
        run = solve_ivp(rates, (begin, inside), y, method="DOP853", rtol=1e-9, atol=1e-11, t_eval=at)
        states.append(run.y[:4].T)
        y = run.y[:, -1]
    return np.vstack(states), float(y[4])
