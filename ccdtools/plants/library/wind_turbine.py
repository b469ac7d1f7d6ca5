"""Drivetrain of a wind turbine; shaft and gear are the design."""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
from scipy.optimize import brentq

from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.library.elements import Parameters, given_or_default, limited, linear_part
from ccdtools.plants.plant import Plant
from ccdtools_ground.door import as_flag

AIR = 1.225  # kg/m³
PITCHES = (0.0, 40.0)  # °, among which the operating point is looked for


@dataclass(frozen=True)
class Turbine(Parameters):
    """Turbine of 5 MW; the last two fields are of the real one.

    Attributes
    ----------
    rotor, generator : float
        Inertias about their own shafts [kg·m²].
    damping : float
        Of the shaft [N·m·s].
    radius : float
        Of the rotor [m].
    wind, speed, power : float
        Wind [m/s], speed of the rotor [rad/s] and mechanical power [W] at the operating point.
    torque_limit : float
        Largest deviation of the real generator's torque [kN·m].
    pitch_limit : float
        Largest deviation of the real pitch [°].

    References
    ----------
    Jonkman, Butterfield, Musial and Scott, "Definition of a 5-MW Reference Wind Turbine for Offshore System
    Development", NREL/TP-500-38060, 2009: inertias, shaft (867.637 MN·m/rad, 6.215 MN·m·s, 5 % of critical damping),
    gear ratio 97, rotor of 126 m at 12.1 rpm, 5 MW at an efficiency of 94.4 %. The limits are typical values.
    """

    rotor: float = 38_759_236.0
    generator: float = 534.116
    damping: float = 6.215e6
    radius: float = 63.0
    wind: float = 16.0
    speed: float = 12.1 * math.pi / 30
    power: float = 5e6 / 0.944
    torque_limit: float = 4.0
    pitch_limit: float = 8.0


def wind_turbine(*, real: bool = False, turbine: Turbine | None = None, dt: float = 0.05) -> Plant:
    """Two inertias on an elastic shaft, about the operating point; rigid tower.

    Parameters
    ----------
    real : bool
        With the aerodynamics of the whole power coefficient, of which the nominal plant has the slopes at the operating
        point, and largest deviations of torque and pitch.
    turbine : Turbine, optional
        Inertias and operating point.
    dt : float
        Sampling time [s].

    Returns
    -------
    Plant
        x = [twist of the shaft, speed of the rotor, speed of the generator over the gear ratio],
        u = [torque of the generator [kN·m], pitch of the blades [°]], w = wind [m/s], p = [stiffness k, gear ratio n].

    Raises
    ------
    InputError
        If no pitch makes the power of the operating point.

    References
    ----------
    The power coefficient is the generic one of MathWorks' "Wind Turbine" block (Simscape Electrical, Specialized Power
    Systems), there after Heier, "Grid Integration of Wind Energy Conversion Systems".
    """
    turbine = given_or_default("turbine", turbine, Turbine)
    x = ca.SX.sym("x", 3)
    u = ca.SX.sym("u", 2)
    w = ca.SX.sym("w")
    p = ca.SX.sym("p", 2)
    twist, rotor, generator = ca.vertsplit(x)
    stiffness, ratio = ca.vertsplit(p)
    pitch = operating_pitch(turbine)
    balance = turbine.power / turbine.speed
    real = as_flag("real", real)
    braking = limited(u[0], turbine.torque_limit) if real else u[0]
    blades = limited(u[1], turbine.pitch_limit) if real else u[1]
    wind = aerodynamic_torque(turbine, turbine.speed + rotor, turbine.wind + w, pitch + blades) - balance
    if not real:
        wind = linear_part(wind, x, u, w)
    shaft = stiffness * twist + turbine.damping * (rotor - generator)
    dynamics = ca.vertcat(
        rotor - generator,
        (wind - shaft) / turbine.rotor,
        (shaft - 1e3 * ratio * braking) / (ratio**2 * turbine.generator),
    )
    design = DesignSpace(["k", "n"], lower=[4e8, 60.0], upper=[1.6e9, 120.0], units=["N·m/rad", "-"])
    names = ["twist [rad]", "rotor speed [rad/s]", "generator speed / n [rad/s]"]
    return Plant(
        x, u, w, p, dynamics, design, dt=dt, state_names=names, input_names=["generator torque [kN·m]", "pitch [°]"]
    )


def power_coefficient(speed_ratio: ca.SX, pitch: ca.SX) -> ca.SX:
    """Power coefficient [-] at a tip-speed ratio [-] and a pitch [°]."""
    inverse = 1 / (speed_ratio + 0.08 * pitch) - 0.035 / (pitch**3 + 1)
    return 0.5176 * (116 * inverse - 0.4 * pitch - 5) * ca.exp(-21 * inverse) + 0.0068 * speed_ratio


def aerodynamic_torque(turbine: Turbine, speed: ca.SX, wind: ca.SX, pitch: ca.SX) -> ca.SX:
    """Torque [N·m] on a rotor at `speed` [rad/s], `wind` [m/s] and `pitch` [°]."""
    power = AIR / 2 * math.pi * turbine.radius**2 * wind**3
    return power * power_coefficient(speed * turbine.radius / wind, pitch) / speed


def operating_pitch(turbine: Turbine) -> float:
    """Pitch [°] that gives the power of the operating point."""

    def surplus(pitch: float) -> float:
        """Power above that of the operating point, relative to it [-]."""
        torque = aerodynamic_torque(turbine, ca.SX(turbine.speed), ca.SX(turbine.wind), ca.SX(pitch))
        return float(torque) * turbine.speed / turbine.power - 1

    if surplus(PITCHES[0]) < 0 or surplus(PITCHES[1]) > 0:
        got = f"{turbine.power:g} W in wind of {turbine.wind:g} m/s at {turbine.speed:g} rad/s"
        raise InputError("turbine", got, f"an operating point for some pitch from {PITCHES[0]:g}° to {PITCHES[1]:g}°")
    return float(brentq(surplus, *PITCHES, xtol=1e-13, rtol=1e-14))
