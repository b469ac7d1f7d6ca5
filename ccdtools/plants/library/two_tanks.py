"""Two tanks, one above the other, about a steady state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import casadi as ca

from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.library.elements import Parameters, clipped, given_or_default, linear_part
from ccdtools.plants.plant import Plant
from ccdtools_ground.door import as_flag


@dataclass(frozen=True)
class Tanks(Parameters):
    """Pump, outlet and operating point; the last three fields are of the real tanks.

    Attributes
    ----------
    outlet : float
        Area of the hole in the lower tank [cm²].
    pump : float
        Flow per voltage [cm³/(V·s)].
    gravity : float
        [cm/s²].
    level : float
        Of the lower tank at the operating point [cm].
    near_empty : float
        Level below which the outflow is regularised [cm].
    voltage_limit : float
        Of the real pump, which does not draw either [V].
    clogged : float
        Part of the outlets that is closed in the real tanks [-].
    leak : float
        Area of a leak in the real upper tank, which drains outside [cm²].

    References
    ----------
    Johansson, "The quadruple-tank process: a multivariable laboratory process with an adjustable zero", IEEE
    Transactions on Control Systems Technology 8, 2000: tanks 3 and 1, which are one above the other, of 28 cm² with
    holes of 0.071 cm², g = 981 cm/s²; the flow per voltage is that of its first pump. The rest are typical values.
    """

    may_be_zero: ClassVar[tuple[str, ...]] = ("leak",)
    shares: ClassVar[tuple[str, ...]] = ("clogged",)

    outlet: float = 0.071
    pump: float = 3.33
    gravity: float = 981.0
    level: float = 10.0
    near_empty: float = 0.1
    voltage_limit: float = 10.0
    clogged: float = 0.1
    leak: float = 0.005


def two_tanks(*, linear: bool = False, real: bool = False, absolute: bool = False, tanks: Tanks | None = None,
              dt: float = 1.0) -> Plant:  # fmt: skip
    """Two tanks, the upper one filled by a pump.

    A hole of area a lets out a √(2g) h / (h² + ε²)^¼, which is Torricelli's a √(2gh) but for a part ε²/(4h²) of it, and
    is smooth where a tank is empty; ε is `Tanks.near_empty`.

    Parameters
    ----------
    linear : bool
        The linearisation at the operating point instead.
    real : bool
        With outlets partly clogged, a leak and a pump that neither draws nor exceeds a voltage (corners rounded, so
        that at 0 V it still pumps as at 0.01 V). Its steady state is not the model's. Overflow is not modelled.
    absolute : bool
        Whether x are levels and u is a voltage, instead of deviations from the operating point.
    tanks : Tanks, optional
        Pump, outlet and operating point.
    dt : float
        Sampling time [s].

    Returns
    -------
    Plant
        x = [upper level, lower level] [cm], u = voltage [V], w = other inflows into the tanks [cm³/s],
        p = [areas A_1 and A_2 of the tanks, area a_1 of the upper outlet]. The upper level of the operating point
        depends on a_1 (see `operating_point`).
    """
    tanks = given_or_default("tanks", tanks, Tanks)
    linear = as_flag("linear", linear)
    absolute = as_flag("absolute", absolute)
    if as_flag("real", real) and linear:
        raise InputError("linear", True, "False where real=True", "A real plant is not linear.")
    if linear and absolute:
        raise InputError("linear", True, "False where absolute=True", "The linear plant is in deviations.")
    x = ca.SX.sym("x", 2)
    u = ca.SX.sym("u")
    w = ca.SX.sym("w", 2)
    p = ca.SX.sym("p", 3)
    levels, voltage = operating_point(tanks, p)
    dynamics = _dynamics(x if absolute else levels + x, u if absolute else voltage + u, w, p, tanks, real=real)
    if linear:
        dynamics = linear_part(dynamics, x, u, w)
    design = DesignSpace(["A_1", "A_2", "a_1"], [14.0, 14.0, 0.055], [56.0, 56.0, 0.1], ["cm²", "cm²", "cm²"])
    names = ["upper level [cm]", "lower level [cm]"]
    return Plant(x, u, w, p, dynamics, design, dt=dt, state_names=names, input_names=["voltage [V]"])


def operating_point(tanks: Tanks, p: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Steady-state levels (2, 1) [cm] and voltage [V] at design p."""
    outflow = tanks.outlet * _torricelli(tanks, ca.SX(tanks.level))
    root = (outflow / p[2]) ** 2 / (2 * tanks.gravity)  # h² / √(h² + ε²) of the upper level h
    upper = ca.sqrt((root**2 + root * ca.sqrt(root**2 + 4 * tanks.near_empty**2)) / 2)
    return ca.vertcat(upper, tanks.level), outflow / tanks.pump


def _torricelli(tanks: Tanks, level: ca.SX) -> ca.SX:
    """Outflow speed [cm/s] at a level [cm]."""
    speed: ca.SX = (2 * tanks.gravity) ** 0.5 * level / (level**2 + tanks.near_empty**2) ** 0.25
    return speed


def _dynamics(x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX, tanks: Tanks, *, real: bool) -> ca.SX:
    """Balance of volumes, in levels and voltage."""
    open_part = 1 - tanks.clogged if real else 1.0
    voltage = clipped(u, tanks.voltage_limit, rounding=0.02) if real else u
    leak = tanks.leak * _torricelli(tanks, x[0]) if real else 0.0
    upper = open_part * p[2] * _torricelli(tanks, x[0])
    lower = open_part * tanks.outlet * _torricelli(tanks, x[1])
    return ca.vertcat((tanks.pump * voltage + w[0] - upper - leak) / p[0], (upper + w[1] - lower) / p[1])
