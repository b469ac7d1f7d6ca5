"""Box around a set in rescaled coordinates of its own.

What the box shows decides the next one: it moves closer until the extents of the set are one, and further away
while the set reaches its edges. A row that cannot reach the box has no influence on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from invariant_sets.linear_programs import Ball, largest_ball, maximise_in_box, ray_along
from invariant_sets.tolerances import COARSE, FLAT, LP_SOLVER, MUCH, ROUNDING

Array = np.ndarray
HALF_BOX = 4.0  # half width of the local box, where the set should have half widths of one


@dataclass(frozen=True)
class LocalBox:
    """Set {A x <= b} within x = centre + basis y, |y| <= `HALF_BOX`."""

    # the coordinates
    centre: Array  # (n,)
    basis: Array  # (n, k)
    # the rows that depend on y, of unit norm, and by how much g may be wrong from rounding
    F: Array  # (m, k)
    g: Array  # (m,)
    error: Array  # (m,)
    index: Array  # (m,) int: their numbers in A
    near: Array  # (q,) int: those of F that can touch the box
    ball: Ball  # a largest ball in the box; its multipliers belong to the rows in `near`
    unbounded: Array  # (k,) bool: coordinates in which the set is known to have no end

    @property
    def multipliers(self) -> Array:
        """Multipliers of the ball for all rows, (m,)."""
        full = np.zeros(len(self.g))
        full[self.near] = self.ball.dual
        return full

    @cached_property
    def room(self) -> float:
        """Room left by the rows that hold the ball, zero where their rounding decides.

        With multipliers λ >= 0 and Fᵀλ = 0 every point has λᵀg >= 0: a negative λᵀg proves that the set is empty
        (Farkas), and a zero one that the rows hold with equality.
        """
        level = float(self.ball.dual @ self.g[self.near])
        return 0.0 if abs(level) <= float(self.ball.dual @ self.error[self.near]) else level

    @cached_property
    def open(self) -> Array:
        """Coordinates (k,) in which `room` does not bound the set."""
        F = self.F[self.near]
        return np.asarray(np.abs(self.ball.dual @ F) > LP_SOLVER * (self.ball.dual @ np.abs(F)))

    @cached_property
    def is_flat(self) -> bool:
        """Whether the set is thinner than `FLAT` of the box, or rounding."""
        if self.ball.radius <= FLAT:
            return True
        return bool(self.room == 0.0 and self.ball.dual.any() and not self.open.any())


def rescaled_view(
    A: Array, b: Array, terms: Array, centre: Array, basis: Array, *, cancelled: float
) -> LocalBox | None:
    """Box with unit extents of the set; None if it is empty.

    The view ends where the set is solid and has the right size, or is flat: then `ball.radius` <= `FLAT`, and no
    closer look would change that.
    """
    k = basis.shape[1]
    basis = 8.0 * basis  # first lengths come from the tightest rows, and sets are often longer
    unbounded = np.zeros(k, bool)
    settled = False
    resized = 0
    for _ in range(500):  # one step is 1e3 or more for one coordinate at least, and doubles span 1e616
        box = _local_box(A, b, terms, centre, basis, unbounded, cancelled)
        if box is None or k == 0:
            return box
        closed = box.is_flat and not box.open.any()
        misses = closed and box.room < 0 and box.ball.radius < -(FLAT if settled else COARSE)
        if box.is_flat and not misses and box.ball.radius < -COARSE:
            basis = basis * np.where(box.open, MUCH, 1.0)
            continue
        if not misses and (settled or (closed and box.room == 0.0)):
            return box
        lower, upper, beyond, unbounded = _ends(box, unbounded)
        if beyond.any():  # a set that is missed may miss by less than it is long
            basis = basis * np.where(beyond, MUCH, 1.0)
            continue
        if misses:
            return None
        middle, half = _frame(box, lower, upper, unbounded)
        if box.is_flat:  # closer only where the rows close: that makes their other coordinates felt
            half = np.where(box.open, np.maximum(half, 1.0), half)
        right_size = np.abs(np.log10(half[unbounded])).max(initial=0.0) < np.log10(MUCH) or resized > 3
        resized += 1 if unbounded.any() else 0
        settled = bool((half[~unbounded] >= 1 / MUCH).all()) and right_size
        centre = centre + basis @ middle
        basis = basis * half
    return box


def _local_box(
    A: Array, b: Array, terms: Array, centre: Array, basis: Array, unbounded: Array, cancelled: float
) -> LocalBox | None:
    """Box in the given coordinates; None if a parallel row excludes it."""
    F = A @ basis
    g = b - A @ centre
    slope = np.abs(A)
    error = ROUNDING * (terms + slope @ np.abs(centre))
    index = np.arange(len(b))
    if basis.shape[1] < basis.shape[0]:
        sizes = slope @ np.abs(basis)
        F[np.abs(F) <= cancelled * sizes] = 0.0
        steep = sizes.max(axis=1, initial=0.0)
        left = np.abs(F).max(axis=1, initial=0.0)
        parallel = (left == 0.0) | ((left <= cancelled * steep) & (HALF_BOX * np.abs(F).sum(axis=1) <= error))
        g = np.where(left < steep / MUCH, g + error, g)  # of a row that the hull nearly holds only rounding is left
        if parallel.any():
            if (g[parallel] < -error[parallel] - 100 * cancelled * sizes[parallel].sum(axis=1)).any():
                return None
            index = (~parallel).nonzero()[0]
            F = F[index]
            g = g[index]
            error = error[index]
    size = np.abs(F).max(axis=1, initial=0.0)
    F = F / size[:, None]
    norms = np.sqrt((F * F).sum(axis=1))
    F = F / norms[:, None]
    with np.errstate(over="ignore"):  # a bound beyond doubles is none
        g = g / size / norms
        error = error / size / norms
    near = (g <= HALF_BOX * np.abs(F).sum(axis=1)).nonzero()[0]
    ball = Ball(1.0, np.zeros(F.shape[1]), np.zeros(len(near)))
    if len(near):
        ball = largest_ball(F[near], g[near], box=HALF_BOX)
    return LocalBox(centre, basis, F, g, error, index, near, ball, unbounded)


def _extents(box: LocalBox, D: Array) -> tuple[Array, Array]:
    """Lower and upper ends (k,) of the set within the box along the rows of D."""
    g = box.g[box.near] + 1.01 * max(-box.ball.radius, 0.0)
    ends = maximise_in_box(np.concatenate([D, -D]), box.F[box.near], g, HALF_BOX)
    return -ends[len(D) :], ends[: len(D)]


def _ends(box: LocalBox, unbounded: Array) -> tuple[Array, Array, Array, Array]:
    """Extents, coordinates (k,) that leave the box, and endless ones."""
    lower, upper = _extents(box, np.eye(box.F.shape[1]))
    beyond = ((lower < -0.99 * HALF_BOX) | (upper > 0.99 * HALF_BOX)) & ~unbounded
    if beyond.any():
        far = np.abs(box.basis).max(axis=0) > np.finfo(float).max / MUCH  # one step further doubles end
        endless = (_endless(box, lower, upper) | far) & beyond
        return lower, upper, beyond & ~endless, unbounded | endless
    return lower, upper, beyond, unbounded


def _endless(box: LocalBox, lower: Array, upper: Array) -> Array:
    """Whether the set has no end in each coordinate (k,)."""
    k = box.F.shape[1]
    answer = np.zeros(k, bool)
    for j in range(k):
        for end, side in ((upper[j], 1.0), (-lower[j], -1.0)):
            if end > 0.99 * HALF_BOX and not answer[j]:
                answer[j] = ray_along(side * np.eye(k)[j], box.F) is not None
    return answer


def _frame(box: LocalBox, lower: Array, upper: Array, unbounded: Array) -> tuple[Array, Array]:
    """Middle and half width (k,) of the next box; without an end, the least that a row feels like the others."""
    middle = (lower + upper) / 2
    half = np.maximum((upper - lower) / 2, COARSE)
    if not unbounded.any():
        return middle, half
    ends = np.where(lower > -0.99 * HALF_BOX, lower, np.where(upper < 0.99 * HALF_BOX, upper, box.ball.centre))
    middle = np.where(unbounded, ends, middle)
    slope = np.abs(box.F)
    felt = slope[:, ~unbounded] @ half[~unbounded] + np.abs(box.g - box.F @ middle)
    felt = np.where(felt > np.maximum(box.error, COARSE), felt, np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        length = np.where(slope > ROUNDING, felt[:, None] / slope, np.inf).min(axis=0, initial=np.inf)
    length = np.where(np.isfinite(length), np.clip(length, COARSE, 1 / COARSE), 1.0)
    return middle, np.where(unbounded, length, half)


def half_widths(box: LocalBox) -> Array:
    """Half width (n,) of the set in every coordinate; 0 if flat."""
    basis = box.basis
    k = basis.shape[1]
    reach = np.abs(basis).sum(axis=1)
    if k < len(basis) and k > 0 and len(box.near):
        mixed = np.count_nonzero(basis, axis=1) > 1
        lower, upper = _extents(box, basis[mixed] / reach[mixed, None])
        reach[mixed] *= np.maximum((upper - lower) / 2, FLAT)
    return np.where(reach > ROUNDING * np.abs(box.centre), reach, 0.0)


def hidden_equalities(box: LocalBox) -> Array:
    """Numbers in A of independent rows tight on a whole flat set.

    The slack of a row of multiplier λᵢ is at most radius / λᵢ: with the largest ones it is a few times `FLAT`. Those
    of the least doubt come first: a row that the hull nearly holds says little of where it goes.
    """
    dual = box.multipliers
    order = np.argsort(abs(box.ball.radius) / np.maximum(dual, np.finfo(float).tiny) + box.error)
    kept: list[int] = []
    directions = np.zeros((0, box.F.shape[1]))
    for i in order[dual[order] > 0.05 * dual.max()]:
        rest = box.F[i] - directions.T @ (directions @ box.F[i])
        size = np.linalg.norm(rest)
        if size > 0.01:
            directions = np.vstack([directions, rest / size])
            kept.append(int(i))
    return box.index[kept]
