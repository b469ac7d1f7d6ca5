"""A semi-active car for two drivers, by ISO 2631.

Spring and damper are the design. A sample costs the square of the acceleration that passengers feel, weighted as
ISO 2631 says by a filter of second order, and those of tyre deflection and travel, beside tolerable sizes.
"""

from dataclasses import replace
from operator import attrgetter

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.configuration import CoDesignConfig
from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.disturbances.combinations import Cases
from ccdtools.estimation.measurement import Measurement
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.library import quarter_car
from ccdtools.plants.plant import Plant
from ccdtools.studies.cases._cars import by_kind, quarter_car_ride, stop
from ccdtools.studies.real_plant import RealPlant
from ccdtools.studies.study import Study
from ccdtools.trajectory import Trajectory
from ccdtools.twin.online import OnlineConfig
from ccdtools.vehicles.corner import RealStrut
from ccdtools.vehicles.iso8608 import RoadClass
from ccdtools.vehicles.iso_road import ISORoad
from ccdtools.vehicles.roads import Driver
from ccdtools.vehicles.semi_active import clipped_lqr, skyhook
from invariant_sets import Polytope
from learning import CloningConfig

GOOD = {"tyre": 0.005, "travel": 0.05, "felt acceleration": 1.0}  # tolerable sizes [m, m, m/s²], by Bryson's rule


def with_felt_acceleration(car: Plant) -> Plant:
    """Car with W_k of ISO 2631 as two more states.

    Its outputs are the accelerations of body and wheel and the travel.

    References
    ----------
    Zuo and Nayfeh, "Low order continuous-time filters for approximation of the ISO 2631-1 human vibration sensitivity
    weightings", Journal of Sound and Vibration 265, 2003; within 5 % of the standard from 3 to 31 Hz.
    """
    f, body = ca.SX.sym("f", 2), car.dynamics[3]
    filtered = ca.vertcat(f[1] - 82.17 * f[0] + 86.51 * body, 546.1 * body - 1892 * f[0])
    names = [*car.state_names, "felt acceleration [m/s²]", "state of the filter [m/s³]"]
    return Plant(
        ca.vertcat(car.x, f), car.u, car.w, car.p, ca.vertcat(car.dynamics, filtered), car.design, dt=car.dt,
        state_names=names, input_names=car.input_names, outputs=ca.vertcat(body, car.dynamics[1], car.x[2]),
        output_names=["body acceleration [m/s²]", "wheel acceleration [m/s²]", "travel [m]"],
    )  # fmt: skip


def sensors(car: Plant) -> Measurement:
    """Accelerometers and the sensor of the travel."""
    return Measurement(car, noise=[0.1, 0.5, 0.002])  # m/s², m/s², m


LINEAR = RealStrut(hardening=0.0, asymmetry=0.0, stop=3e5)
NOMINAL = with_felt_acceleration(quarter_car(semi_active=True, nonlinear=True, strut=LINEAR))
REAL = with_felt_acceleration(
    quarter_car(semi_active=True, real=True, strut=RealStrut(hardening=40.0, asymmetry=0.4, friction=100.0, stop=4e5))
)


def unknown_car() -> Plant:
    """Real car of unknown friction, asymmetry, hardening and stops.

    It is linear in these, which follow the entries of the design.
    """
    most = {"friction": (300.0, "N"), "asymmetry": (0.9, "-"), "hardening": (150.0, "1/m²"), "stop": (6e5, "N/m")}
    plain, *others = (
        with_felt_acceleration(
            quarter_car(semi_active=True, real=True, strut=RealStrut(**dict.fromkeys(most, 0.0) | one))
        )
        for one in ({}, *({name: size} for name, (size, _) in most.items()))
    )
    entries, size = ca.SX.sym("entries", len(most)), np.array([size for size, _ in most.values()])
    dynamics, outputs = (
        ca.cse(
            own(plain)
            + sum(
                entry * (_in_symbols(own(other), other, plain) - own(plain))
                for entry, other in zip(ca.vertsplit(entries / size), others)
            )
        )
        for own in (attrgetter("dynamics"), attrgetter("outputs"))
    )
    box = plain.design
    design = DesignSpace(
        [*box.names, *most], [*box.lower, *(0 * size)], [*box.upper, *size],
        [*box.units, *(unit for _, unit in most.values())],
    )  # fmt: skip
    return replace(plain, p=ca.vertcat(plain.p, entries), dynamics=dynamics, outputs=outputs, design=design)


def _in_symbols(expression: ca.SX, of: Plant, plant: Plant) -> ca.SX:
    """Expression in another plant's symbols."""
    own, other = (ca.vertcat(one.x, one.u, one.w, one.p) for one in (of, plant))
    return ca.substitute(expression, own, other)


LIMITS = np.append(by_kind(["tyre", "wheel speed", "travel", "heave rate"])[0], [20.0, 1000.0])  # m/s², m/s³
Q = np.diag([GOOD["tyre"] ** -2, 0.0, GOOD["travel"] ** -2, 0.0, GOOD["felt acceleration"] ** -2, 0.0])


def parts(p: ca.SX) -> ca.SX:
    """Price of spring, whose steel grows with the energy it stores, and damper, in units of the return."""
    return 400 * (25e3 / p[0]) + 250 * (p[1] / 2500)


def weights(design: Array) -> tuple[Array, Array, Array]:
    """Weights of the same cost for a force in the damper's place, beside a tolerable 1000 N."""
    return Q, np.array([[1e-6]]), np.zeros((6, 1))


def ride(run: Trajectory) -> dict[str, float]:
    """Ride metrics; the damper has no power."""
    found = quarter_car_ride(stop=stop())(run)
    return {name: value for name, value in found.items() if "power" not in name}


def drive(road_class: RoadClass, driver: Driver) -> ISORoad:
    """Two seconds of a driver on a road, which is new each time."""
    return ISORoad(road_class, driver, NOMINAL.dt, band=(0.022, 2.83), spacing=0.08)  # waves of 45 m at most


DRIVES = {"mild driver, very poor road (E)": drive("E", "mild"), "aggressive, poor road (D)": drive("D", "aggressive")}

study = Study(
    name="semi_active_damper",
    title="Semi-active damper",
    plant=NOMINAL,
    X=Polytope.from_bounds(-LIMITS, LIMITS),
    U=Polytope.from_bounds([-1.0], [1.0]),
    objective=QuadraticObjective(Q, [[1e-6]], design_cost=parts),
    disturbance=Cases(tuple(DRIVES.values())),
    x0=np.zeros(6),
    p0=[27692.0, 3000.0],
    steps=200,
    real=RealPlant(
        REAL, Cases(tuple(DRIVES.values())), x0=np.zeros(6), runs=120, steps=200,
        held_out=DRIVES | {"mild driver, poor road (D)": drive("D", "mild")},
    ),
    limit_tolerance="off",
    metrics=ride,
    laws={
        "skyhook": skyhook, "clipped LQR": clipped_lqr(weights),
        "clipped LQR, tuned": clipped_lqr(weights, tuned=True),
    },
    expert="clipped LQR",
    accuracy=3e-3,
    samples=300,
    sets="lqr",
    settings={  # two minutes
        "model_runs": 500, "real_runs": 500, "mpc_runs": 10, "held_out_runs": 200, "held_out_steps": 200,
        "cloning": CloningConfig(steps=1000), "codesign": CoDesignConfig(iterations=120, starts=1),
        "online": OnlineConfig(updates=1, judged=200),
        "redesign": CoDesignConfig(iterations=60, starts=1, policy_rate=3e-4),
    },
)  # fmt: skip
