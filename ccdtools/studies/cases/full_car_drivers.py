"""A full car for a mild and an aggressive driver: a design for each, on sensors alone.

As in Tsai, Chen, Karkaria and Chen, "Digital Twin-based Control Co-Design of Full Vehicle Active Suspensions via Deep
Reinforcement Learning", arXiv 2512.03891, without its numbers. A driver has a way to change speed, see
`generate_speed`, and accelerates, brakes and corners at random, which tips the body.
"""

from typing import Any

import casadi as ca
import numpy as np

from ccdtools.co_design.custom_objective import CustomObjective
from ccdtools.disturbances.combinations import Cases, Stacked
from ccdtools.disturbances.disturbance import Disturbance, Gaussian
from ccdtools.plants.library import full_car
from ccdtools.plants.plant import Plant
from ccdtools.studies.cases._cars import CAR, WHEELBASE, by_kind, stop
from ccdtools.studies.real_plant import RealPlant
from ccdtools.studies.side_by_side import SideBySide
from ccdtools.trajectory import Trajectory
from ccdtools.vehicles.iso8608 import RoadClass
from ccdtools.vehicles.iso_road import ISORoad
from ccdtools.vehicles.ride import Ride
from ccdtools.vehicles.roads import Driver
from invariant_sets import Polytope

HEIGHT = 0.5  # m, of the centre of mass above the road's reaction; a typical value
MANOEUVRE = 1.0  # s, for which a driver keeps on; a typical value
# Standard deviations of longitudinal and lateral acceleration [m/s²]: half of what `generate_speed` has at most, and
# half of 2 and 4 m/s² in curves, which participants on a test track often call too slow and too fast (PsyArXiv kcw2d).
DRIVERS: dict[Driver, tuple[float, float]] = {"mild": (0.25, 1.0), "aggressive": (1.5, 2.0)}
GOOD = {"acceleration": 1.0, "tyre": 0.01, "travel": 0.05, "force": 1000.0}  # m/s² and rad/s², m, m, N: Bryson's rule


def driven(car: Plant) -> Plant:
    """Full car with its driver's accelerations as two more states, and sensors as outputs."""
    a, noise = ca.SX.sym("a", 2), ca.SX.sym("noise", 2)
    moments = CAR.body * HEIGHT * a  # nose up where it accelerates forwards, left side up in a curve to the left
    body = car.dynamics[12:] + ca.vertcat(0, moments / ca.DM([CAR.pitch_inertia, CAR.roll_inertia]))
    return Plant(
        ca.vertcat(car.x, a), car.u, ca.vertcat(car.w, noise), car.p,
        ca.vertcat(car.dynamics[:12], body, (noise - a) / MANOEUVRE), car.design, dt=car.dt,
        state_names=[*car.state_names, "longitudinal acceleration [m/s²]", "lateral acceleration [m/s²]"],
        input_names=car.input_names, outputs=ca.vertcat(car.x[4:8], body[0], car.x[13:15], a),
    )  # fmt: skip


def stage_cost(x: Any, u: Any, p: Any) -> Any:
    """Squares of body accelerations, tyre deflections, travels and forces, beside tolerable ones."""
    parts = {"acceleration": NOMINAL.right_hand_side(x, u, 0, p)[12:15], "tyre": x[:4], "travel": x[4:8], "force": u}
    return sum(ca.sumsqr(part / GOOD[name]) for name, part in parts.items())


def drive(driver: Driver, *classes: RoadClass) -> Stacked:
    """Roads of the classes in turn, and white noise that becomes manoeuvres."""
    track = 2 * CAR.half_track
    roads = (ISORoad(one, driver, NOMINAL.dt, track=track, wheelbase=WHEELBASE, spacing=0.08) for one in classes)
    return Stacked((Cases(tuple(roads)), Gaussian(np.sqrt(2 * MANOEUVRE / NOMINAL.dt) * np.array(DRIVERS[driver]))))


def metrics(run: Trajectory) -> dict[str, float]:
    """Cost of a step by the accelerations that were measured, control effort and ride."""
    x, u = run.states[:, 1:], run.inputs
    accelerations = np.diff(run.states[..., 12:15], axis=1) / run.dt
    parts = {"acceleration": accelerations, "tyre": x[..., :4], "travel": x[..., 4:8], "force": u}
    cost = sum(np.sum((part / GOOD[name]) ** 2) for name, part in parts.items()) / (len(u) * u.shape[1])
    effort = {"mean square force [kN²]": 1e-6 * np.mean(u**2), "peak force [N]": np.abs(u).max(axis=(1, 2)).mean()}
    return {"cost": float(cost), **effort, **RIDE(run)}


NOMINAL = driven(full_car())
LIMITS = np.append(by_kind(full_car().state_names)[0], [10.0, 10.0])  # m/s², beyond what tyres give
RIDE = Ride(12, range(4, 8), range(4), CAR.tyre, np.repeat(CAR.loads, 2), stop())
USES: dict[str, Disturbance] = {driver: drive(driver, "C") for driver in DRIVERS}

study = SideBySide(
    name="full_car_drivers",
    title="A full car for two drivers",
    plant=NOMINAL,
    X=Polytope.from_bounds(-LIMITS, LIMITS),
    U=Polytope.from_bounds([-1500.0] * 4, [1500.0] * 4),  # N; the real actuator ends at 2500 N
    objective=CustomObjective(stage_cost),
    disturbance=USES["mild"],
    x0=np.zeros(NOMINAL.nx),
    p0=(28000.0, 2500.0, 21000.0, 2000.0),
    steps=300,
    real=RealPlant(
        driven(full_car(real=True)), USES["mild"], x0=np.zeros(NOMINAL.nx), runs=1, steps=12000,
        held_out={driver: drive(driver, "B", "C", "D") for driver in DRIVERS},
    ),
    limit_tolerance="off",
    metrics=metrics,
    uses=USES,
    noise=[0.002, 0.002, 0.002, 0.002, 0.1, 0.005, 0.005, 0.1, 0.1],  # m, m/s², rad/s, m/s²
    history=4,
)  # fmt: skip
