"""Two tanks filled to their levels; areas and outlet are the design.

Both plants are in deviations from where the nominal one rests; the real one leaks and rests lower.
"""

import numpy as np

from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.disturbances.disturbance import Gaussian
from ccdtools.plants.library import two_tanks
from ccdtools.studies.real_plant import RealPlant
from ccdtools.studies.study import Study
from invariant_sets import Polytope

p0 = [28.0, 28.0, 0.071]  # those of the library's source
limits = np.array([4.5, 6.0])  # cm; the upper tank rests at 5 to 17 cm, as its outlet says, the lower one at 10 cm
tolerable = np.array([3.0, 0.5])
inflows = Gaussian(std=[1.0, 1.0])  # cm³/s, beside 10 cm³/s of the pump
start = np.array([-3.0, -4.0])

study = Study(
    name="two_tanks",
    title="Two tanks",
    plant=two_tanks(),
    X=Polytope.from_bounds(-limits, limits),
    U=Polytope.from_bounds([-2.9], [2.9]),  # V; at rest 2.99 V, and the pump does not draw
    objective=QuadraticObjective(Q=np.diag(tolerable**-2), R=[[1.0]]),  # Bryson's rule
    disturbance=inflows,
    x0=start,
    p0=p0,
    steps=200,
    real=RealPlant(two_tanks(real=True), inflows, x0=start, runs=100, steps=200),
)
