"""A quarter car whose spring and damper are designed by their dimensions, with the rules of machine design."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from active_suspension.coil_spring import CoilSpring, SpringSteel
from active_suspension.valved_damper import DamperValve, ValvedDamper
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.library.elements import GRAVITY, Parameters, given_or_default
from ccdtools.plants.plant import Plant
from ccdtools.vehicles.quarter_car import STATES, QuarterCar
from ccdtools_ground.door import as_flag

NAMES = ("d", "D", "p", "N_a", "D_o", "D_p", "D_s")
LOWER = (0.005, 0.05, 0.02, 3.0, 0.003, 0.03, 0.1)
UPPER = (0.02, 0.4, 0.5, 16.0, 0.012, 0.08, 0.3)
UNITS = ("m", "m", "m", "-", "m", "m", "m")


@dataclass(frozen=True)
class StrutRules(Parameters):
    """Room for a strut whose damper stands inside its spring, and how it may be used.

    Attributes
    ----------
    pocket_length, pocket_diameter : float
        Of the room [m].
    clearance, wall : float
        Between damper and spring, and thickness of the damper's wall [m].
    fittings : float
        Length of a damper beside twice its stroke [m].
    bump_stop : float
        Travel that is kept before the spring is solid [m].
    safety : float
        Factor on stresses [-].
    least_index, largest_index : float
        D/d of springs that can be coiled and do not tangle [-].
    slenderness : float
        Free length, in diameters of the helix, beyond which a spring between flat plates buckles [-].
    reserve : float
        Part of the travel to solid that is kept as the stiffness grows there [-].
    surplus : float
        Factor on travel for roads that are worse than the one at hand [-].

    References
    ----------
    Allison, Guo and Han 2014, values as in the code of Sundarrajan and Herber 2021 (see `detailed_active_suspension`).
    Index, slenderness and reserve: Budynas and Nisbett, Shigley's Mechanical Engineering Design, chapter 10.
    """

    pocket_length: float = 0.40
    pocket_diameter: float = 0.25
    clearance: float = 0.009
    wall: float = 0.002
    fittings: float = 0.06
    bump_stop: float = 0.02
    safety: float = 1.2
    least_index: float = 4.0
    largest_index: float = 12.0
    slenderness: float = 5.26
    reserve: float = 0.15
    surplus: float = 1.1


@dataclass(frozen=True)
class Strut:
    """A spring around a damper that carries a car: its rules as parts of what is allowed, less 1; ≤ 0 keeps them.

    Attributes
    ----------
    spring : CoilSpring
    damper : ValvedDamper
    rules : StrutRules
    load : float
        That the spring carries at rest [N].
    """

    spring: CoilSpring
    damper: ValvedDamper
    rules: StrutRules
    load: float

    @classmethod
    def of(cls, p: ca.SX, steel: SpringSteel, valve: DamperValve, rules: StrutRules, load: float) -> Strut:
        """The strut of a design (7,)."""
        spring = CoilSpring(p[0], p[1], p[2], p[3], steel)
        return cls(spring, ValvedDamper(p[4], p[5], p[6], valve), rules, load)

    @property
    def sag(self) -> ca.SX:
        """Deflection of the spring at rest [m]."""
        return self.load / self.spring.stiffness

    def of_design(self) -> dict[str, ca.SX]:
        """Rules of the dimensions alone."""
        spring, damper, rules = self.spring, self.damper, self.rules
        length, across = spring.free_length, spring.wire + damper.piston + 2 * (rules.clearance + rules.wall)
        solid = rules.safety * spring.stress(spring.stiffness * spring.room)
        return {
            "coiling": rules.least_index / spring.index - 1,
            "tangling": spring.index / rules.largest_index - 1,
            "buckling": length / (rules.slenderness * spring.helix) - 1,
            "pocket length": length / rules.pocket_length - 1,
            "pocket diameter": (spring.wire + spring.helix) / rules.pocket_diameter - 1,
            "damper inside spring": across / spring.helix - 1,
            "stress when solid": solid / spring.yield_stress - 1,
            "damper stroke": spring.room / damper.stroke - 1,
            "damper length": 2 * damper.stroke / (rules.pocket_length - rules.fittings) - 1,
        }

    def at_rest(self) -> dict[str, ca.SX]:
        """What is left of the rules of travel where the car stands: a design that breaks them has no trajectory."""
        return {
            "bump stop at rest": self.bump_stop(0),
            "linear range at rest": self.linear_range(0),
            "fatigue at rest": self.soderberg(0),
        }

    def bump_stop(self, travel: Any) -> ca.SX:
        """Travel [m] up to the stop."""
        return (self.sag + travel + self.rules.bump_stop) / self.spring.room - 1

    def linear_range(self, travel: Any) -> ca.SX:
        """Travel [m] over which the spring is linear."""
        return (1 + self.rules.reserve) * (self.sag + self.rules.surplus * travel) / self.spring.room - 1

    def soderberg(self, travel: Any) -> ca.SX:
        """Fatigue under the load at rest and an amplitude of travel [m]."""
        spring = self.spring
        amplitude = self.rules.safety * spring.stress(spring.stiffness * travel) / spring.endurance_stress
        return amplitude + spring.stress(self.load) / spring.yield_stress - 1

    def zimmerli(self, travel: Any) -> ca.SX:
        """Fatigue under an amplitude of travel [m], whatever the load at rest."""
        spring = self.spring
        return self.rules.safety * spring.stress(spring.stiffness * travel) / spring.steel.amplitude - 1

    def of_speed(self, speed: ca.SX) -> dict[str, ca.SX]:
        """Rules of the damper at a speed [m/s]."""
        damper = self.damper
        return {
            "oil pressure": damper.pressure(speed) / damper.valve.pressure - 1,
            "valve lift": damper.lift(speed) / damper.valve.lift - 1,
            "piston speed": speed / damper.valve.speed - 1,
        }

    def along(self, travel: ca.SX, speed: ca.SX, published: bool) -> dict[str, ca.SX]:
        """Rules of travel [m] and its rate [m/s], both positive as the strut gets longer."""
        bump = travel if published else -travel
        rules = {"bump stop": self.bump_stop(bump), "linear range": self.linear_range(bump)}
        ways = {"": travel} if published else {" in rebound": travel, " in bump": -travel}
        for way, amplitude in ways.items():
            rules |= {f"Soderberg{way}": self.soderberg(amplitude), f"Zimmerli{way}": self.zimmerli(amplitude)}
        for way, rate in {" in rebound": speed, " in bump": -speed}.items():
            rules |= {f"{name}{way}": rule for name, rule in self.of_speed(rate).items()}
        return rules


def detailed_active_suspension(*, published: bool = False, car: QuarterCar | None = None,
                               steel: SpringSteel | None = None, valve: DamperValve | None = None,
                               rules: StrutRules | None = None, dt: float = 0.002) -> Plant:  # fmt: skip
    """A linear quarter car about its static equilibrium; dimensions of spring and damper are the design.

    What holds along a trajectory (bump stop, linear range, fatigue, damper) is stated by the plant's outputs, each to
    be ≤ 0; what holds of the dimensions alone by the constraints of its design space.

    Parameters
    ----------
    published : bool
        Whether bump stop, linear range and fatigue limit the strut as it gets longer alone, as the authors' code has
        it. By default the first two limit it as it gets shorter, and fatigue limits it both ways.
    car : QuarterCar, optional
        Masses and tyre; without lag.
    steel : SpringSteel, optional
    valve : DamperValve, optional
    rules : StrutRules, optional
    dt : float
        Sampling time [s]; the stiffest design of the box oscillates at 43 Hz.

    Returns
    -------
    Plant
        x = [tyre deflection, wheel speed, suspension travel, body speed], u = active force [N], w = vertical speed of
        the road under the wheel [m/s]; p = [wire diameter d, helix diameter D, pitch p, active coils N_a of the spring,
        valve diameter D_o, piston diameter D_p, stroke D_s of the damper].

    References
    ----------
    Allison, Guo and Han, "Co-design of an active suspension using simultaneous dynamic optimization", Journal of
    Mechanical Design 136, 081003, 2014. Sundarrajan and Herber, "Towards a fair comparison between the nested and
    simultaneous control co-design methods using an active suspension case study", American Control Conference, 2021;
    the statement and its values as in their code (github.com/danielrherber/dt-qp-project, examples/ACC2021).
    """
    car = given_or_default("car", car, QuarterCar)
    x = ca.SX.sym("x", 4)
    u = ca.SX.sym("u")
    w = ca.SX.sym("w")
    p = ca.SX.sym("p", len(NAMES))
    parts = (
        given_or_default("steel", steel, SpringSteel),
        given_or_default("valve", valve, DamperValve),
        given_or_default("rules", rules, StrutRules),
    )
    load = GRAVITY * car.sprung
    strut = Strut.of(p, *parts, load)
    deflection, wheel, travel, body = ca.vertsplit(x)
    lift = u - strut.spring.stiffness * travel - strut.damper.damping * (body - wheel)
    ground = -car.tyre * deflection
    dynamics = ca.vertcat(wheel - w, (ground - lift) / car.unsprung, body - wheel, lift / car.sprung)
    kept = strut.along(travel, body - wheel, as_flag("published", published))
    of_design = strut.of_design() | strut.at_rest()
    design = DesignSpace(
        NAMES, LOWER, UPPER, UNITS, ca.Function("rules", [p], [ca.vertcat(*of_design.values())]), list(of_design),
    )  # fmt: skip
    return Plant(
        x, u, w, p, dynamics, design, dt=dt, state_names=STATES, input_names=["u [N]"],
        outputs=ca.vertcat(*kept.values()), output_names=list(kept), output_limits=(-float("inf"), 0.0),
    )  # fmt: skip
