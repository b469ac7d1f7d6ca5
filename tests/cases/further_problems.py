"""Published optimal control problems on which nothing was developed: first run at 48aca61e, as they stand here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from classical_problems import INF, Classical, V

from mpc.optimal_control import OptimalControlProblem, Phase

BETTS = "Betts, Practical Methods for Optimal Control Using Nonlinear Programming, 3rd ed., SIAM 2020"
DEGREE = np.pi / 180


def _alp_rider() -> Phase:
    def peaks(x: ca.SX, t: ca.SX) -> ca.SX:
        heights = [(3, 3, 12), (3, 6, 10), (3, 10, 6), (8, 15, 4)]
        return sum(a * ca.exp(-b * (t - at) ** 2) for a, at, b in heights) + 0.01 - ca.sumsqr(x)

    A = ca.DM([[-10, 0, 0, 0], [0, -2, 0, 0], [0, 0, -3, 5], [0, 0, 5, -3]])
    B = ca.DM([[1, 1], [1, 2], [1, -1], [1, 3]])
    return Phase(
        lambda x, u: A @ x + B @ u, 4, 2, stage_cost=lambda x, u: 100 * ca.sumsqr(x) + 0.01 * ca.sumsqr(u),
        path=peaks, start=[2, 1, 2, 1], end=[2, 3, 1, -2], duration=20.0,
    )  # fmt: skip


def _tumour() -> Phase:
    """Angiogenesis, d'Onofrio, Ledzewicz, Maurer and Schättler (2009)."""

    def cells(x: ca.SX, u: ca.SX) -> ca.SX:
        p, q = x[0], x[1]
        return V(-0.084 * p * ca.log(p / q), q * (5.85 - (0.02 + 0.00873 * p ** (2 / 3) + 0.15 * u)), u)

    rest = ((5.85 - 0.02) / 0.00873) ** 1.5
    return Phase(
        cells, 3, 1, terminal_cost=lambda x: x[0], start=[rest / 2, rest / 4, 0], duration=(0.1, 10.0),
        x_bounds=([rest / 100, rest / 100, 0], [rest, rest, 15]), u_bounds=(0, 75),
    )  # fmt: skip


def _tuberculosis() -> Phase:
    """Two strains, Jung, Lenhart and Feng (2002)."""
    people, dies, mu = 30000.0, 0.0143, 0.029

    def spread(x: ca.SX, u: ca.SX) -> ca.SX:
        S, T, L1, L2, I1, I2 = ca.vertsplit(x)
        held, resistant = 1 - u[1], mu * I2 / people
        return V(
            dies * people - 13 * S * I1 / people - S * resistant - dies * S,
            2 * u[0] * L1 - dies * T + (1 - 0.5 * held) * I1 - 13 * T * I1 / people - T * resistant,
            13 * (S + T) * I1 / people - (dies + 0.5) * L1 - 2 * u[0] * L1 + 0.4 * held * I1 - L1 * resistant,
            0.1 * held * I1 - (dies + 1) * L2 + (S + L1 + T) * resistant,
            0.5 * L1 - (dies + 1) * I1, L2 - dies * I2,
        )  # fmt: skip

    return Phase(
        spread, 6, 2, stage_cost=lambda x, u: x[3] + x[5] + 25 * u[0] ** 2 + 250 * u[1] ** 2, duration=5.0,
        start=[19000, 250, 9000, 500, 1000, 250], u_bounds=(0.05, 0.95), x_bounds=(0, people),
    )  # fmt: skip


def _glider() -> Phase:
    def flight(x: ca.SX, u: ca.SX) -> ca.SX:
        away = (x[0] / 100 - 2.5) ** 2
        w = x[3] - 2.5 * (1 - away) * ca.exp(-away)
        v = ca.sqrt(x[2] ** 2 + w**2)
        D, L = (0.5 * c * 1.13 * 14 * v / 100 for c in (0.034 + 0.069662 * u**2, u))
        return V(x[2], x[3], -L * w - D * x[2], L * x[2] - D * w - 9.81)

    speed = [13.23, -1.288]
    return Phase(
        flight, 4, 1, terminal_cost=lambda x: -x[0], start=[0, 1000, *speed], end=[None, 900, *speed],
        u_bounds=(0, 1.4), x_bounds=([0, -INF, 0.1, -INF], INF), duration=(10, 200.0), duration_guess=100,
        guess=([0, 1], [[0, 1000, *speed], [1250, 900, *speed]], [[1.0], [1.0]]),
    )  # fmt: skip


def _shuttle() -> Phase:
    """Reentry for the largest crossrange, in feet and radians."""

    def entry(x: ca.SX, u: ca.SX) -> ca.SX:
        h, lat, v, slope, heading = ca.vertsplit(x)
        angle, r = u[0] / DEGREE, 20902900 + h
        per = 0.5 * 2690 * 0.002378 * ca.exp(-h / 23800) * v / (203000 / 32.174)
        drag = (0.07854 - 0.61592e-2 * angle + 0.621408e-3 * angle**2) * per * v
        lift, g = (-0.20704 + 0.029244 * angle) * per, 0.14076539e17 / r**2
        return V(
            v * ca.sin(slope), v / r * ca.cos(slope) * ca.cos(heading), -drag - g * ca.sin(slope),
            lift * ca.cos(u[1]) + ca.cos(slope) * (v / r - g / v),
            lift * ca.sin(u[1]) / ca.cos(slope) + v / r * ca.cos(slope) * ca.sin(heading) * ca.tan(lat),
        )  # fmt: skip

    first, last = [260000, 0, 25600, -DEGREE, 90 * DEGREE], [80000, None, 2500, -5 * DEGREE, None]
    end = [80000, 10 * DEGREE, 2500, -5 * DEGREE, -90 * DEGREE]
    return Phase(
        entry, 5, 2, terminal_cost=lambda x: -x[1], start=first, end=last,
        duration=(100, 4000.0), duration_guess=1000.0,
        x_bounds=([0, -1.55, 1, -1.55, -np.pi], [3e5, 1.55, 3e4, 1.55, np.pi]),
        u_bounds=([-90 * DEGREE, -89 * DEGREE], [90 * DEGREE, DEGREE]),
        guess=([0, 1], [first, end], [[0, -45 * DEGREE]] * 2),
    )  # fmt: skip


def _lander() -> Phase:
    return Phase(
        lambda x, u: V(x[1], u - 1.5), 2, 1, stage_cost=lambda u: u, start=[10, -2], end=[0, 0], u_bounds=(0, 3),
        x_bounds=([0, -20], [20, 20]), duration=(0.1, 200.0),
    )  # fmt: skip


def _penicillin() -> Phase:
    """Fed batch of Cuthrell and Biegler (1989): stiff where the substrate is used up."""

    def growth(x: ca.SX, u: ca.SX) -> ca.SX:
        y1, y2, y3, y4 = ca.vertsplit(x)
        grows, makes = 0.11 * y3 / (0.006 * y1 + y3), 0.0055 * y3 / (1e-4 + y3 * (1 + 10 * y3))
        eats = grows / 0.47 + makes / 1.2 + 0.029 * y3 / (1e-4 + y3)
        feed = u / (500 * y4)
        return V((grows - feed) * y1, makes * y1 - (0.01 + feed) * y2, feed * (500 - y3) - eats * y1, u / 500)

    return Phase(
        growth, 4, 1, terminal_cost=lambda x: -x[1] * x[3], start=[1.5, 0, 0, 7], x_bounds=(0, [40, 50, 25, 10]),
        u_bounds=(0, 50), duration=(72, 200.0), duration_guess=120.0,
        guess=([0, 1], [[1.5, 0, 0, 7], [30, 8.5, 0, 10]], [[10.0], [10.0]]),
    )  # fmt: skip


def _launch() -> OptimalControlProblem:
    """Delta III to a transfer orbit: four phases, and masses that fall off between them."""
    mu, earth, turn = 3.986012e14, 6378145.0, 7.29211585e-5
    burns, solid, first, second = (
        [75.2, 75.2, 110.6],
        (17010 / 75.2, 628500),
        (95550 / 261, 1083100),
        (16820 / 700, 110094),
    )

    def flight(boosters: int, stage: tuple[float, float]) -> Callable[..., ca.SX]:
        flow, thrust = (boosters * a + b for a, b in zip(solid, stage))

        def rate(x: ca.SX, u: ca.SX) -> ca.SX:
            r, v, height = x[:3], x[3:6], ca.norm_2(x[:3])
            air = v - V(-turn * r[1], turn * r[0], 0)
            drag = -0.5 * 1.225 * ca.exp((earth - height) / 7200) * 2 * np.pi * ca.sqrt(ca.sumsqr(air) + 1e-12) * air
            return V(v, -mu * r / height**3 + (thrust * u + drag) / x[6], -flow)

        return rate

    def elements(x: ca.SX) -> ca.SX:
        r, v = x[:3], x[3:6]
        h, size = ca.cross(r, v), ca.norm_2(r)
        node, form = V(-h[1], h[0], 0), ((ca.sumsqr(v) - mu / size) * r - ca.dot(r, v) * v) / mu
        ascends = ca.atan2(node[1], node[0])
        return V(
            1 / (2 / size - ca.sumsqr(v) / mu), ca.norm_2(form), ca.acos(h[2] / ca.norm_2(h)),
            ascends + 2 * np.pi * (ascends < 0), ca.acos(ca.dot(node, form) / (ca.norm_2(node) * ca.norm_2(form))),
        )  # fmt: skip

    orbit = np.array([24361140, 0.7308, *(DEGREE * np.array([28.5, 269.8, 130.5]))])
    pad = earth * np.array([np.cos(28.5 * DEGREE), 0, np.sin(28.5 * DEGREE)])
    ground = [*pad, 0, turn * pad[0], 0]
    (ci, si), (cn, sn), (cw, sw) = ((np.cos(angle), np.sin(angle)) for angle in orbit[2:])
    towards = np.array([cn * cw - sn * sw * ci, sn * cw + cn * sw * ci, sw * si])  # the perigee, and a quarter on
    along = np.array([-cn * sw - sn * cw * ci, -sn * sw + cn * cw * ci, cw * si])
    low = orbit[0] * (1 - orbit[1])
    there = [*(low * towards), *(np.sqrt(mu * (1 + orbit[1]) / low) * along)]
    masses, dropped = [], [6 * 2280, 3 * 2280, 104380 - 95550]
    mass = 9 * 19290 + 104380 + 19300 + 4164.0
    for boosters, stage, burn, less in zip((6, 3, 0, 0), (first,) * 3 + (second,), [*burns, 700], [*dropped, 0]):
        masses.append((mass, mass - (boosters * solid[0] + stage[0]) * burn))
        mass = masses[-1][1] - less

    def phase(k: int, boosters: int, stage: tuple[float, float], ends: tuple[Any, Any], **more: Any) -> Phase:
        begins, left = masses[k]
        return Phase(
            flight(boosters, stage), 7, 3, u_bounds=(-1, 1), path_bounds=([1, 1], [1, INF]),
            path=lambda x, u: V(ca.sumsqr(u), ca.sumsqr(x[:3]) / earth**2),
            x_bounds=([-2 * earth] * 3 + [-15000] * 3 + [1], [2 * earth] * 3 + [15000] * 3 + [4e5]),
            guess=([0, 1], [[*ends[0], begins], [*ends[1], left]], [[0, 1, 0]] * 2), **more,
        )  # fmt: skip

    phases = [
        phase(0, 6, first, (ground, ground), start=[*ground, masses[0][0]], duration=burns[0]),
        phase(1, 3, first, (ground, ground), duration=burns[1]),
        phase(2, 0, first, (there, there), duration=burns[2]),
        phase(3, 0, second, (there, there), duration=(100, 700.0), duration_guess=700.0, boundary=elements,
              boundary_bounds=(orbit, orbit), terminal_cost=lambda x: -x[6]),
    ]  # fmt: skip
    return OptimalControlProblem(phases, link=[lambda x, less=less: V(x[:6], x[6] - less) for less in dropped])


FURTHER: dict[str, Classical] = {
    "tumour": Classical(_tumour(), 7571.6712, BETTS),
    "two strains": Classical(_tuberculosis(), 5152.07310, BETTS),
    "hang glider": Classical(_glider(), -1248.03, "Dolan, Moré and Munson, COPS 3.0, Argonne 2004"),
    "reentry, crossrange": Classical(_shuttle(), -34.1412 * DEGREE, BETTS),
    "lander": Classical(_lander(), 8.2462, "Meditch (1964), by Patterson and Rao, GPOPS-II"),
    "launch, four phases": Classical(_launch(), -7529.71241, "Benson (2004), by Rao and others, GPOPS, 2010"),
    "alp rider": Classical(_alp_rider(), 2030.85609, BETTS, {"time_limit": 90}),
    "penicillin": Classical(_penicillin(), -87.99, "Cuthrell and Biegler (1989)", {"time_limit": 90}),
}  # fmt: skip
