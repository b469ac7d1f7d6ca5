"""Plants with algebraic variables, and their trajectories by IDAS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ccdtools import DesignSpace, Plant

V = ca.vertcat


@dataclass(frozen=True, eq=False)
class Algebraic:
    """dx/dt = rates, 0 = equations, with where it starts and how it is driven."""

    x: ca.SX
    z: ca.SX
    u: ca.SX
    p: ca.SX
    rates: ca.SX
    equations: ca.SX
    guess: Any
    design: DesignSpace
    at: tuple[float, ...]  # the design
    start: np.ndarray
    inputs: np.ndarray  # (T, nu), held over samples
    dt: float
    substeps: int
    start_z: Any = None  # of IDAS; a zero of the equations at the start

    def plant(self, **changes) -> Plant:
        """The plant, with the states as they are."""
        stated = {"dt": self.dt, "substeps": self.substeps, "z": self.z, "algebraic": self.equations,
                  "z_guess": self.guess}  # fmt: skip
        return Plant(self.x, self.u, None, self.p, self.rates, self.design, **(stated | changes))

    def by_idas(self, tolerance=1e-12) -> np.ndarray:
        """States (T + 1, nx) by CasADi's IDAS."""
        at = ca.Function("at", [self.x, self.u, self.p], [ca.SX.ones(self.z.shape) * ca.SX(self.guess)])
        root = ca.rootfinder("root", "newton", {"x": self.z, "p": V(self.x, self.u, self.p), "g": self.equations})
        options = {"abstol": tolerance, "reltol": tolerance, "max_num_steps": 1_000_000}
        dae = {"x": self.x, "z": self.z, "p": V(self.u, self.p), "ode": self.rates, "alg": self.equations}
        integrate = ca.integrator("idas", "idas", dae, 0.0, self.dt, options)
        states = [self.start]
        for u in self.inputs:
            first = at(states[-1], u, self.at) if self.start_z is None else self.start_z
            z = root(x0=first, p=np.concatenate([states[-1], u, self.at]))["x"]
            end = integrate(x0=states[-1], z0=z, p=np.concatenate([u, self.at]))
            states.append(np.asarray(end["xf"], dtype=float).ravel())
        return np.array(states)

    def by_plant(self) -> np.ndarray:
        """States (T + 1, nx) by the plant's own steps."""
        step = self.plant().step
        states = [self.start]
        for u in self.inputs:
            states.append(np.asarray(step(states[-1], u, [], self.at), dtype=float).ravel())
        return np.array(states)


def apart(found: np.ndarray, reference: np.ndarray) -> float:
    """Largest difference beside the extent of each state."""
    return float((np.abs(found - reference).max(axis=0) / np.ptp(reference, axis=0)).max())


def pendulum(length=1.0, mass=1.0, time=1.0) -> Algebraic:
    """A bob on a rod in Cartesian coordinates, its accelerations and the rod's force algebraic: affine.

    In units of `length` a metre, `mass` a kilogram, `time` a second.
    """
    x, z, u, p = ca.SX.sym("x", 4), ca.SX.sym("z", 3), ca.SX.sym("u"), ca.SX.sym("m")
    gravity, force = 9.81 * length / time**2, length * mass / time**2
    equations = V(
        p * z[0] + x[0] * z[2] - u, p * z[1] + x[1] * z[2] + p * gravity,
        x[0] * z[0] + x[1] * z[1] + x[2] ** 2 + x[3] ** 2,
    )  # fmt: skip
    speed = length / time
    start = np.array([0.6 * length, -0.8 * length, 0.8 * speed, 0.6 * speed])
    return Algebraic(
        x, z, u, p, V(x[2], x[3], z[0], z[1]), equations, 0.0, DesignSpace(["m"], [0.2 * mass], [5.0 * mass]), (mass,),
        start, force * np.array([[2.0], [-3.0], [0.0], [4.0]]), 0.25 * time, 60,
    )  # fmt: skip


def diode(volt=1.0, ampere=1.0, second=1.0) -> Algebraic:
    """A rectifier: a source charges a capacitor through a resistor and a diode, of whose voltage Newton's steps are.

    In units of a volt, an ampere and a second.
    """
    x, z, u, p = (ca.SX.sym(name) for name in ("v", "vd", "source", "R"))
    thermal, leak = 0.0517 * volt, 1e-9 * ampere
    over = u - x
    current = leak * ca.expm1(z / thermal)
    guess = ca.if_else(over > 0, ca.fmin(over, thermal * ca.log1p(ca.fmax(over, 0) / (p * leak))), over)
    ohm = volt / ampere
    load, capacity = 1e3 * ohm, 1e-5 * second / ohm
    inputs = 10 * volt * np.sin(np.arange(40) / 4)[:, None]
    return Algebraic(
        x, z, u, p, (current - x / load) / capacity, z + p * current - over, guess,
        DesignSpace(["R"], [10 * ohm], [1000 * ohm]), (100 * ohm,), np.array([0.0]), inputs, 2e-4 * second, 40,
    )  # fmt: skip


RATES = {"k1": (1.3708e12, 9.2984e3), "k_1": (1.6215e20, 1.3108e4), "k2": (5.2282e12, 9.5999e3)}
K1, K2, K3 = 2.575e-16, 4.876e-14, 1.7884e-16


def reactor_rates(x, z, temperature, kinds=ca):
    """Rates of the six states of the batch reactor; z is of the acidity and the three anions."""
    k1, k_1, k2 = (scale * kinds.exp(-energy / temperature) for scale, energy in RATES.values())
    first, second, third = k1 * x[1] * x[5] - k_1 * z[3], k2 * x[1] * z[1], k1 * x[3] * x[5] - k_1 / 2 * z[2]
    return [-second, -first - second, second + third, -third, first, -first - third]


def reactor_balances(x, acid, z, catalyst):
    """Charge balance and the equilibria of the three anions at an acidity."""
    return [catalyst - x[5] + acid - z[1] - z[2] - z[3], z[1] - K2 * x[0] / (K2 + acid), z[2] - K3 * x[2] / (K3 + acid),
            z[3] - K1 * x[4] / (K1 + acid)]  # fmt: skip


def reactor(moles=1.0, hours=1.0) -> Algebraic:
    """The kinetic batch reactor (Betts 2010, section 6.15; Caracotsios and Stewart 1985), its temperature the input.

    In units of a gram mole a kilogram, and an hour.
    """
    x, z, u, p = ca.SX.sym("x", 6), ca.SX.sym("z", 4), ca.SX.sym("T"), ca.SX.sym("catalyst")
    own, anions, catalyst = x / moles, z / moles, p / moles
    equations = V(*reactor_balances(own, anions[0], anions, catalyst))
    base = K2 + catalyst - own[5]
    acid = 2 * K2 * own[0] / (base + ca.sqrt(base**2 + 4 * K2 * own[0]))
    guess = moles * V(acid, K2 * own[0] / (K2 + acid), K3 * own[2] / (K3 + acid), K1 * own[4] / (K1 + acid))
    start = moles * np.array([1.5776, 8.32, 0.0, 0.0, 0.0, 0.0142])
    return Algebraic(
        x, z, u, p, V(*reactor_rates(own, anions, u)) * moles / hours, equations, guess,
        DesignSpace(["catalyst"], [0.0], [0.0262 * moles]), (0.0131 * moles,), start,
        np.array([[340.0], [350.0], [360.0], [370.0], [380.0], [365.0]]), 0.05 * hours, 40,
    )  # fmt: skip


def column(trays=20) -> Algebraic:
    """A distillation column of benzene and toluene between condenser and reboiler; each has a temperature as z.

    Constant molar flows [kmol/min] and holdups [kmol], pressure 101.3 kPa, Antoine's equation for both vapours; the
    temperatures [°C] are those at which the liquids boil. The input is the reflux.
    """
    stages = trays + 2
    x, z, u, p = ca.SX.sym("x", stages), ca.SX.sym("T", stages), ca.SX.sym("reflux"), ca.SX.sym("boilup")

    def pressure(a: float, b: float, c: float) -> ca.SX:
        """Vapour pressure [kPa]."""
        return 10 ** (a - b / (z + c)) * 101.325 / 760

    light, heavy = pressure(6.90565, 1211.033, 220.79), pressure(6.95464, 1344.8, 219.482)
    equations = (x * light + (1 - x) * heavy) / 101.3 - 1
    y, feed, at = x * light / 101.3, 1.0, trays // 2
    below = [u + feed * (i >= at) for i in range(stages)]  # liquid that leaves a stage
    rates = [p * (y[1] - x[0]) / 5.0]
    for i in range(1, stages - 1):
        arrives = below[i - 1] * x[i - 1] + p * y[i + 1]
        rates.append((arrives - below[i] * x[i] - p * y[i] + feed * 0.5 * (i == at)) / 0.5)
    rates.append((below[-2] * x[-2] - (below[-2] - p) * x[-1] - p * y[-1]) / 10.0)
    start = np.linspace(0.95, 0.05, stages)
    return Algebraic(
        x, z, u, p, V(*rates), equations, 110.6 - 30.5 * x, DesignSpace(["boilup"], [1.5], [3.0]), (2.2,), start,
        np.repeat([1.7, 1.8, 1.6], 4)[:, None], 0.5, 20,
    )  # fmt: skip
