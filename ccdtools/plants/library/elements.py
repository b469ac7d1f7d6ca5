"""Parameters and smooth, passive elements of real plants."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Self, TypeVar

import casadi as ca

from ccdtools_ground.door import as_instance, as_number, as_positive

P = TypeVar("P", bound="Parameters")
GRAVITY = 9.81  # m/s²


@dataclass(frozen=True)
class Parameters:
    """Base of a plant's physical parameters: finite, positive unless named below.

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

    def varied(self, share: float = 0.2) -> dict[str, Self]:
        """Parameters as they are, then each alone varied by a share.

        Raises
        ------
        InputError
            If the share is none, or a parameter may not be as large.
        """
        share = as_number("share", share, expected="a share between 0 and 1", low=0.0, high=1.0, strict=True)
        moves = [(field.name, sign * share) for field in fields(self) for sign in (-1, 1)]
        changed = {
            f"{name} {100 * move:+g} %": replace(self, **{name: (1 + move) * getattr(self, name)})
            for name, move in moves if getattr(self, name)
        }  # fmt: skip
        return {"nominal": self} | changed

    def _checked(self, name: str, value: Any) -> float:
        """Value of a field as a number, checked."""
        if name in self.shares:
            return as_number(name, value, expected="a share, from 0 to below 1", low=0.0, high=math.nextafter(1.0, 0.0))
        if name in self.may_be_zero:
            return as_number(name, value, expected="a finite number, at least 0", low=0.0)
        return as_positive(name, value)


def given_or_default(argument: str, given: P | None, kind: type[P]) -> P:
    """The parameters given, checked, or the default ones."""
    return kind() if given is None else as_instance(argument, given, kind, f"a {kind.__name__} or nothing")


def hardening_spring(stiffness: ca.SX, deflection: ca.SX, hardening: float) -> ca.SX:
    """k (d + h d³): spring of `stiffness` k and `hardening` h [1/m²]."""
    return stiffness * (deflection + hardening * deflection**3)


def bump_stop(deflection: ca.SX, stiffness: float, clearance: float) -> ca.SX:
    """Force of rubber stops at ±`clearance`, which stiffen to `stiffness` over a fifth of it."""
    up, down = (ca.fmax(side * deflection - clearance, 0) for side in (1, -1))
    return stiffness * (up**2 / (up + clearance / 5) - down**2 / (down + clearance / 5))


def dry_friction(force: float, speed: ca.SX, knee: float) -> ca.SX:
    """F tanh(v / v₀): Coulomb friction F, smoothed below `knee`; creeps instead of sticking."""
    return force * ca.tanh(speed / knee)


def limited(value: ca.SX, limit: float) -> ca.SX:
    """L tanh(v / L): slope one at zero, never beyond ±`limit`."""
    return limit * ca.tanh(value / limit)


def clipped(value: ca.SX, upper: float, rounding: float) -> ca.SX:
    """`value` clipped to [0, upper], corners rounded over the width `rounding`."""
    return (ca.sqrt(value**2 + rounding**2) - ca.sqrt((value - upper) ** 2 + rounding**2) + upper) / 2


def linear_part(dynamics: ca.SX, x: ca.SX, u: ca.SX, w: ca.SX) -> ca.SX:
    """A x + B u + E w of dynamics with an equilibrium at zero."""
    z = ca.vertcat(x, u, w)
    return ca.densify(ca.substitute(ca.jacobian(dynamics, z), z, ca.DM.zeros(z.shape)) @ z)
