"""Hit and run: uniform samples of a bounded body.

References
----------
Smith (1984), Efficient Monte Carlo procedures for generating points uniformly distributed over bounded regions,
Operations Research 32(6). Lovász, Vempala (2006), Hit-and-run from a corner, SIAM J. Computing 35(4): why the body is
made round first.
"""

from __future__ import annotations

import numpy as np

from invariant_sets.interior_form import Body
from invariant_sets.tolerances import JITTER

Array = np.ndarray


def hit_and_run(body: Body, n: int, rng: np.random.Generator) -> Array:
    """Sample of n points (n, k) in coordinates y, one chain each.

    All chains start at the inner point y = 0 and take 20·k steps, in directions drawn with the covariance that a
    shorter run has found: without that a slanted body mixes slowly. Assumes a bounded body.
    """
    k = body.F.shape[1]
    shape: Array = np.eye(k)
    for _ in range(2):
        trial = _walk(body, np.zeros((40 * k, k)), shape, 10 * k, rng)
        shape = np.linalg.cholesky(np.cov(trial, rowvar=False).reshape(k, k) + JITTER * np.eye(k))
    return _walk(body, np.zeros((n, k)), shape, 20 * k, rng)


def _walk(body: Body, Y: Array, shape: Array, steps: int, rng: np.random.Generator) -> Array:
    """Points Y (n, k) after `steps` moves to uniform points of chords."""
    for _ in range(steps):
        direction = rng.standard_normal(Y.shape) @ shape.T
        speed = direction @ body.F.T
        room = np.maximum(body.g - Y @ body.F.T, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = room / speed
        ahead = np.where(speed > 0, reach, np.inf).min(axis=1)
        behind = np.where(speed < 0, reach, -np.inf).max(axis=1)
        Y = Y + (behind + (ahead - behind) * rng.random(len(Y)))[:, None] * direction
    return Y
