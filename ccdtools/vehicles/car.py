"""Half car and full car; springs and dampers are the design.

The wheels are numbered front left, front right, rear left, rear right. Seven degrees of freedom have 14 states where
the road is given by its heights. Where it is given by its speeds, as elsewhere in this library, the states are
deflections, which the height of the road does not enter. Four wheels then have a fifteenth: the four suspension travels
under a rigid body show the twist of the road, which seven degrees of freedom do not.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.library.elements import GRAVITY, Parameters, given_or_default
from ccdtools.plants.plant import Plant
from ccdtools.vehicles.corner import Corner, RealStrut
from ccdtools_ground.door import as_choice, as_flag, as_number

STATES = [
    "front tyre [m]", "rear tyre [m]", "front travel [m]", "rear travel [m]",
    "front wheel speed [m/s]", "rear wheel speed [m/s]", "heave rate [m/s]", "pitch rate [rad/s]",
]  # fmt: skip
WHEELS = ("front left", "front right", "rear left", "rear right")
TWIST = ca.DM([1, -1, -1, 1])  # the pattern of heights that no rigid body follows


@dataclass(frozen=True)
class Car(Parameters):
    """Masses and geometry of a whole car.

    Attributes
    ----------
    body : float
        Sprung mass [kg].
    pitch_inertia, roll_inertia : float
        Of the body about its centre of mass [kg·m²].
    front, rear : float
        Distances of the axles from the centre of mass [m].
    half_track : float
        Distance of the wheels from the middle [m].
    wheel_front, wheel_rear : float
        Unsprung mass of one wheel [kg].
    tyre : float
        Stiffness of one tyre [N/m].

    References
    ----------
    Body, geometry and the middle of the design box: "Automotive Suspension", an example of MathWorks' Simulink
    (`sldemo_suspdat.m`; roll inertia and track are in its later version). Wheels and tyres are typical values.
    """

    body: float = 1200.0
    pitch_inertia: float = 2100.0
    roll_inertia: float = 1500.0
    front: float = 0.9
    rear: float = 1.2
    half_track: float = 0.9
    wheel_front: float = 50.0
    wheel_rear: float = 50.0
    tyre: float = 2e5

    @property
    def loads(self) -> tuple[float, float]:
        """Static loads of a front tyre and a rear one [N]."""
        wheelbase = self.front + self.rear
        return (
            GRAVITY * (self.wheel_front + self.body / 2 * self.rear / wheelbase),
            GRAVITY * (self.wheel_rear + self.body / 2 * self.front / wheelbase),
        )

    def axles(self, p: ca.SX, *, strut: RealStrut, real: bool) -> tuple[Corner, Corner]:
        """Corners of front and rear axle at the design p of `axle_design`."""
        front, rear = (
            Corner(p[2 * i], p[2 * i + 1], self.tyre, load, strut, nonlinear=real, real=real)
            for i, load in enumerate(self.loads)
        )
        return front, rear


def axle_design() -> DesignSpace:
    """Design space of spring and damper per wheel, front and rear."""
    return DesignSpace(
        ["k_f", "c_f", "k_r", "c_r"],
        lower=[1.5e4, 800.0, 1.2e4, 800.0],
        upper=[4.1e4, 4200.0, 3.0e4, 3200.0],
        units=["N/m", "N·s/m", "N/m", "N·s/m"],
    )


def corner_forces(
    corners: list[Corner], u: ca.SX, deflections: ca.SX, travels: ca.SX, rates: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Upward forces [N] on body corners and wheels, a row per corner."""
    lifts = [corner.active(u[i]) - corner.passive(travels[i], rates[i]) for i, corner in enumerate(corners)]
    pushes = [corner.ground(deflections[i]) - lifts[i] for i, corner in enumerate(corners)]
    return ca.vertcat(*lifts), ca.vertcat(*pushes)


def half_car(*, real: bool = False, car: Car | None = None, strut: RealStrut | None = None, dt: float = 0.01) -> Plant:
    """Half of a `Car` about its static equilibrium; small angles.

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


def full_car(*, real: bool = False, road: str = "speed", twist_decay: float = 0.5, car: Car | None = None,
             strut: RealStrut | None = None, dt: float = 0.01) -> Plant:  # fmt: skip
    """Full car about its static equilibrium; small angles.

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
    if by_speed:
        positions = [f"{wheel} {part} [m]" for part in ("tyre", "travel") for wheel in WHEELS]
    else:
        positions = [*(f"{wheel} wheel [m]" for wheel in WHEELS), "heave [m]", "pitch [rad]", "roll [rad]"]
    speeds = [f"{wheel} wheel speed [m/s]" for wheel in WHEELS]
    return [*positions, *speeds, "heave rate [m/s]", "pitch rate [rad/s]", "roll rate [rad/s]"]
