"""A wind turbine's drivetrain after a gust; shaft and gear are the design."""

import numpy as np

from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.disturbances.disturbance import Gaussian
from ccdtools.plants.library import wind_turbine
from ccdtools.studies.real_plant import RealPlant
from ccdtools.studies.study import Study
from invariant_sets import Polytope

limits = np.array([0.002, 0.3, 0.3])  # rad (0.005 at rest), rad/s (a quarter of 12.1 rpm)
tolerable = np.array([0.0005, 0.05, 0.05])
inputs = np.array([3.0, 6.0])  # kN·m, °; the real ones end at 4 and 8
# White gusts of 1 m/s have the slow part of wind of a few per cent of turbulence, and shake the shaft besides.
gusts = Gaussian(std=[1.0])
start = np.array([0.0, 0.1, 0.1])

study = Study(
    name="wind_turbine",
    title="Wind turbine",
    plant=wind_turbine(),
    X=Polytope.from_bounds(-limits, limits),
    U=Polytope.from_bounds(-inputs, inputs),
    objective=QuadraticObjective(Q=np.diag(tolerable**-2), R=np.diag((0.5 * inputs) ** -2)),  # Bryson's rule
    disturbance=gusts,
    x0=start,
    p0=[867.637e6, 97.0],  # those of the library's source
    steps=200,
    real=RealPlant(wind_turbine(real=True), gusts, x0=start, runs=100, steps=200),
)
