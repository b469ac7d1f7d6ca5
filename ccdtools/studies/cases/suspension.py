"""The active suspension of Tsai et al.; spring and damper are the design."""

from dataclasses import replace

import casadi as ca
import numpy as np

from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.disturbances.disturbance import Gaussian
from ccdtools.plants import library
from ccdtools.plants.plant import Plant
from ccdtools.studies.cases._cars import quarter_car_ride
from ccdtools.studies.real_plant import RealPlant
from ccdtools.studies.study import Study
from ccdtools.vehicles.roads import GeneratedRoad
from invariant_sets import Polytope


def quarter_car(*, nonlinear: bool = False, hardening: float = 0.01) -> Plant:
    """Quarter car at the paper's sampling time, nominal or nonlinear.

    `hardening` is a part of k_s [1/m²] and of c_s [s/m].
    """
    car = library.QuarterCar()
    plant = library.quarter_car(car=car, dt=0.05)
    if not nonlinear:
        return plant
    _, wheel, travel, body = ca.vertsplit(plant.x)
    spring, damper = ca.vertsplit(plant.p)
    rate = body - wheel
    force = hardening * (spring * travel**3 + damper * ca.fabs(rate) * rate)
    return replace(plant, dynamics=plant.dynamics + ca.vertcat(0, force / car.unsprung, 0, -force / car.sprung))


study = Study(
    name="suspension",
    title="Active suspension",
    plant=quarter_car(),
    X=Polytope.from_bounds([-0.25, -2.5, -0.5, -2.5], [0.25, 2.5, 0.5, 2.5]),
    U=Polytope.from_bounds([-1000.0], [1000.0]),
    objective=QuadraticObjective(Q=np.diag([10.0, 1.0, 50.0, 5.0]), R=[[1e-6]]),
    disturbance=Gaussian(std=[0.3]),
    x0=[-0.1, -1.0, -0.1, -0.5],
    p0=[27692.0, 1906.5],
    real=RealPlant(
        quarter_car(nonlinear=True),
        GeneratedRoad("mild"),
        x0=np.zeros(4),
        runs=1,
        steps=15000,
        held_out={"mild driver": GeneratedRoad("mild"), "aggressive driver": GeneratedRoad("aggressive")},
        road=True,
    ),
    paper_networks=(16, 32, 32, 16),
    samples=1000,
    metrics=quarter_car_ride(stop=0.5),  # the limit in X
    sampling_guard="ignore",  # the paper's dt: the wheel oscillates at 9.6 to 10.3 Hz, half the sampling rate is 10 Hz
)
