"""Where a log and a twin part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ccdtools.arrays import Array
from ccdtools.evidence.drift import Drift, detect_drift
from ccdtools.exceptions import InputError
from ccdtools.tolerances import CALIBRATION_BLOCKS
from ccdtools.trajectory import Trajectory
from ccdtools.twin.residuals import Residuals, residuals
from ccdtools.twin.transport import carried
from ccdtools.twin.twin import DigitalTwin
from ccdtools_ground.door import as_count, as_instance, as_share


def drift_of_log(twin: DigitalTwin, log: Trajectory, *, level: float = 0.05, block: int | None = None) -> Drift:
    """Whether a twin still describes the plant of a fresh log.

    What its median leaves unexplained is compared with what it left unexplained of its own logs. Another law is no
    drift as far as the twin describes the states that it visits.

    Parameters
    ----------
    twin : DigitalTwin
        After `update`.
    log : Trajectory
        Runs that diverged are left out, which the result says.
    level, block
        As in `detect_drift`.

    Raises
    ------
    InputError
        If the twin has learned nothing, or the log is of another plant. Too few samples are a status.
    """
    as_instance("twin", twin, DigitalTwin, "a DigitalTwin")
    if twin.discrepancy is None or twin.scale is None:
        raise InputError("twin", "one without a discrepancy", "one after `update`")
    known = np.concatenate([_in_time(one, one.e_next) for one in twin.innovations()])
    now = carried(twin.model, residuals(twin.model, log), twin.logs[-1].p, twin.scale)
    fresh = _in_time(now, now.e_next - twin.discrepancy.median(now))
    length = max(1, len(known) // CALIBRATION_BLOCKS) if block is None else as_count("block", block)
    if len(known) < CALIBRATION_BLOCKS * length or len(fresh) < length:
        found = Drift(None, None, 0, length, as_share("level", level), len(known))
    else:
        found = detect_drift(known, fresh, level=level, block=length)
    return replace(found, left_out=(now.left_out, now.left_out + now.runs))


def outside_data(twin: DigitalTwin, log: Trajectory) -> tuple[float, Array]:
    """Where a log leaves the states and inputs that a twin has learned from.

    Parameters
    ----------
    twin : DigitalTwin
        After `update`.
    log : Trajectory
        Runs that diverged are left out.

    Returns
    -------
    share : float
        Part of the samples in which a state or an input lies outside its range in the twin's logs.
    excess : (nx + nu,) array
        How far each state, then each input, goes outside, in its range there; 1 of what did not move there.

    Raises
    ------
    InputError
        If the twin has no log, or the log is of another plant.
    """
    as_instance("twin", twin, DigitalTwin, "a DigitalTwin")
    if not twin.logs:
        raise InputError("twin", "one without a log", "one after `update`")
    known = np.concatenate([_samples(one) for one in twin.logs])
    fresh = _samples(residuals(twin.model, log))
    low, high = known.min(axis=0), known.max(axis=0)
    beyond = np.maximum(np.maximum(low - fresh, fresh - high), 0.0)
    most = beyond.max(axis=0)
    beyond /= np.where(high > low, high - low, np.where(most > 0, most, 1.0))
    return float((beyond > 0).any(axis=1).mean()), np.asarray(beyond.max(axis=0))


def _samples(log: Residuals) -> Array:
    """States and inputs (samples, nx + nu) of all runs."""
    return np.concatenate([log.x, log.u], axis=2).reshape(-1, log.x.shape[2] + log.u.shape[2])


def _in_time(log: Residuals, errors: Array) -> Array:
    """Errors (samples, nx) of all runs, one after the other."""
    return errors.reshape(-1, log.x.shape[2])
