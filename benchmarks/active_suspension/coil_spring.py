"""A helical compression spring of round wire with squared and ground ends: stiffness, lengths, stress and strength."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from ccdtools.plants.library.elements import Parameters

MILLIMETRE = 1e-3  # m, the wire that the strength of a steel is stated for
CLOSED = 0.75  # turns that a spring pressed solid has beyond its active coils


@dataclass(frozen=True)
class SpringSteel(Parameters):
    """Wire that a spring is coiled from: chrome-silicon, unpeened.

    Attributes
    ----------
    shear_modulus : float
        [Pa].
    strength : float
        In tension, of a wire of 1 mm [Pa]; of one of d mm it is that over d to the power of `exponent`.
    exponent : float
        [-].
    yielding, endurance : float
        In shear, as shares of the strength in tension [-].
    amplitude : float
        Of the shear stress that is borne for ever, whatever the strength (Zimmerli) [Pa].

    References
    ----------
    Budynas and Nisbett, Shigley's Mechanical Engineering Design, chapter 10: strength of chrome-silicon wire (table of
    the constants A and m), endurance after Zimmerli. Shares: those of Allison, Guo and Han 2014, as in the code of
    Sundarrajan and Herber 2021.
    """

    shares: ClassVar[tuple[str, ...]] = ("exponent", "yielding", "endurance")

    shear_modulus: float = 77.2e9
    strength: float = 1974e6
    exponent: float = 0.108
    yielding: float = 0.65
    endurance: float = 0.24
    amplitude: float = 241e6


@dataclass(frozen=True)
class CoilSpring:
    """A spring by its dimensions: numbers or CasADi expressions.

    Attributes
    ----------
    wire, helix : number or casadi.SX
        Diameter of the wire and mean diameter of the helix [m].
    pitch : number or casadi.SX
        Unloaded [m].
    coils : number or casadi.SX
        Active ones [-].
    steel : SpringSteel

    References
    ----------
    Budynas and Nisbett, Shigley's Mechanical Engineering Design, chapter 10.
    """

    wire: Any
    helix: Any
    pitch: Any
    coils: Any
    steel: SpringSteel

    @property
    def index(self) -> Any:
        """C = D/d [-]."""
        return self.helix / self.wire

    @property
    def stiffness(self) -> Any:
        """Of torsion and direct shear of the wire [N/m]."""
        torsion = self.steel.shear_modulus * self.wire**4 / (8 * self.helix**3 * self.coils)
        return torsion / (1 + 1 / (2 * self.index**2))

    @property
    def free_length(self) -> Any:
        """Unloaded [m]."""
        return self.pitch * self.coils + 2 * self.wire

    @property
    def solid_length(self) -> Any:
        """With all coils touching [m]."""
        return self.wire * (self.coils + CLOSED)

    @property
    def room(self) -> Any:
        """From unloaded to solid [m]."""
        return self.free_length - self.solid_length

    def stress(self, force: Any) -> Any:
        """Largest shear stress under an axial force [Pa], with Bergsträsser's factor."""
        factor = (4 * self.index + 2) / (4 * self.index - 3)
        return factor * 8 * force * self.helix / (math.pi * self.wire**3)

    @property
    def strength(self) -> Any:
        """Of the wire in tension [Pa]."""
        return self.steel.strength / (self.wire / MILLIMETRE) ** self.steel.exponent

    @property
    def yield_stress(self) -> Any:
        """In shear [Pa]."""
        return self.steel.yielding * self.strength

    @property
    def endurance_stress(self) -> Any:
        """In shear [Pa]."""
        return self.steel.endurance * self.strength
