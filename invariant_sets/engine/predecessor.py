"""Fourier–Motzkin elimination, and with it the states from which some input reaches a set in one step.

References
----------
Blanchini, Miani (2015), Set-Theoretic Methods in Control, 2nd ed., section 5.1 and algorithm 5.1.
"""

from __future__ import annotations

import numpy as np

from invariant_sets.hulls import strongly_irredundant_rows
from invariant_sets.linear_programs import inscribed_ball

Array = np.ndarray
_FEW = 40  # rows that are not worth sorting out
_ZERO = 1e-12  # coefficients below this part of the largest one of their row are zero


def predecessor_rows(F: Array, g: Array, A: Array, B: Array, H: Array, h: Array,
                     disturbances: Array | None = None, fresh: Array | None = None) -> tuple[Array, Array]:
    """Return rows (R, r) of {x : some u with H [x; u] <= h has F (A x + B u + w) <= g for all w}.

    Parameters
    ----------
    F, g : (m, n) and (m,) arrays
        The target set.
    A, B : (n, n) and (n, nu) arrays
        Dynamics.
    H, h : (q, n + nu) and (q,) arrays
        Constraints on state and input together.
    disturbances : (k, n) array, optional
        Vertices of E W.
    fresh : (m,) bool array, optional
        Rows of the target that are new since the last call. With one input, only what follows from these is
        returned: a recursion that only shrinks its set has the rest already.

    Notes
    -----
    Assumes coordinates of order one (scale by the bounding boxes first). Redundant rows are removed between
    the inputs, not after the last one.
    """
    nu = B.shape[1]
    reach = 0.0 if disturbances is None else (F @ disturbances.T).max(axis=1)
    R = np.vstack([np.hstack([F @ A, F @ B]), H])
    r = np.concatenate([g - reach, h])
    if nu == 1 and fresh is not None:
        return eliminate_last(R, r, np.append(fresh, np.zeros(len(h), bool)))
    return project_rows(R, r, R.shape[1] - nu)


def project_rows(R: Array, r: Array, keep: int) -> tuple[Array, Array]:
    """Return rows of the projection of {R z <= r} on its first `keep` coordinates."""
    for k in range(R.shape[1] - 1, keep - 1, -1):
        R, r = eliminate_last(R, r)
        if k > keep:
            R, r = _strongly_irredundant(R, r)
    return R, r


def eliminate_last(R: Array, r: Array, fresh: Array | None = None) -> tuple[Array, Array]:
    """Return the rows of the projection of {R z <= r} that drops the last coordinate; those from `fresh` rows only."""
    last = R[:, -1]
    size = np.abs(R).max(axis=1, initial=0.0)
    rest = np.column_stack([R[:, :-1], r])
    up, down = last > _ZERO * size, last < -_ZERO * size
    high, low = rest[up] / last[up, None], rest[down] / -last[down, None]
    if fresh is None:
        rows = np.vstack([rest[~(up | down)], _sums(high, low)])
    else:
        new_high, new_low = fresh[up], fresh[down]
        rows = np.vstack([
            rest[~(up | down) & fresh], _sums(high[new_high], low), _sums(high[~new_high], low[new_low]),
        ])  # fmt: skip
    return rows[:, :-1], rows[:, -1]


def _sums(high: Array, low: Array) -> Array:
    """Return every row of one plus every row of the other."""
    return (high[:, None, :] + low[None, :, :]).reshape(-1, high.shape[1])


def _strongly_irredundant(R: Array, r: Array) -> tuple[Array, Array]:
    """Return the rows that matter, judged from an inner point; all of them where the set is thin or small in rows."""
    norms = np.linalg.norm(R, axis=1)
    regular = norms > 1e-13
    rows, values = R[regular] / norms[regular, None], r[regular] / norms[regular]
    if len(values) <= _FEW:
        return R, r
    radius, middle = inscribed_ball(rows, values, cap=1.0)
    kept = np.arange(len(values))
    if radius > 1e-6:
        kept = strongly_irredundant_rows(rows, values - rows @ middle)
    return np.vstack([rows[kept], R[~regular]]), np.append(values[kept], r[~regular])
