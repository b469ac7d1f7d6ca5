"""`Body`: a set as {centre + basis y : F y <= g}, full-dimensional and well scaled in y; found from any rows.

All tolerances are relative to the bounding box of the set, so one of size 1e-6 and one of 1e6 are treated alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from invariant_sets.linear_programs import inscribed_ball, minimise

Array = np.ndarray
FLAT = 1e-9  # a set thinner than this part of its bounding box is flat; one missing by more is empty


@dataclass(frozen=True)
class Body:
    """{centre + basis y : F y <= g}: full-dimensional in y, 0 in its interior, extents of order one.

    Attributes
    ----------
    centre : (n,) array
        An interior point relative to the affine hull.
    basis : (n, k) array
        Columns span the affine hull; they carry the scale.
    F, g : (m, k) and (m,) arrays
        Rows of unit norm, g > 0.
    bounded : bool
        Whether the set is bounded.
    """

    centre: Array
    basis: Array
    F: Array
    g: Array
    bounded: bool


def body_of(A: Array, b: Array, A_eq: Array, b_eq: Array) -> Body | None:
    """Return the `Body` of {A x <= b, A_eq x = b_eq}, or None if the set is empty."""
    n = A.shape[1]
    centre, basis = np.zeros(n), np.eye(n)
    if len(b_eq):
        reduced = _solve_equalities(A_eq, b_eq)
        if reduced is None:
            return None
        centre, basis = reduced
    while True:
        F, g = unit_rows(A @ basis, b - A @ centre)
        if F is None:
            return None
        k = basis.shape[1]
        if k == 0 or len(g) == 0:
            return Body(centre, basis, F, g, bounded=k == 0)
        found = _extents_in_scales(F, g)
        if found is None:
            return None
        rough, y, lower, upper = found
        finite = np.isfinite(lower) & np.isfinite(upper)
        lower, upper = np.where(finite, lower, y - 1.0), np.where(finite, upper, y + 1.0)
        middle, half = (lower + upper) / 2, np.maximum((upper - lower) / 2, 1e-12)
        centre, basis = centre + basis @ (rough * middle), basis * (rough * half)
        F, g = unit_rows(A @ basis, b - A @ centre, always=True)
        radius, y = inscribed_ball(F, g, cap=1.0)
        thin = finite & (upper - lower <= FLAT * max(1.0, np.abs(middle).max()))
        if radius > FLAT and not thin.any():
            centre = centre + basis @ y
            return Body(centre, basis, F, g - F @ y, bool(finite.all()))
        flat = _implicit_equalities(F, g, y, max(radius, 0.0), thin)
        tight, level = (F[flat], g[flat]) if flat.any() else (np.eye(k)[thin], y[thin])
        y = y + np.linalg.lstsq(tight, level - tight @ y, rcond=1e-8)[0]  # onto the hull itself
        centre, basis = centre + basis @ y, basis @ null_space(tight)


def _extents_in_scales(F: Array, g: Array) -> tuple[Array, Array, Array, Array] | None:
    """Return a scale, a point and the extents in that scale; None if the set is empty.

    A bad scale can make a thin set look empty or unbounded, so two must agree on either; what still looks unbounded
    is measured once more by rows that are almost parallel to a coordinate, as a needle has them.
    """
    answer = None
    for plain in (False, True):
        found = _extents_in_scale(F, g, _rough_scale(F, g, plain=plain))
        if found is not None:
            answer = found
            if _finite(found).all():
                return answer
    if answer is not None:
        scale = _needle_scale(F, g, answer[0])
        found = _extents_in_scale(F, g, scale) if (scale > 1e3 * answer[0]).any() else None
        if found is not None and _finite(found).sum() > _finite(answer).sum():
            answer = found
    return answer


def _finite(found: tuple[Array, Array, Array, Array]) -> Array:
    return np.isfinite(found[2]) & np.isfinite(found[3])


def _extents_in_scale(F: Array, g: Array, scale: Array) -> tuple[Array, Array, Array, Array] | None:
    radius, y = inscribed_ball(*_unit(F * scale, g), cap=1.0)
    if radius < -FLAT:
        return None
    lower, upper = _extents(F * scale, g, slack=max(-radius, 0.0))
    return scale, y, lower, upper


def _needle_scale(F: Array, g: Array, scale: Array) -> Array:
    """Return the scale with longer coordinates where only rows that are almost parallel to one bound it."""
    size = np.abs(F).max(axis=1, keepdims=True)
    felt = np.abs(F) > 1e-13 * size
    reach = np.abs(g)[:, None] / np.where(felt, np.abs(F), 1.0)
    sides = [np.where(felt & (side * F > 0), reach, np.inf).min(axis=0) for side in (1, -1)]
    lengths = np.where(np.isfinite(sides), sides, 0.0).max(axis=0)
    return np.maximum(scale, lengths)


def _solve_equalities(A_eq: Array, b_eq: Array) -> tuple[Array, Array] | None:
    norms = np.linalg.norm(A_eq, axis=1)
    scale = np.where(norms > 0, norms, 1.0)
    rows, values = A_eq / scale[:, None], b_eq / scale
    centre = np.linalg.lstsq(rows, values, rcond=1e-12)[0]
    if np.abs(rows @ centre - values).max() > FLAT * max(1.0, np.abs(values).max()):
        return None
    return centre, null_space(rows)


def null_space(rows: Array) -> Array:
    """Return an orthonormal basis (n, k) of {x : rows x = 0}."""
    _, s, vt = np.linalg.svd(rows, full_matrices=True)
    rank = int((s > 1e-8 * max(s.max(initial=0.0), 1e-300)).sum())
    return vt[rank:].T


def normals(basis: Array) -> Array:
    """Return orthonormal rows (n − k, n) that are orthogonal to the k columns of a basis."""
    left, _, _ = np.linalg.svd(basis / np.linalg.norm(basis, axis=0), full_matrices=True)
    return left[:, basis.shape[1]:].T


def unit_rows(A: Array, b: Array, *, always: bool = False):
    """Return the rows scaled to unit norm without zero rows; (None, b) if a zero row says 0 <= negative."""
    norms = np.linalg.norm(A, axis=1)
    reference = norms.max(initial=0.0)
    zero = norms <= 1e-13 * reference if reference > 0 else np.ones(len(b), bool)
    if zero.any():
        if not always and (b[zero] < -FLAT * np.maximum(1.0, np.abs(b).max())).any():
            return None, b
        A, b, norms = A[~zero], b[~zero], norms[~zero]
    return A / norms[:, None], b / norms


def _unit(F: Array, g: Array) -> tuple[Array, Array]:
    norms = np.linalg.norm(F, axis=1)
    return F / norms[:, None], g / norms


def _rough_scale(F: Array, g: Array, *, plain: bool = False) -> Array:
    """Return one length per coordinate, read off the rows without solving anything.

    Rows and columns are first balanced (Ruiz 2001, A scaling algorithm to equilibrate both rows and columns norms in
    matrices), so that every coordinate is steep in some row; then the intercepts of those rows are its lengths. A
    `plain` scale does without the intercepts, which mislead where a row passes through the origin.
    """
    scale = np.ones(F.shape[1])
    rows, right = np.abs(F), np.abs(g)
    for _ in range(4):
        columns = rows.max(axis=0)
        if (columns > 0.5).all():
            break
        factor = np.where(columns > 0, 1 / np.where(columns > 0, columns, 1.0), 1.0)
        scale, rows = scale * factor, rows * factor
        size = rows.max(axis=1)
        rows, right = rows / size[:, None], right / size
    if right.max() == 0.0:
        return scale
    # the tightest steep row on either side of a coordinate, and the wider of the two sides
    reach = right[:, None] / np.where(rows > 0.5, rows, 1.0)
    sides = [np.where((rows > 0.5) & (side * F > 0), reach, np.inf).min(axis=0) for side in (1, -1)]
    lengths = np.where(np.isfinite(sides), sides, 0.0).max(axis=0)
    proper = lengths > 1e-14 * right.max()
    uniform = scale * (lengths[proper].max() if proper.any() else right.max())
    return uniform if plain else np.where(proper, scale * lengths, uniform)


def _extents(F: Array, g: Array, slack: float) -> tuple[Array, Array]:
    """Return the lower and upper coordinate bounds of {F y <= g + slack}, infinite where there is none."""
    norms = np.linalg.norm(F, axis=1)
    rows, values = F / norms[:, None], g / norms + 1.01 * slack
    eye = np.eye(F.shape[1])
    lower = np.array([minimise(row, rows, values)[0] for row in eye])
    upper = np.array([-minimise(-row, rows, values)[0] for row in eye])
    return lower, upper


def _implicit_equalities(F: Array, g: Array, y: Array, radius: float, thin: Array) -> Array:
    """Return the rows that hold with equality on the whole of a flat set."""
    near = np.flatnonzero(g - F @ y <= 10 * FLAT + 2 * radius)
    relaxed = g + 2 * FLAT
    flat = np.zeros(len(g), bool)
    for i in near:
        flat[i] = g[i] - minimise(F[i], F, relaxed)[0] <= 20 * FLAT
    return flat
