"""A servo with backlash; gear ratio and flywheel are the design.

The model has no gap between motor and load, and no friction.
"""

import casadi as ca

from ccdtools.disturbances.disturbance import Gaussian
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.library.dc_servo import Servo
from ccdtools.plants.plant import Plant
from ccdtools.studies.cases._regulated import regulated_study


def servo(
    *, real: bool = False, shaft: float = 12.0, damping: float = 0.02, gap: float = 0.03, loss: float = 0.02
) -> Plant:
    """Motor and load on a shaft; the real one has a gap.

    x = [angle, speed] of the load and [twist, its rate], u = voltage [V], w = torque on the load [N·m].
    """
    parts = Servo()
    x, u, w, p = ca.SX.sym("x", 4), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    ratio, flywheel = ca.vertsplit(p)
    _, speed, twist, rate = ca.vertsplit(x)
    motor = speed + rate  # at the load's side of the gear
    current = (u - parts.constant * ratio * motor) / parts.resistance
    torque = shaft * twist + damping * rate
    if real:  # Hunt and Crossley's contact: no torque in the gap, none that pulls
        side = ca.sign(twist)
        depth = ca.fmax(ca.fabs(twist) - gap, 0)
        torque = side * shaft * depth * ca.fmax(1 + loss * side * rate, 0)
    load = (torque - parts.load_friction * speed + w) / (parts.load + flywheel)
    driven = parts.constant * ratio * current - torque - parts.motor_friction * ratio**2 * motor
    dynamics = ca.vertcat(speed, load, rate, driven / (parts.motor * ratio**2) - load)
    return Plant(
        x, u, w, p, dynamics, DesignSpace(["n", "J_f"], [15.0, 1e-3], [40.0, 5e-3], ["-", "kg·m²"]), dt=0.01,
        state_names=["angle [rad]", "speed [rad/s]", "twist [rad]", "rate of twist [rad/s]"],
        input_names=["voltage [V]"],
    )  # fmt: skip


study = regulated_study(
    "backlash_servo", "Servo with backlash", servo,
    limits=[2.0, 60.0, 0.6, 60.0], tolerable=[0.05, 20.0, 1.0, 60.0],  # rad, rad/s
    inputs=[24.0], effort=[12.0], disturbance=Gaussian(std=[0.05]),  # V, N·m
    x0=[-1.0, 0.0, 0.0, 0.0], p0=[20.0, 2e-3], steps=100,
)  # fmt: skip
