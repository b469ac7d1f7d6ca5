"""Common parts of studies that bring a disturbed plant back to rest."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.disturbances.disturbance import Disturbance
from ccdtools.plants.plant import Plant
from ccdtools.studies.real_plant import RealPlant
from ccdtools.studies.study import Study
from invariant_sets import Polytope


def regulated_study(
    name: str, title: str, plant: Callable[..., Plant], *, limits: ArrayLike, tolerable: ArrayLike, inputs: ArrayLike,
    effort: ArrayLike, disturbance: Disturbance, x0: ArrayLike, p0: ArrayLike, steps: int,
) -> Study:  # fmt: skip
    """Study of a plant of the library, deployed in a hundred runs of the real one.

    States and inputs stay within ±`limits` and ±`inputs`; `tolerable` and `effort` cost one each, by Bryson's rule.
    """
    limits, tolerable, inputs, effort = (np.asarray(value, float) for value in (limits, tolerable, inputs, effort))
    return Study(
        name=name,
        title=title,
        plant=plant(),
        X=Polytope.from_bounds(-limits, limits),
        U=Polytope.from_bounds(-inputs, inputs),
        objective=QuadraticObjective(Q=np.diag(tolerable**-2), R=np.diag(effort**-2)),
        disturbance=disturbance,
        x0=x0,
        p0=p0,
        steps=steps,
        real=RealPlant(plant(real=True), disturbance, x0=x0, runs=100, steps=steps),
    )
