"""Controllers of a problem whose state is measured by noisy sensors."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.controllers.observed import Observed
from ccdtools.controllers.signals import needs_of
from ccdtools.estimation.kalman import KalmanFilter
from ccdtools.estimation.tolerances import DIFFERENCE_STEP
from ccdtools.exceptions import InputError
from ccdtools_ground.door import shown


def kalman_filter(problem: Any, design: ArrayLike) -> KalmanFilter:
    """Kalman filter of a `CoDesignProblem`'s sensors at a design.

    Model and outputs are linearised at rest; the disturbance counts as white noise about the mean that it states.

    Raises
    ------
    InputError
        If the problem has no `measurement`, or its noise leaves an output exact.
    """
    if getattr(problem, "measurement", None) is None:
        got = "one without a measurement" if hasattr(problem, "measurement") else shown(problem)
        raise InputError("problem", got, "CoDesignProblem(measurement=Measurement(…))")
    p = problem.design.check_one(design)
    A, B, E = problem.model.matrices(p)
    nx, nu = problem.model.nx, problem.model.nu
    rest, still = np.zeros((1, nx)), np.zeros((1, nu))
    output = problem.measurement.at(nx, nu, p)
    C = np.reshape(output.slope(rest, still, problem.state_scale[None]), (-1, nx))
    size = DIFFERENCE_STEP * np.abs(problem.input_bounds).max(axis=0)
    D = np.column_stack([(output.of(rest, u) - output.of(rest, -u))[0] / (2 * u.max()) for u in np.diag(size)[:, None]])
    v = problem.measurement.drawn(4096, min(problem.steps, 64), np.random.default_rng(0)).noise
    assert v is not None
    V = np.einsum("nti,ntj->ij", v, v) / (v.shape[0] * v.shape[1])
    mean, P0, noise = problem.moments
    return KalmanFilter(
        A, B, C, E @ noise @ E.T, V, D=D, y0=output.of(rest, still)[0], c=E @ problem.mean_disturbance, steady=False,
        x0=mean, P0=P0,
    )  # fmt: skip


def observed(problem: Any, controller: Any, design: ArrayLike) -> Any:
    """Controller of outputs, or of the estimate."""
    if "output" in needs_of(controller):
        return controller
    return Observed(controller, kalman_filter(problem, design))
