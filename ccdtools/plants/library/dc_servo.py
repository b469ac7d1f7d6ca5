"""DC motor with gear and flywheel; gear ratio and flywheel are the design."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import casadi as ca

from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.library.elements import Parameters, dry_friction, given_or_default, limited
from ccdtools.plants.plant import Plant
from ccdtools_ground.door import as_flag


@dataclass(frozen=True)
class Servo(Parameters):
    """Motor and load; the last five fields are of the real one.

    Attributes
    ----------
    motor : float
        Inertia of the rotor [kg·m²].
    motor_friction : float
        Viscous [N·m·s].
    constant : float
        Torque per current [N·m/A], and voltage per speed [V·s].
    resistance : float
        Of the armature [Ω].
    load, load_friction : float
        Inertia [kg·m²] and viscous friction [N·m·s] of the load without flywheel.
    voltage_limit : float
        Of the real amplifier [V].
    dry_friction, sliding : float
        Of the real load [N·m], smoothed below a speed [rad/s].
    loss : float
        Part of the motor's torque that the real gear does not pass on [-].
    heavier : float
        Inertia that the real load has besides, of the model's [-].

    References
    ----------
    Motor: "DC Motor Position: System Modeling", Control Tutorials for MATLAB and Simulink, University of Michigan. Its
    inductance of 2.75 µH makes a time constant of 0.7 µs and is left out. The rest are typical values.
    """

    may_be_zero: ClassVar[tuple[str, ...]] = ("motor_friction", "load_friction", "dry_friction", "heavier")
    shares: ClassVar[tuple[str, ...]] = ("loss",)

    motor: float = 3.2284e-6
    motor_friction: float = 3.5077e-6
    constant: float = 0.0274
    resistance: float = 4.0
    load: float = 1e-3
    load_friction: float = 1e-3
    voltage_limit: float = 24.0
    dry_friction: float = 0.02
    sliding: float = 0.1
    loss: float = 0.1
    heavier: float = 0.3


def dc_servo(*, real: bool = False, servo: Servo | None = None, dt: float = 0.01) -> Plant:
    """Geared DC servo, linear unless `real`.

    Parameters
    ----------
    real : bool
        With a heavier load, dry friction (smoothed), losses in the gear and a largest voltage.
    servo : Servo, optional
        Motor and load.
    dt : float
        Sampling time [s].

    Returns
    -------
    Plant
        x = [angle, speed] of the load, u = voltage [V], w = torque on the load [N·m], p = [gear ratio n, flywheel J_f].
    """
    servo = given_or_default("servo", servo, Servo)
    x = ca.SX.sym("x", 2)
    u = ca.SX.sym("u")
    w = ca.SX.sym("w")
    p = ca.SX.sym("p", 2)
    ratio, flywheel = ca.vertsplit(p)
    speed = x[1]
    inertia = servo.load + flywheel + servo.motor * ratio**2
    voltage = u
    passed_on = 1.0
    resistance = (servo.load_friction + servo.motor_friction * ratio**2) * speed
    if as_flag("real", real):
        inertia += servo.heavier * servo.load
        voltage = limited(u, servo.voltage_limit)
        passed_on = 1 - servo.loss
        resistance += dry_friction(servo.dry_friction, speed, servo.sliding)
    current = (voltage - servo.constant * ratio * speed) / servo.resistance
    acceleration = (passed_on * servo.constant * ratio * current - resistance + w) / inertia
    design = DesignSpace(["n", "J_f"], lower=[5.0, 0.0], upper=[60.0, 5e-3], units=["-", "kg·m²"])
    names = ["angle [rad]", "speed [rad/s]"]
    return Plant(
        x, u, w, p, ca.vertcat(speed, acceleration), design, dt=dt, state_names=names, input_names=["voltage [V]"]
    )
