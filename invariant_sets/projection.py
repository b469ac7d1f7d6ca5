"""Projection by Fourier–Motzkin elimination, and irredundant rows.

Every combination of two rows is formed with weights of at most one, so that rounding stays that of the data; rows
that the box of the set keeps away from it are dropped, since they could never touch it.

References
----------
Ziegler (1995), Lectures on Polytopes, section 1.2: Fourier–Motzkin elimination.
Clarkson (1994), More output-sensitive geometric algorithms, FOCS: redundancy by linear programs over the needed rows.
"""

from __future__ import annotations

import numpy as np

from invariant_sets.bodies import row_norms
from invariant_sets.budgets import CHEAP_HULL_DIM, FEW_ROWS, MOST_ROWS
from invariant_sets.hulls import strongly_irredundant_rows
from invariant_sets.linear_programs import largest_ball, minimise
from invariant_sets.time_limits import NO_DEADLINE, Deadline, LimitReached
from invariant_sets.tolerances import COARSE, FLAT, ROUNDING

Array = np.ndarray


def project_rows(
    R: Array, r: Array, keep: int, *, reach: Array | None = None, deadline: Deadline = NO_DEADLINE
) -> tuple[Array, Array]:
    """Unit rows of {R z <= r} projected on its first `keep` coordinates.

    Parameters
    ----------
    R, r : (m, k) and (m,) arrays
        Rows in coordinates in which the extents of the set are about one.
    keep : int
        Number of coordinates that stay.
    reach : (k,) array, optional
        Largest |z| in the set, inf where unknown: rows that cannot touch this box are dropped.
    deadline : Deadline
        When to stop.

    Returns
    -------
    (q, keep) and (q,) arrays
        A set without points gives the row 0 x <= −1.

    Raises
    ------
    LimitReached
        If the time limit comes first, or more than `MOST_ROWS` rows were needed.
    """
    reach = np.full(R.shape[1], np.inf) if reach is None else reach
    R, r = unit(R, r)
    for k in range(R.shape[1] - 1, keep - 1, -1):
        R, r = eliminate_last(R, r)
        R, r = without_far_rows(R, r, reach[:k])
        if k > keep:
            R, r = _needed(R, r, deadline)
    return R, r


def unit(R: Array, r: Array) -> tuple[Array, Array]:
    """Rows with unit norm; rows of norm zero stay."""
    norms = row_norms(R)
    norms[norms == 0.0] = 1.0
    return R / norms[:, None], r / norms


def eliminate_last(R: Array, r: Array, fresh: Array | None = None) -> tuple[Array, Array]:
    """Unit rows of {R z <= r}, unit rows, without the last coordinate.

    With `fresh`, a (m,) mask, only the rows that follow from at least one fresh row are returned.
    """
    last = R[:, -1]
    rest = np.column_stack([R[:, :-1], r])
    up = last > ROUNDING
    down = last < -ROUNDING
    level = ~(up | down)
    if fresh is None:
        rows = [rest[level], _combined(rest[up], last[up], rest[down], -last[down])]
    else:
        new_up = up & fresh
        new_down = down & fresh
        old_up = up & ~fresh
        rows = [
            rest[level & fresh],
            _combined(rest[new_up], last[new_up], rest[down], -last[down]),
            _combined(rest[old_up], last[old_up], rest[new_down], -last[new_down]),
        ]
    return _without_zero_rows(np.vstack(rows))


def _combined(high: Array, above: Array, low: Array, below: Array) -> Array:
    """Combinations of `high` with `low` rows that cancel the last coefficient."""
    if len(high) * len(low) > MOST_ROWS:
        raise LimitReached(f"an elimination with {len(high)} times {len(low)} rows")
    larger = np.maximum(above[:, None], below[None, :])
    first = below[None, :] / larger
    second = above[:, None] / larger
    combined: Array = first[:, :, None] * high[:, None, :] + second[:, :, None] * low[None, :, :]
    return combined.reshape(-1, high.shape[1])


def _without_zero_rows(rows: Array) -> tuple[Array, Array]:
    """Unit rows (R, r); 0 x <= negative becomes the only row."""
    R = rows[:, :-1]
    r = rows[:, -1]
    norms = np.linalg.norm(R, axis=1)
    zero = norms <= ROUNDING
    if zero.any():
        if (r[zero] < -1e3 * ROUNDING * (1.0 + np.abs(r).max())).any():
            return np.zeros((1, R.shape[1])), np.array([-1.0])
        R = R[~zero]
        r = r[~zero]
        norms = norms[~zero]
    return R / norms[:, None], r / norms


def without_far_rows(R: Array, r: Array, reach: Array) -> tuple[Array, Array]:
    """Rows that can touch the box |z| <= reach around the set.

    Dropping all others at once changes nothing: on the way out of the set the first row crossed is crossed inside
    the box.
    """
    with np.errstate(invalid="ignore"):
        products = np.abs(R) * reach
    products[R == 0.0] = 0.0
    touching = r <= products.sum(axis=1) * (1.0 + FLAT)
    return R[touching], r[touching]


def _needed(R: Array, r: Array, deadline: Deadline) -> tuple[Array, Array]:
    """Needed rows; all of them where the set is thin."""
    if len(r) <= FEW_ROWS:
        return R, r
    ball = largest_ball(R, r)
    if ball.radius <= COARSE:
        return R, r
    kept = needed_rows(R, r - R @ ball.centre, deadline)
    return R[kept], r[kept]


def needed_rows(F: Array, g: Array, deadline: Deadline = NO_DEADLINE) -> Array:
    """Indices of rows that {F y <= g} needs (unit rows, g > 0), perhaps more."""
    if F.shape[1] <= CHEAP_HULL_DIM:
        return strongly_irredundant_rows(F, g)
    needed = np.zeros(len(g), bool)
    rays = max(FEW_ROWS, 20_000_000 // len(g))  # every row's own normal, if there are not too many
    needed[_hit_by_rays(F, g, F[:: max(1, len(g) // rays)])] = True
    open_rows = ~needed
    for i in np.argsort(g, kind="stable"):
        while open_rows[i]:
            deadline.check()
            others = np.flatnonzero(needed)
            rows = np.vstack([F[others], F[i]])
            right = np.append(g[others], g[i] + 1.0)
            value, y = minimise(-F[i], rows, right)
            if y is None or -value <= g[i] + ROUNDING:
                open_rows[i] = False
                continue
            hit = _hit_by_rays(F, g, y[None])[0]
            if needed[hit]:  # rounding: keep the row rather than ask for ever
                hit = i
            needed[hit] = True
            open_rows[hit] = False
    return np.flatnonzero(needed)


def _hit_by_rays(F: Array, g: Array, directions: Array) -> Array:
    """Rows that some ray from 0 crosses first, sorted."""
    hits = []
    step = max(1, 2_000_000 // len(F))
    for start in range(0, len(directions), step):
        slope = directions[start : start + step] @ F.T
        with np.errstate(divide="ignore"):
            distance = np.where(slope > 0.0, g / np.where(slope > 0.0, slope, 1.0), np.inf)
        hits.append(distance.argmin(axis=1))
    return np.unique(np.concatenate(hits))
