"""Common parts of the mass-chain studies."""

from __future__ import annotations

import numpy as np

from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.disturbances.disturbance import Gaussian
from ccdtools.plants.library import mass_chain
from ccdtools.studies.real_plant import RealPlant
from ccdtools.studies.study import Study
from invariant_sets import Polytope

PUSH = 1.0  # N, standard deviation of what shakes the last mass


def chain_study(name: str, title: str, masses: int) -> Study:
    """Study of a chain released from a bow, its last mass shaken."""
    limits = np.repeat([0.5, 2.0], masses)  # m, m/s
    tolerable = np.repeat([0.1, 0.5], masses)  # m, m/s
    bow = 0.3 * np.sin(np.pi * np.arange(1, masses + 1) / (masses + 1))  # m: the slowest mode
    start = np.append(bow, np.zeros(masses))
    return Study(
        name=name,
        title=title,
        plant=mass_chain(masses),
        X=Polytope.from_bounds(-limits, limits),
        U=Polytope.from_bounds([-10.0], [10.0]),
        objective=QuadraticObjective(Q=np.diag(tolerable**-2), R=[[10.0**-2]]),  # Bryson's rule
        disturbance=Gaussian(std=[PUSH]),
        x0=start,
        p0=[60.0, 0.5],  # soft and lightly damped
        steps=200,
        real=RealPlant(mass_chain(masses, real=True), Gaussian(std=[PUSH]), x0=start, runs=100, steps=200),
    )
