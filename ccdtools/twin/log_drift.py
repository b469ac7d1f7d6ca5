"""Drift of the errors along a log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ccdtools.arrays import Array
from ccdtools.evidence.drift import Drift, detect_drift
from ccdtools.plants.models import Model
from ccdtools.tolerances import CALIBRATION_BLOCKS
from ccdtools.trajectory import Trajectory
from ccdtools.twin.residuals import Residuals, residuals


def drift_of_log(model: Model, log: Trajectory, former: Sequence[Residuals] = (), level: float = 0.05) -> Drift | None:
    """Drift of the model's errors along a log, beside those of former logs at its design; None if too few.

    Without a former log the first half of this one calibrates. What is affine in state and input is taken out as the
    calibration has it: another law, which visits other states, is no drift.

    Parameters
    ----------
    model : LinearModel or SampledModel
    log : Trajectory
        Runs that diverged are left out.
    former : sequence of Residuals
        Errors along former logs.
    level : float
        Probability of any alarm in the log without a drift, at most.
    """
    if log.diverged.all():
        return None
    now = residuals(model, log)
    before = [one for one in former if np.array_equal(one.p, now.p)]
    known = np.concatenate([_columns(one) for one in before]) if before else _columns(now)
    new = _columns(now)
    begun = 0 if before else len(new) // 2
    known, new = known[: None if before else begun], new[begun:]
    if len(known) < CALIBRATION_BLOCKS or len(new) < max(1, len(known) // CALIBRATION_BLOCKS):
        return None
    nx = now.x.shape[2]
    fit = np.linalg.lstsq(known[:, nx:], known[:, :nx], rcond=None)[0]
    found = detect_drift(*(part[:, :nx] - part[:, nx:] @ fit for part in (known, new)), level=level)
    if found.found is None or found.began is None:
        return found
    return replace(found, found=begun + found.found, began=begun + found.began, samples=begun + found.samples)


def _columns(errors: Residuals) -> Array:
    """Errors, one, states and inputs (samples, ·) in the order of time."""
    _, x, u, _, e = errors.columns()
    return np.hstack([e, np.ones((len(e), 1)), x, u])
