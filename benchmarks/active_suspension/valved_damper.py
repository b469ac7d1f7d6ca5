"""A hydraulic damper whose piston presses oil through a spring-loaded valve: damping, pressure and lift."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from ccdtools.plants.library.elements import Parameters


@dataclass(frozen=True)
class DamperValve(Parameters):
    """Oil, valve and what they bear.

    Attributes
    ----------
    density : float
        Of the oil [kg/m³].
    spring : float
        Stiffness that holds the valve closed [N/m].
    area : float
        Part of the curtain around the lifted valve that the oil flows through [-].
    exposed : float
        Part of the valve's circumference that opens [-].
    discharge : float
        Coefficient of the flow [-].
    pressure, speed, lift : float
        Largest pressure of the oil [Pa], speed of the piston [m/s] and lift of the valve [m].

    References
    ----------
    Allison, Guo and Han, "Co-design of an active suspension using simultaneous dynamic optimization", Journal of
    Mechanical Design 136, 2014; values as in the code of Sundarrajan and Herber, American Control Conference, 2021.
    """

    shares: ClassVar[tuple[str, ...]] = ("area", "exposed", "discharge")

    density: float = 850.0
    spring: float = 7500.0
    area: float = 0.1
    exposed: float = 0.9
    discharge: float = 0.7
    pressure: float = 4.75e6
    speed: float = 5.0
    lift: float = 0.03


@dataclass(frozen=True)
class ValvedDamper:
    """A damper by its dimensions: numbers or CasADi expressions.

    The force grows with the pressure to the power 3/2 as the valve opens; the damping is the constant one that meets it
    at the largest pressure.

    Attributes
    ----------
    valve_diameter, piston, stroke : number or casadi.SX
        [m].
    valve : DamperValve
    """

    valve_diameter: Any
    piston: Any
    stroke: Any
    valve: DamperValve

    @property
    def face(self) -> Any:
        """Area of the piston [m²]."""
        return math.pi * self.piston**2 / 4

    @property
    def damping(self) -> Any:
        """[N·s/m]."""
        valve = self.valve
        opening = valve.exposed * valve.area * math.pi * self.valve_diameter * self._lift(valve.pressure)
        flow = valve.discharge * opening * math.sqrt(2 * valve.pressure / valve.density)
        return valve.pressure * self.face**2 / flow

    def pressure(self, speed: Any) -> Any:
        """Of the oil, at a speed of the piston [Pa]."""
        return self.damping * speed / self.face

    def lift(self, speed: Any) -> Any:
        """Of the valve, at a speed of the piston [m]."""
        return self._lift(self.pressure(speed))

    def _lift(self, pressure: Any) -> Any:
        """Of the valve, at a pressure [m]."""
        return math.pi * self.valve_diameter**2 / 4 * pressure / self.valve.spring
