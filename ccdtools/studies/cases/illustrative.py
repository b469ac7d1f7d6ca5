"""The example of Tsai et al., an unstable system; its input matrix is the design."""

import numpy as np

from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.disturbances.combinations import Sum
from ccdtools.disturbances.disturbance import Gaussian, Uniform
from ccdtools.plants import library
from ccdtools.studies.real_plant import RealPlant
from ccdtools.studies.study import Study
from invariant_sets import Polytope

noise = Gaussian(std=[0.1, 0.2])
start = np.array([-3.5, -2.0])

study = Study(
    name="illustrative",
    title="Illustrative example",
    plant=library.illustrative(),
    X=Polytope.from_bounds([-10.0, -5.0], [5.0, 2.0]),
    U=Polytope.from_bounds([-1.0], [1.0]),
    objective=QuadraticObjective(Q=np.eye(2), R=[[0.1]]),
    disturbance=noise,
    x0=start,
    p0=[1.0],
    real=RealPlant(
        library.illustrative(real=True), Sum((noise, Uniform([-0.1, -0.1], [0.1, 0.1]))), x0=start, runs=200, steps=100
    ),
    paper_networks=(32, 32, 16, 16),
    samples=600,
)
