"""A geared DC servo that turns a load by 1 rad; gear and flywheel are the design."""

import numpy as np

from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.disturbances.disturbance import Gaussian
from ccdtools.plants.library import dc_servo
from ccdtools.studies.real_plant import RealPlant
from ccdtools.studies.study import Study
from invariant_sets import Polytope

limits = np.array([np.pi, 60.0])  # rad, rad/s; at 24 V and the start's gear the motor runs at 44 rad/s of the load
tolerable = np.array([0.1, 20.0])
torque = Gaussian(std=[0.1])  # N·m, on the load
start = np.array([-1.0, 0.0])

study = Study(
    name="dc_servo",
    title="DC servo",
    plant=dc_servo(),
    X=Polytope.from_bounds(-limits, limits),
    U=Polytope.from_bounds([-24.0], [24.0]),  # V, of the supply
    objective=QuadraticObjective(Q=np.diag(tolerable**-2), R=[[12.0**-2]]),  # Bryson's rule
    disturbance=torque,
    x0=start,
    p0=[20.0, 1e-3],
    steps=100,
    real=RealPlant(dc_servo(real=True), torque, x0=start, runs=100, steps=100),
)
