"""Parameters, elements and corners of real plants; elements are smooth, zero at rest and passive."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, ClassVar, TypeVar

import casadi as ca

from ccdtools.checks import as_instance, as_number, as_positive

P = TypeVar("P", bound="Parameters")
GRAVITY = 9.81  # m/s²
ROUNDING = 0.1  # of the static load, over which the tyre leaves the road


@dataclass(frozen=True)
class Parameters:
    """Base of the physical parameters of a plant: finite numbers, positive unless one of these names them.

    Attributes
    ----------
    may_be_zero : tuple of str
        Fields that are at least 0.
    shares : tuple of str
        Fields from 0 to below 1.
    """

    may_be_zero: ClassVar[tuple[str, ...]] = ()
    shares: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for field in fields(self):
            object.__setattr__(self, field.name, self._checked(field.name, getattr(self, field.name)))

    def _checked(self, name: str, value: Any) -> float:
        """The value of a field as a number, if it is one that the field can have."""
        if name in self.shares:
            return as_number(name, value, expected="a share, from 0 to below 1", low=0.0, high=math.nextafter(1.0, 0.0))
        if name in self.may_be_zero:
            return as_number(name, value, expected="a finite number, at least 0", low=0.0)
        return as_positive(name, value)


def given_or_default(argument: str, given: P | None, kind: type[P]) -> P:
    """The parameters that were given, checked; those of the source where there are none."""
    return kind() if given is None else as_instance(argument, given, kind, f"a {kind.__name__} or nothing")


def hardening_spring(stiffness: ca.SX, deflection: ca.SX, hardening: float) -> ca.SX:
    """k (d + h d³): `hardening` h [1/m²] of a spring of `stiffness` k at zero deflection."""
    return stiffness * (deflection + hardening * deflection**3)


def asymmetric_damper(damping: ca.SX, rate: ca.SX, asymmetry: float, knee: float) -> ca.SX:
    """c (v + a (√(v² + v₀²) − v₀)): slope c at rest, (1 + a) c in rebound and (1 − a) c in bump beyond the knee v₀."""
    return damping * (rate + asymmetry * (ca.sqrt(rate**2 + knee**2) - knee))


def dry_friction(force: float, speed: ca.SX, knee: float) -> ca.SX:
    """F tanh(v / v₀): Coulomb friction F, smoothed below the speed `knee`; it creeps where a real one sticks."""
    return force * ca.tanh(speed / knee)


def limited(value: ca.SX, limit: float) -> ca.SX:
    """L tanh(v / L): slope one at zero, never beyond ±`limit`."""
    return limit * ca.tanh(value / limit)


def clipped(value: ca.SX, upper: float, rounding: float) -> ca.SX:
    """`value` clipped to [0, upper], its corners rounded over the width `rounding`."""
    return (ca.sqrt(value**2 + rounding**2) - ca.sqrt((value - upper) ** 2 + rounding**2) + upper) / 2


def linear_part(dynamics: ca.SX, x: ca.SX, u: ca.SX, w: ca.SX) -> ca.SX:
    """A x + B u + E w of dynamics with an equilibrium at zero."""
    z = ca.vertcat(x, u, w)
    return ca.densify(ca.substitute(ca.jacobian(dynamics, z), z, ca.DM.zeros(z.shape)) @ z)


@dataclass(frozen=True)
class RealStrut(Parameters):
    """What real struts have that linear ones lack; typical values, of no particular car.

    Attributes
    ----------
    hardening : float
        Of the spring, k (d + h d³) [1/m²].
    asymmetry : float
        Of the damper: 1 + a times its damping in rebound, 1 − a times in bump [-].
    knee : float
        Speed above which that holds [m/s].
    friction, sliding : float
        Dry friction of the strut [N], smoothed below a speed [m/s].
    force_limit : float
        Of the actuator [N].
    """

    may_be_zero: ClassVar[tuple[str, ...]] = ("hardening", "friction")
    shares: ClassVar[tuple[str, ...]] = ("asymmetry",)

    hardening: float = 20.0
    asymmetry: float = 0.3
    knee: float = 0.1
    friction: float = 40.0
    sliding: float = 0.02
    force_limit: float = 2500.0


@dataclass(frozen=True)
class Corner:
    """One wheel and what joins it to the body; all forces are beyond the static ones.

    Attributes
    ----------
    spring, damper : casadi.SX
        Of the strut [N/m], [N·s/m].
    tyre : float
        Stiffness [N/m].
    load : float
        Static load of the tyre [N].
    strut : RealStrut
        What is not linear.
    nonlinear : bool
        Whether the spring hardens and the damper is asymmetric.
    real : bool
        Whether there is dry friction, too, a largest active force, and a tyre that cannot pull.
    """

    spring: ca.SX
    damper: ca.SX
    tyre: float
    load: float
    strut: RealStrut
    nonlinear: bool
    real: bool

    def passive(self, travel: ca.SX, rate: ca.SX) -> ca.SX:
        """Force that pulls body and wheel together [N], by their distance [m] and its rate [m/s]."""
        if not (self.nonlinear or self.real):
            return self.spring * travel + self.damper * rate
        strut = self.strut
        force = hardening_spring(self.spring, travel, strut.hardening)
        force += asymmetric_damper(self.damper, rate, strut.asymmetry, strut.knee)
        return force + dry_friction(strut.friction, rate, strut.sliding) if self.real else force

    def active(self, u: ca.SX) -> ca.SX:
        """Force that the actuator gives where `u` is asked for [N]."""
        return limited(u, self.strut.force_limit) if self.real else u

    def ground(self, deflection: ca.SX) -> ca.SX:
        """Upward force of the road on the wheel [N], `deflection` [m] above where it stands at rest."""
        if not self.real:
            return -self.tyre * deflection
        rounding = ROUNDING * self.load
        contact = self.load - self.tyre * deflection
        at_rest = (self.load + (self.load**2 + rounding**2) ** 0.5) / 2
        return (contact + ca.sqrt(contact**2 + rounding**2)) / 2 - at_rest
