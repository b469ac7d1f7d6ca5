"""A full car of seven degrees of freedom; springs and dampers of both axles are the design.

The wheels are numbered front left, front right, rear left, rear right. Seven degrees of freedom have 14 states where
the road is given by its heights. Where it is given by its speeds, as elsewhere in this library, the states are
deflections, which the height of the road does not enter. Four wheels then have a fifteenth: the four suspension travels
under a rigid body show the twist of the road, which seven degrees of freedom do not.
"""

from __future__ import annotations

import casadi as ca

from ccdtools.checks import as_choice, as_flag, as_number
from ccdtools.plants.library.car import Car, axle_design, corner_forces
from ccdtools.plants.library.parameters import given_or_default
from ccdtools.plants.library.struts import RealStrut
from ccdtools.plants.plant import Plant

WHEELS = ("front left", "front right", "rear left", "rear right")
TWIST = ca.DM([1, -1, -1, 1])  # the pattern of heights that no rigid body follows


def full_car(*, real: bool = False, road: str = "speed", twist_decay: float = 0.5, car: Car | None = None,
             strut: RealStrut | None = None, dt: float = 0.01) -> Plant:  # fmt: skip
    """A full car about its static equilibrium; small angles.

    Parameters
    ----------
    real : bool
        Hardening springs, asymmetric dampers, dry friction (smoothed), largest active forces, tyres that cannot pull.
    road : {"speed", "height"}
        What w is: the vertical speeds of the road under the wheels [m/s], or its heights [m].
    twist_decay : float
        With speeds: rate [1/s] at which the twist of the road under the car is forgotten, so that it stays bounded
        under noise (without it, a mode that no input moves would integrate the noise). Zero is exact for any road.
    car : Car, optional
        Masses and geometry.
    strut : RealStrut, optional
        What makes the struts real.
    dt : float
        Sampling time [s].

    Returns
    -------
    Plant
        u = active forces [N]; p = [k_f, c_f, k_r, c_r] of one wheel. With speeds 15 states: tyre deflections and
        suspension travels; with heights 14: positions of the wheels, heave, pitch (nose up) and roll (left side up),
        against the static equilibrium on a road of height 0. Then come the wheel speeds and the rates of heave, pitch
        and roll.
    """
    car = given_or_default("car", car, Car)
    by_speed = as_choice("road", road, ("speed", "height")) == "speed"
    forgetting = as_number("twist_decay", twist_decay, expected="a rate [1/s], at least 0", low=0.0)
    x = ca.SX.sym("x", 15 if by_speed else 14)
    u = ca.SX.sym("u", 4)
    w = ca.SX.sym("w", 4)
    p = ca.SX.sym("p", 4)
    wheels = x[-7:-3]
    heights = heights_of_corners(car)
    rates = heights @ x[-3:] - wheels
    if by_speed:
        deflections = x[:4]
        travels = x[4:8]
        forgotten = forgetting / 4 * TWIST * ca.dot(TWIST, deflections + travels)  # minus the twist of the road
        motion = ca.vertcat(wheels - w - forgotten, rates)
    else:
        deflections = x[:4] - w
        travels = heights @ x[4:7] - x[:4]
        motion = x[-7:]
    front, rear = car.axles(p, strut=given_or_default("strut", strut, RealStrut), real=as_flag("real", real))
    lift, push = corner_forces([front, front, rear, rear], u, deflections, travels, rates)
    dynamics = ca.vertcat(
        motion,
        push / ca.DM([car.wheel_front, car.wheel_front, car.wheel_rear, car.wheel_rear]),
        heights.T @ lift / ca.DM([car.body, car.pitch_inertia, car.roll_inertia]),
    )
    inputs = [f"{wheel} force [N]" for wheel in WHEELS]
    return Plant(x, u, w, p, dynamics, axle_design(), dt=dt, state_names=_names(by_speed), input_names=inputs)


def heights_of_corners(car: Car) -> ca.DM:
    """Heights of the corners per heave, pitch and roll, (4, 3)."""
    along = (car.front, car.front, -car.rear, -car.rear)
    across = (car.half_track, -car.half_track, car.half_track, -car.half_track)
    return ca.DM([[1, a, b] for a, b in zip(along, across)])


def _names(by_speed: bool) -> list[str]:
    """Labels of the states."""
    if by_speed:
        positions = [f"{wheel} {part} [m]" for part in ("tyre", "travel") for wheel in WHEELS]
    else:
        positions = [*(f"{wheel} wheel [m]" for wheel in WHEELS), "heave [m]", "pitch [rad]", "roll [rad]"]
    speeds = [f"{wheel} wheel speed [m/s]" for wheel in WHEELS]
    return [*positions, *speeds, "heave rate [m/s]", "pitch rate [rad/s]", "roll rate [rad/s]"]
