"""Disturbance set of a log: joint one-step errors of a nominal model."""

from __future__ import annotations

import numpy as np
from scipy.linalg import qr
from scipy.stats import rankdata

from ccdtools.arrays import Array
from ccdtools.exceptions import InputError
from ccdtools.plants.models import Model, as_model
from ccdtools.twin.budgets import BLOCKS
from ccdtools.twin.residuals import Logs, block_parts, errors_of, of_linearisation, stacked
from ccdtools.twin.tolerances import HELD_OUT
from ccdtools_ground.door import as_share
from invariant_sets import Polytope
from learning.conformal import Conformal, samples_needed


def disturbance_set(
    logs: Logs, *, level: float = 0.99, held_out: float = HELD_OUT, blocks: int = BLOCKS,
    model: Model | None = None,
) -> Polytope:  # fmt: skip
    """Set W of one-step errors at a level.

    It holds e⁺ = x⁺ − f(x, u, 0, p) (nx,), all states at once; of a linear model it is what `LinearMPC(W=…)` takes.

    A box of what the error of each state adds to that which those before it explain by regression, in the order that
    explains most, between quantiles that hold the level together. Its size is conformal: the last part of every block
    of a log, which regression and quantiles have not seen, says by which factor all sides grow or shrink until the
    level is held, all coordinates at once. That is exact for samples that could be exchanged; errors of one drive
    follow each other, and another drive has others.

    Parameters
    ----------
    logs : Trajectory or Residuals, or a sequence of them at one design
        From `deploy`, with `model`; or `twin.logs`, or `twin.carried()` for several designs.
    level : float
        Share of the errors within the set, in (0, 1).
    held_out : float
        Part of every block that calibrates.
    blocks : int
        Blocks that a single long run is cut into.
    model : LinearModel or SampledModel, optional
        That of the logs. The set is then one of x⁺ − Ax − Bu, which `LinearMPC(W=…)` and sets need: what the
        linearisation of a nonlinear model at rest leaves out is part of the errors.

    Returns
    -------
    Polytope
        Flat where errors enter fewer directions than there are states.

    Raises
    ------
    InputError
        Where too few samples calibrate: at least level / (1 − level) are needed.

    References
    ----------
    Vovk, Gammerman and Shafer, "Algorithmic Learning in a Random World", 2005 (split conformal prediction).
    """
    model = model if model is None else as_model("model", model)
    given = errors_of(logs, model)
    for i, log in enumerate(given):
        if not np.array_equal(log.p, given[0].p):
            got = f"design {log.p} beside {given[0].p}"
            raise InputError(f"logs[{i}]", got, "one design", "`DigitalTwin.carried()` carries logs to the newest.")
    if model is not None:
        given = [of_linearisation(model, log) for log in given]
    level = as_share("level", level)
    held_out = as_share("held_out", held_out)
    parts = [
        [part for log in given for part in block_parts(log, held_out, blocks, last=last)] for last in (False, True)
    ]
    count = sum(part.runs * part.steps for part in parts[1])
    if count < samples_needed(level) or not parts[0]:
        got = f"{count} samples held out to calibrate a level of {level:g}"
        raise InputError("logs", got, f"at least {samples_needed(level)}: a longer log, or a lower level")
    errors, unseen = (stacked(part)[-1] for part in parts)
    back = _regressed(errors)
    scores, unseen_scores = (np.linalg.solve(back, rows.T).T for rows in (errors, unseen))
    place = rankdata(scores, axis=0) / (len(scores) + 1)
    outside = np.quantile(np.minimum(place, 1 - place).min(axis=1), 1 - level)  # of each axis, on each of its sides
    low, high = np.quantile(scores, (outside, 1 - outside), axis=0)
    middle, half = (low + high) / 2, (high - low) / 2
    away = np.abs(unseen_scores - middle)
    rounding = np.finfo(float).eps * away.max(initial=np.finfo(float).tiny)
    half = np.where((away > rounding).any(axis=0), np.maximum(half, rounding), half)  # what is left is not flat
    factor = Conformal.fit((away / np.maximum(half, rounding)).max(axis=1), level).factor
    return Polytope.from_bounds(middle - factor * half, middle + factor * half).affine_map(back)


def _regressed(errors: Array) -> Array:
    """Matrix (nx, nx) from independent parts of errors to errors.

    Part i is what the error of a state adds to those before it, in standard deviations of that error.
    """
    largest = np.exp2(np.frexp(np.abs(errors).max(axis=0))[1] - 1)  # a power of two changes no digit
    unit = (errors / largest).std(axis=0) * largest  # squares of the errors themselves may be no doubles
    nx = len(unit)
    first = 1 + np.sqrt(np.finfo(float).eps) * np.arange(nx)  # of states that count alike the first leads, in any unit
    unit = np.where(unit > 0, unit, 1.0) * first
    centred = np.vstack([(errors - errors.mean(axis=0)) / unit, np.zeros((nx, nx))])
    _, R, order = qr(centred, mode="economic", pivoting=True)
    added = np.abs(np.diag(R))
    columns = np.where(added > 0, R.T * np.sign(np.diag(R)) / np.where(added > 0, added, 1.0), np.eye(nx))
    back = np.zeros((nx, nx))
    back[order] = columns
    return np.asarray(unit[:, None] * back)
