"""A pole on a cart, caught from 0.5 rad; length and mass are the design."""

import numpy as np

from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.disturbances.disturbance import Gaussian
from ccdtools.plants.library import pendulum_on_cart
from ccdtools.studies.real_plant import RealPlant
from ccdtools.studies.study import Study
from invariant_sets import Polytope

limits = np.array([2.0, 5.0, 1.0, 6.0])  # m (half the track), m/s, rad, rad/s
tolerable = np.array([0.5, 2.0, 0.2, 2.0])
force = 10.0  # N; the real motor ends at 12 N
wind = Gaussian(std=[0.2])  # N
start = np.array([0.0, 0.0, 0.5, 0.0])

study = Study(
    name="pendulum_on_cart",
    title="Pendulum on a cart",
    plant=pendulum_on_cart(),
    X=Polytope.from_bounds(-limits, limits),
    U=Polytope.from_bounds([-force], [force]),
    objective=QuadraticObjective(Q=np.diag(tolerable**-2), R=[[force**-2]]),  # Bryson's rule
    disturbance=wind,
    x0=start,
    p0=[0.6, 0.5],  # those of the library's source
    steps=200,
    real=RealPlant(pendulum_on_cart(real=True), wind, x0=start, runs=100, steps=200),
)
