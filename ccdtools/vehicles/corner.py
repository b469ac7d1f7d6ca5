"""One wheel of a car and its strut, linear or real."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import casadi as ca

from ccdtools.plants.library.elements import Parameters, bump_stop, dry_friction, hardening_spring, limited


def asymmetric_damper(damping: ca.SX, rate: ca.SX, asymmetry: float, knee: float) -> ca.SX:
    """Force of a damper that is stiffer in rebound than in bump.

    It is c (v + a (√(v² + v₀²) − v₀)), with slopes (1 + a) c at rates v > 0 and (1 − a) c below.
    """
    return damping * (rate + asymmetry * (ca.sqrt(rate**2 + knee**2) - knee))


@dataclass(frozen=True)
class RealStrut(Parameters):
    """Properties that real struts have beside linear ones; typical values.

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
    stop, clearance : float
        Stiffness of the bump stops [N/m], none by default, and travel at which they are met [m].
    """

    may_be_zero: ClassVar[tuple[str, ...]] = ("hardening", "friction", "stop")
    shares: ClassVar[tuple[str, ...]] = ("asymmetry",)

    hardening: float = 20.0
    asymmetry: float = 0.3
    knee: float = 0.1
    friction: float = 40.0
    sliding: float = 0.02
    force_limit: float = 2500.0
    stop: float = 0.0
    clearance: float = 0.05


@dataclass(frozen=True)
class Corner:
    """One wheel and its strut, with forces beyond the static ones."""

    spring: ca.SX  # of the strut [N/m]
    damper: ca.SX  # of the strut [N·s/m]
    tyre: float  # stiffness [N/m]
    load: float  # static load of the tyre [N]
    strut: RealStrut  # what is not linear
    nonlinear: bool  # whether the spring hardens, the damper is asymmetric and there are bump stops
    real: bool  # whether there is dry friction, too, a largest active force, and a tyre that cannot pull

    def passive(self, travel: ca.SX, rate: ca.SX) -> ca.SX:
        """Force [N] that pulls body and wheel together, by distance [m] and rate [m/s]."""
        if not (self.nonlinear or self.real):
            return self.spring * travel + self.damper * rate
        strut = self.strut
        force = hardening_spring(self.spring, travel, strut.hardening)
        force += asymmetric_damper(self.damper, rate, strut.asymmetry, strut.knee)
        force += bump_stop(travel, strut.stop, strut.clearance)
        return force + dry_friction(strut.friction, rate, strut.sliding) if self.real else force

    def active(self, u: ca.SX) -> ca.SX:
        """Force [N] of the actuator for a demanded `u`."""
        return limited(u, self.strut.force_limit) if self.real else u

    def ground(self, deflection: ca.SX) -> ca.SX:
        """Upward force [N] of the road on the wheel at a `deflection` [m] from rest."""
        if not self.real:
            return -self.tyre * deflection
        rounding = 0.1 * self.load  # of the corner at which the tyre leaves the road
        contact = self.load - self.tyre * deflection
        at_rest = (self.load + (self.load**2 + rounding**2) ** 0.5) / 2
        force: ca.SX = (contact + ca.sqrt(contact**2 + rounding**2)) / 2 - at_rest
        return force
