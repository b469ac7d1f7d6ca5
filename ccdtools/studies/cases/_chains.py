"""Common parts of the mass-chain studies."""

from __future__ import annotations

from functools import partial

import numpy as np

from ccdtools.disturbances.disturbance import Gaussian
from ccdtools.plants.library import mass_chain
from ccdtools.studies.cases._regulated import regulated_study
from ccdtools.studies.study import Study


def chain_study(name: str, title: str, masses: int) -> Study:
    """Study of a chain released from a bow, its last mass shaken."""
    bow = 0.3 * np.sin(np.pi * np.arange(1, masses + 1) / (masses + 1))  # m: the slowest mode
    return regulated_study(
        name, title, partial(mass_chain, masses),
        limits=np.repeat([0.5, 2.0], masses), tolerable=np.repeat([0.1, 0.5], masses),  # m, m/s
        inputs=[10.0], effort=[10.0], disturbance=Gaussian(std=[1.0]),  # N; a push shakes the last mass
        x0=np.append(bow, np.zeros(masses)), p0=[60.0, 0.5], steps=200,  # the design is soft and lightly damped
    )  # fmt: skip
