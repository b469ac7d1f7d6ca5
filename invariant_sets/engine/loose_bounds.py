"""Removal of bounds that play no part, such as 1e20, and bounds on unstable modes that do.

A bound is loose where it lets one step move a coordinate by far more than the states are wide there. In units of such
bounds nothing else could be seen. Those on the states go, and the problem is that without them; those on the inputs
are replaced by a box that holds the inputs of every trajectory of a few steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import reduce

import numpy as np

from invariant_sets.engine.trajectories import state_maps
from invariant_sets.exceptions import NumericalError
from invariant_sets.polyhedron import nonempty_body, set_of
from invariant_sets.polytope import Polytope
from invariant_sets.system_checks import LinearSystem
from invariant_sets.tolerances import EIGENVALUE, FLAT, MUCH, ROUNDING, SMALL

Array = np.ndarray


def without_loose_bounds(
    system: LinearSystem, X: Polytope, U: Polytope, target: Polytope | None = None
) -> tuple[LinearSystem, Polytope, Polytope]:
    """Problem without rows and inputs that cannot matter in one step to `target`.

    Without a target, in staying in X for ever. Where U has to be cut, inputs that move the state alike become one.
    """
    system, X, U = _within_reach(system, X, U, target)
    if target is None:
        held = _within_unstable_modes(system, X, U)
        if held is not X:
            return _within_reach(system, held, U, None)
    return system, X, U


def _within_reach(
    system: LinearSystem, X: Polytope, U: Polytope, target: Polytope | None
) -> tuple[LinearSystem, Polytope, Polytope]:
    """Problem with what is felt in one step, or in nx."""
    states = X.body
    inputs = U.body
    goal = states if target is None else target.body
    if states is None or inputs is None or goal is None or not len(goal.g):
        return system, X, U
    half = states.half_widths
    if not states.bounded:  # what has no end has no bound
        half = np.where(np.isfinite(np.subtract(*X.bounding_box())), half, 0.0)
    width = MUCH * np.where(goal.half_widths > 0.0, goal.half_widths, np.inf)
    with np.errstate(over="ignore"):
        strong = not inputs.bounded or bool((np.abs(system.B) @ inputs.half_widths > width).any())
        loose = bool((np.abs(system.A) * half > width[:, None]).any())
    if not strong and not loose:
        return system, X, U
    if strong:
        system, U = _independent_inputs(system, U, np.where(goal.half_widths > 0.0, goal.half_widths, 1.0))
    nu = U.dim
    moves, drift = state_maps(system, X.dim if target is None else 1)
    goals = [X] * (len(moves) - 2) + [X if target is None else target]
    lifted = reduce(Polytope.cartesian_product, [U] * len(goals), X)  # (x, u₀, …) of whole trajectories
    for M, c, after in zip(moves[1:], drift[1:], goals):
        lifted = lifted.intersection(after.preimage(M, c))
    if lifted.is_empty:
        return system, X, U
    eye = np.eye(lifted.dim)[X.dim : X.dim + nu]
    upper = lifted.support(eye)
    lower = -lifted.support(-eye)
    room = SMALL * np.where(np.isfinite(upper - lower), upper - lower, 0.0)
    cut = U.intersection(Polytope.from_bounds(lower - room, upper + room))
    useful = cut if cut.body is None else set_of(Polytope, cut.body.rows, body=cut.body)  # the rows that are felt
    return system, _felt(X, lifted, moves[:-1], drift[:-1]), useful


def _within_unstable_modes(system: LinearSystem, X: Polytope, U: Polytope) -> Polytope:
    """X cut to where bounded inputs can hold the unstable modes; `NumericalError` if next to nothing is left."""
    from scipy.linalg import matrix_balance

    A, (units, _) = matrix_balance(system.A, permute=False, separate=True)
    if X.is_empty or not U.is_bounded or np.abs(np.linalg.eigvals(A)).max() <= 1 + EIGENVALUE:
        return X
    moves = U.vertices @ system.B.T / units
    size = np.abs(moves).max() or 1.0
    disturbances = None if system.disturbances is None else system.disturbances / units / size
    D, d, group = unstable_bounds(A, moves / size, disturbances)
    D = D / units / size
    room, width = (ends[: len(d) // 2] + ends[len(d) // 2 :] for ends in (X.support(D), d))
    loose = (width > 0.0) & (room > MUCH * width) & ~np.isin(group[: len(width)], group[np.tile(np.isinf(room), 2)])
    if not loose.any():
        return X
    cut = X.intersection(Polytope(D[np.tile(loose, 2)], d[np.tile(loose, 2)]))
    if not cut.is_empty and cut.affine_dim < X.affine_dim:
        raise NumericalError("X", X.A.shape, "what inputs can hold of its unstable modes is nothing beside the others")
    return cut


def _felt(X: Polytope, lifted: Polytope, moves: list[Array], drift: list[Array]) -> Polytope:
    """X without the rows that no trajectory comes near; what has no width has nothing far away."""
    body = nonempty_body(lifted, "backward_step")
    far = np.abs(X.A) @ body.half_widths[: X.dim] > 0.0
    for M, c in zip(moves, drift):
        upper = lifted.support(X.A @ M)
        lower = -lifted.support(-X.A @ M)
        far &= SMALL * (X.b - X.A @ c - upper) > upper - lower
    return Polytope(X.A[~far], X.b[~far], X.A_eq, X.b_eq)


def _independent_inputs(system: LinearSystem, U: Polytope, width: Array) -> tuple[LinearSystem, Polytope]:
    """System with independent inputs in units of `width` (n,), and their set."""
    left, values, vt = np.linalg.svd(system.B / width[:, None], full_matrices=False)
    rank = int((values > FLAT * values.max(initial=0.0)).sum())
    if rank in (0, U.dim):
        return system, U
    moves = width[:, None] * left[:, :rank]
    return replace(system, B=moves), U.affine_map(values[:rank, None] * vt[:rank])


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
    unstable = radius > 1.0 + EIGENVALUE
    if not unstable.any():
        return np.zeros((0, len(A))), np.zeros(0), np.zeros(0, int)
    real = np.abs(values.imag) <= ROUNDING * radius
    simple = np.array([np.sum(np.abs(values - value) <= EIGENVALUE * abs(value)) == 1 for value in values])
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


def _subspace_bounds(
    A: Array, inputs: Array, disturbances: Array | None
) -> Iterator[tuple[Array, tuple[float, float]]]:
    """Yield rows and their two bounds on the left unstable subspace."""
    from scipy.linalg import schur

    def outside(real: float, imaginary: float = 0.0) -> bool:
        """Whether an eigenvalue is unstable."""
        return bool(np.hypot(real, imaginary) > 1.0 + EIGENVALUE)

    T, Z, k = schur(A.T, output="real", sort=outside)
    L = Z[:, :k].T  # L A = Λ L with Λ = T₁₁ᵀ
    inverse = np.linalg.inv(T[:k, :k].T)
    reach = max(np.abs(inputs).max(), 0.0 if disturbances is None else np.abs(disturbances).max())
    powers, next_power = _powers(inverse)
    dropped = np.linalg.norm(next_power)
    sum_of_powers = 1.0 + np.linalg.norm(powers, axis=(1, 2)).sum()
    tail = reach * np.sqrt(A.shape[0]) * (sum_of_powers * dropped / (1.0 - dropped) if dropped < 1.0 else np.inf)
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
    while len(powers) < 20_000 and np.linalg.norm(power) > np.finfo(float).eps:
        powers.append(power)
        power = power @ inverse
    return np.array(powers), power


def _edge_normals(moves: Array) -> Array:
    """Facet normals (j, 2) of ⊕ Λ^{-j} L B U in the plane."""
    first, second = np.triu_indices(moves.shape[2], k=1)
    edges = (moves[:, :, first] - moves[:, :, second]).transpose(0, 2, 1).reshape(-1, 2)
    length = np.linalg.norm(edges, axis=1)
    edges = edges[length > FLAT * length.max(initial=0.0)][:400]  # barely unstable: the recursion finds more
    return np.asarray(np.column_stack([-edges[:, 1], edges[:, 0]]) / np.linalg.norm(edges, axis=1)[:, None])
