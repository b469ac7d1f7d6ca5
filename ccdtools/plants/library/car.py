"""A passenger car: what the half car and the full car have in common."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.library.parameters import Parameters
from ccdtools.plants.library.struts import GRAVITY, Corner, RealStrut


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
        """Static loads of a front tyre and of a rear one [N]."""
        wheelbase = self.front + self.rear
        return (
            GRAVITY * (self.wheel_front + self.body / 2 * self.rear / wheelbase),
            GRAVITY * (self.wheel_rear + self.body / 2 * self.front / wheelbase),
        )

    def axles(self, p: ca.SX, *, strut: RealStrut, real: bool) -> tuple[Corner, Corner]:
        """A corner of the front axle and one of the rear axle, at the design p of `axle_design`."""
        front, rear = (
            Corner(p[2 * i], p[2 * i + 1], self.tyre, load, strut, nonlinear=real, real=real)
            for i, load in enumerate(self.loads)
        )
        return front, rear


def axle_design() -> DesignSpace:
    """Spring and damper of one wheel, front and rear."""
    return DesignSpace(
        ["k_f", "c_f", "k_r", "c_r"],
        lower=[1.5e4, 800.0, 1.2e4, 800.0],
        upper=[4.1e4, 4200.0, 3.0e4, 3200.0],
        units=["N/m", "N·s/m", "N/m", "N·s/m"],
    )


def corner_forces(
    corners: list[Corner], u: ca.SX, deflections: ca.SX, travels: ca.SX, rates: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Upward forces [N] on the body at its corners and on the wheels, a row for each corner."""
    lifts = [corner.active(u[i]) - corner.passive(travels[i], rates[i]) for i, corner in enumerate(corners)]
    pushes = [corner.ground(deflections[i]) - lifts[i] for i, corner in enumerate(corners)]
    return ca.vertcat(*lifts), ca.vertcat(*pushes)
