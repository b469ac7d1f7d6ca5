"""Plants of the tests of sampled models, equilibria and linearisations, each with its rates written a second time."""

import casadi as ca
import numpy as np

from ccdtools import DesignSpace, Plant

GRAVITY = 9.81


def swing(dt=0.1):
    """A driven pendulum whose length is the design: x = (angle, rate)."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    rate = -GRAVITY / p * ca.sin(x[0]) - 0.2 * x[1] + (u + w) / p**2
    design = DesignSpace(["l"], [0.5], [2.0], ["m"])
    return Plant(x, u, w, p, ca.vertcat(x[1], rate), design, dt, state_names=["θ [rad]", "ω [rad/s]"])


def swing_rates(x, u, w, p):
    return np.array([x[1], -GRAVITY / p[0] * np.sin(x[0]) - 0.2 * x[1] + (u[0] + w[0]) / p[0] ** 2])


def stiff(dt=0.02):
    """A fast state that follows the cosine of a slow one within microseconds."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    dynamics = ca.vertcat(-1e5 * (x[0] - ca.cos(x[1])), p * x[0] + u + w - x[1] ** 3)
    return Plant(x, u, w, p, dynamics, DesignSpace(["k"], [0.5], [2.0]), dt)


def motor(inductance=1e-3, dt=0.05):
    """Current, speed and temperature of a geared motor: the first within L/R, the last within seconds."""
    x, u, w, p = ca.SX.sym("x", 3), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    dynamics = ca.vertcat(*motor_rates(ca.vertsplit(x), [u], [w], ca.vertsplit(p), inductance))
    return Plant(x, u, w, p, dynamics, DesignSpace(["gear", "cooling"], [1.0, 0.2], [4.0, 2.0]), dt)


def motor_rates(x, u, w, p, inductance=1e-3):
    current, speed, warmth = x
    resistance = 1 + 0.004 * warmth
    return [(u[0] - resistance * current - 0.05 * p[0] * speed) / inductance,
            (0.05 * p[0] * current - 0.02 * speed - 1e-3 * speed**3 + w[0]) / (0.01 + 1e-3 * p[0] ** 2),
            (0.5 * resistance * current**2 - p[1] * warmth) / 5]  # fmt: skip


def stiff_rates(x, u, w, p):
    return np.array([-1e5 * (x[0] - np.cos(x[1])), p[0] * x[0] + u[0] + w[0] - x[1] ** 3])


def tanks(dt=1.0, unit=1.0):
    """Two tanks, one after the other, levels [m / unit]; the design is the first outlet [cm²]."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")

    def outflow(outlet, level):
        return 1e-4 * outlet * ca.sqrt(2 * GRAVITY * ca.fmax(level * unit, 1e-6))

    dynamics = ca.vertcat(u + w - outflow(p, x[0]), outflow(p, x[0]) - outflow(1.5, x[1])) / 0.01 / unit
    return Plant(x, u, w, p, dynamics, DesignSpace(["a"], [0.5], [2.0], ["cm²"]), dt)


def tank_rates(x, u, w, p):
    out = [1e-4 * a * np.sqrt(2 * GRAVITY * max(h, 1e-6)) for a, h in ((p[0], x[0]), (1.5, x[1]))]
    return np.array([u[0] + w[0] - out[0], out[0] - out[1]]) / 0.01


def hot_plate(dt=1.0):
    """A sensor that follows a plate within milliseconds, heated against radiation: rest is rest but for rounding."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    dynamics = ca.vertcat(-p * (x[0] - x[1]), (u + w + 200 - 5.67e-8 * 0.5 * (x[1] ** 4 - 293**4)) / 300.0)
    return Plant(x, u, w, p, dynamics, DesignSpace(["rate"], [500.0], [5000.0], ["1/s"]), dt)
