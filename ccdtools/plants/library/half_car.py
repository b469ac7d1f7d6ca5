"""Half a car, left or right: heave, pitch and two wheels; springs and dampers of both axles are the design."""

from __future__ import annotations

import casadi as ca

from ccdtools.checks import as_flag
from ccdtools.plants.library.car import Car, axle_design, corner_forces
from ccdtools.plants.library.parameters import given_or_default
from ccdtools.plants.library.struts import RealStrut
from ccdtools.plants.plant import Plant

STATES = [
    "front tyre [m]", "rear tyre [m]", "front travel [m]", "rear travel [m]",
    "front wheel speed [m/s]", "rear wheel speed [m/s]", "heave rate [m/s]", "pitch rate [rad/s]",
]  # fmt: skip


def half_car(*, real: bool = False, car: Car | None = None, strut: RealStrut | None = None, dt: float = 0.01) -> Plant:
    """Half of a `Car`, with half of its body, about its static equilibrium; small angles.

    Parameters
    ----------
    real : bool
        Hardening springs, asymmetric dampers, dry friction (smoothed), largest active forces, tyres that cannot pull.
    car : Car, optional
        The whole car.
    strut : RealStrut, optional
        What makes the struts real.
    dt : float
        Sampling time [s].

    Returns
    -------
    Plant
        Eight states: tyre deflections, suspension travels and wheel speeds (front, rear), heave rate, pitch rate (nose
        up); u = active forces [N], w = vertical speeds of the road [m/s], each (front, rear);
        p = [k_f, c_f, k_r, c_r] of one wheel.
    """
    car = given_or_default("car", car, Car)
    x = ca.SX.sym("x", 8)
    u = ca.SX.sym("u", 2)
    w = ca.SX.sym("w", 2)
    p = ca.SX.sym("p", 4)
    wheels = x[4:6]
    arms = ca.DM([car.front, -car.rear])
    rates = x[6] + arms * x[7] - wheels
    axles = car.axles(p, strut=given_or_default("strut", strut, RealStrut), real=as_flag("real", real))
    lift, push = corner_forces(list(axles), u, x[:2], x[2:4], rates)
    dynamics = ca.vertcat(
        wheels - w,
        rates,
        push / ca.DM([car.wheel_front, car.wheel_rear]),
        ca.sum1(lift) / (car.body / 2),
        ca.dot(arms, lift) / (car.pitch_inertia / 2),
    )
    inputs = ["front force [N]", "rear force [N]"]
    return Plant(x, u, w, p, dynamics, axle_design(), dt=dt, state_names=STATES, input_names=inputs)
