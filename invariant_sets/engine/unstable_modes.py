"""Bounds on the unstable modes that a bounded input can hold."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from invariant_sets.tolerances import DOUBLE_EIGENVALUE, EDGE, REAL_EIGENVALUE, SERIES_END, UNSTABLE

Array = np.ndarray


def unstable_bounds(A: Array, inputs: Array, disturbances: Array | None = None) -> tuple[Array, Array, Array]:
    """Bounds D x <= h on states that can stay bounded, and their groups.

    With z = L x, L A = Λ L on the left invariant subspace of |λ| > 1, a bounded trajectory satisfies
    −z₀ = Σ_{j≥1} Λ^{-j} L (B u_{j-1} + E w_{j-1}). Against every w this needs
    dᵀz₀ <= Σ_{j≥1} max_u (−dᵀΛ^{-j}L B u) − max_w (dᵀΛ^{-j}L E w), for any direction d.

    Parameters
    ----------
    A : (n, n) array
        State matrix.
    inputs : (m, n) array
        The vertices of B U, one a row.
    disturbances : (q, n) array, optional
        The vertices of E W, one a row.

    Returns
    -------
    D, h, group : (k, n), (k,) and (k,) arrays
        Both signs of every direction: the left eigenvectors of real unstable eigenvalues; for complex pairs and
        Jordan blocks a basis of the invariant subspace, and all facets of the sum if it is a plane. Each value
        is an upper bound: the tail of the series is added. k = 0 if nothing is unstable. A row holds only if
        the set is bounded along all rows of its group.

    Notes
    -----
    Assumes bounded U and W, and an X bounded along D. For one real λ > 1 and |u| <= 1 the bound is
    |vᵀx| <= |vᵀB|/(λ − 1) with v a *left* eigenvector.

    References
    ----------
    Hu, Lin (2001), Control Systems with Actuator Saturation, chapter 2: asymptotically null controllable region.
    """
    values, left = np.linalg.eig(A.T)
    radius = np.abs(values)
    unstable = radius > 1.0 + UNSTABLE
    if not unstable.any():
        return np.zeros((0, len(A))), np.zeros(0), np.zeros(0, int)
    real = np.abs(values.imag) <= REAL_EIGENVALUE * radius
    simple = np.array([np.sum(np.abs(values - value) <= DOUBLE_EIGENVALUE * abs(value)) == 1 for value in values])
    rows: list[Array] = []
    bounds: list[tuple[float, float]] = []
    groups: list[int] = []
    for i in np.flatnonzero(unstable & real & simple):
        direction = left[:, i].real
        rows.append(direction)
        bounds.append(_mode_bound(values[i].real, direction, inputs, disturbances))
        groups.append(int(i))
    if (unstable & ~(real & simple)).any() or np.count_nonzero(unstable) == 2:
        for row, bound in _subspace_bounds(A, inputs, disturbances):
            rows.append(row)
            bounds.append(bound)
            groups.append(-1)
    D = np.array(rows)
    pairs = np.array(bounds)
    return np.vstack([D, -D]), np.concatenate([pairs[:, 0], pairs[:, 1]]), np.array(groups + groups)


def _mode_bound(value: float, v: Array, inputs: Array, disturbances: Array | None) -> tuple[float, float]:
    """Largest vᵀx and −vᵀx for one real eigenvalue, in closed form."""
    u = inputs @ v
    w = np.zeros(1) if disturbances is None else disturbances @ v
    gain = np.array([-u.min() - w.max(), u.max() + w.min()])  # one step back along +v and −v for λ > 0
    if value > 0:
        up, down = gain / (value - 1.0)
        return float(up), float(down)
    # λ < 0: λ^{-j} alternates in sign, so the two sides alternate too
    size = -value
    flipped = gain[::-1]
    up, down = (flipped * size + gain) / (size**2 - 1.0)
    return float(up), float(down)


def _subspace_bounds(A: Array, inputs: Array,
                     disturbances: Array | None) -> Iterator[tuple[Array, tuple[float, float]]]:
    """Yield rows and their two bounds on the left unstable subspace."""
    from scipy.linalg import schur

    def outside(real: float, imaginary: float = 0.0) -> bool:
        """Whether an eigenvalue is unstable."""
        return bool(np.hypot(real, imaginary) > 1.0 + UNSTABLE)

    T, Z, k = schur(A.T, output="real", sort=outside)
    L = Z[:, :k].T  # L A = Λ L with Λ = T₁₁ᵀ
    inverse = np.linalg.inv(T[:k, :k].T)
    reach = max(np.abs(inputs).max(), 0.0 if disturbances is None else np.abs(disturbances).max())
    powers, next_power = _powers(inverse)
    tail = _tail(next_power, inverse, reach * np.sqrt(A.shape[0]))
    back = powers @ L  # (terms, k, n)
    moves = back @ inputs.T
    drifts = np.zeros((len(back), k, 1)) if disturbances is None else back @ disturbances.T
    for c in np.vstack([np.eye(k), _edge_normals(moves) if k == 2 else np.zeros((0, k))]):
        u = np.tensordot(c, moves, (0, 1))
        w = np.tensordot(c, drifts, (0, 1))
        up = (-u.min(axis=1) - w.max(axis=1)).sum() + tail
        down = (u.max(axis=1) + w.min(axis=1)).sum() + tail
        yield c @ L, (float(up), float(down))


def _powers(inverse: Array) -> tuple[Array, Array]:
    """Powers Λ⁻¹, Λ⁻², … (j, k, k) until negligible, and the next."""
    powers = [inverse]
    power = inverse @ inverse
    while len(powers) < 20_000 and np.linalg.norm(power) > SERIES_END:
        powers.append(power)
        power = power @ inverse
    return np.array(powers), power


def _edge_normals(moves: Array) -> Array:
    """Facet normals (j, 2) of ⊕ Λ^{-j} L B U in the plane."""
    first, second = np.triu_indices(moves.shape[2], k=1)
    edges = (moves[:, :, first] - moves[:, :, second]).transpose(0, 2, 1).reshape(-1, 2)
    length = np.linalg.norm(edges, axis=1)
    edges = edges[length > EDGE * length.max(initial=0.0)][:400]  # barely unstable: the recursion finds more
    return np.asarray(np.column_stack([-edges[:, 1], edges[:, 0]]) / np.linalg.norm(edges, axis=1)[:, None])


def _tail(block: Array, inverse: Array, reach: float) -> float:
    """Upper bound of the dropped terms Σ ‖Λ^{-j}‖ · reach."""
    step = 1
    power = inverse
    while np.linalg.norm(power) > 0.5 and step < 2**40:
        power = power @ power
        step = 2 * step
    partial = block
    total = 0.0
    count = 0
    while count < min(step, 2000):
        total += float(np.linalg.norm(partial))
        partial = partial @ inverse
        count += 1
    if count < step:
        total *= step / count
    return 2.0 * total * reach
