"""Quarter car with an active suspension; spring and damper are the design."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.library.elements import GRAVITY, Parameters, given_or_default
from ccdtools.plants.plant import Plant
from ccdtools.vehicles.corner import Corner, RealStrut
from ccdtools_ground.door import as_flag

SOFTEST = 0.1  # Least damping of a damper that is set, as a part of the largest [-]
STATES = ("z_us − z₀ [m]", "ż_us [m/s]", "z_s − z_us [m]", "ż_s [m/s]")


@dataclass(frozen=True)
class QuarterCar(Parameters):
    """Masses, tyre and actuator.

    Attributes
    ----------
    sprung, unsprung : float
        Masses of body and wheel [kg].
    tyre : float
        Stiffness [N/m].
    lag : float
        Time constant of the actuator [s].

    References
    ----------
    Masses and tyre: Allison, Guo and Han, "Co-design of an active suspension using simultaneous dynamic optimization",
    Journal of Mechanical Design 136, 2014. Lag: "Robust Control of Active Suspension", an example of MathWorks' Robust
    Control Toolbox, whose hydraulic actuator is 1 / (1 + s/60).
    """

    sprung: float = 325.0
    unsprung: float = 65.0
    tyre: float = 232.5e3
    lag: float = 1 / 60


def quarter_car(*, nonlinear: bool = False, actuator_lag: bool = False, semi_active: bool = False, real: bool = False,
                car: QuarterCar | None = None, strut: RealStrut | None = None, dt: float = 0.01) -> Plant:  # fmt: skip
    """Quarter car about its static equilibrium.

    Parameters
    ----------
    nonlinear : bool
        Whether the spring hardens and the damper is stiffer in rebound than in bump; slopes at rest stay the same.
    actuator_lag : bool
        Whether the active force follows u with a lag, as a fifth state.
    semi_active : bool
        Whether there is no actuator, and u from −1 to 1 sets the damper between a tenth of c_s and c_s.
    real : bool
        Nonlinear, and besides with dry friction (smoothed), a largest active force and a tyre that cannot pull.
    car : QuarterCar, optional
        Masses, tyre and actuator.
    strut : RealStrut, optional
        What makes the strut nonlinear and real.
    dt : float
        Sampling time [s]; the 0.05 s of Tsai et al. hardly resolve the wheel hop, and `discretise` says so.

    Returns
    -------
    Plant
        x = [tyre deflection, wheel speed, suspension travel, body speed (, active force)], u = active force [N],
        w = vertical speed of the road under the wheel [m/s], p = [spring k_s, damper c_s].
    """
    car = given_or_default("car", car, QuarterCar)
    lagging = as_flag("actuator_lag", actuator_lag)
    if as_flag("semi_active", semi_active) and lagging:
        raise InputError("semi_active, actuator_lag", "both", "one of them: a damper that is set has no actuator")
    x = ca.SX.sym("x", 5 if lagging else 4)
    u = ca.SX.sym("u")
    w = ca.SX.sym("w")
    p = ca.SX.sym("p", 2)
    damping = p[1] * (SOFTEST + (1 - SOFTEST) * (1 + u) / 2) if semi_active else p[1]
    corner = Corner(
        p[0], damping, car.tyre, GRAVITY * (car.sprung + car.unsprung), given_or_default("strut", strut, RealStrut),
        nonlinear=as_flag("nonlinear", nonlinear), real=as_flag("real", real),
    )  # fmt: skip
    deflection, wheel, travel, body = ca.vertsplit(x[:4])
    demanded = 0 * u if semi_active else corner.active(u)
    lift = (x[4] if lagging else demanded) - corner.passive(travel, body - wheel)
    ground = corner.ground(deflection)
    dynamics = ca.vertcat(wheel - w, (ground - lift) / car.unsprung, body - wheel, lift / car.sprung)
    names = list(STATES)
    if lagging:
        dynamics = ca.vertcat(dynamics, (demanded - x[4]) / car.lag)
        names.append("active force [N]")
    least, most = (1000.0, 6000.0) if semi_active else (500.0, 3000.0)
    design = DesignSpace(["k_s", "c_s"], lower=[1e4, least], upper=[4e4, most], units=["N/m", "N·s/m"])
    inputs = ["damper [-]" if semi_active else "u [N]"]
    return Plant(x, u, w, p, dynamics, design, dt=dt, state_names=names, input_names=inputs)
