"""A window on a set: the box, in coordinates of its own, through which the set is looked at until its extents are one.

What the window shows decides the next one: it moves closer until the extents of the set are one, and further away
while the set reaches its edges. A row that cannot reach the window has no influence on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from invariant_sets.linear_programs import Ball, largest_ball, maximise_in_box, ray_along
from invariant_sets.tolerances import CANCELLED, CLOSED, CLOSER, FLAT, LOST, ROUNDING, SETTLED, THIN, TINY

Array = np.ndarray
_HALF = 4.0  # half width of the window, in coordinates in which the set should have half widths of one
_FIRST = 8.0  # factor of the first window: first lengths come from the tightest rows, and sets are often longer
_FURTHER = 1e3  # factor of one step away
_FARTHEST = 1e300  # a set that has not ended here has no end that doubles can tell
UNLIKE = 3.0  # decades: a scale that is wrong by more is replaced
_STEPS = 500  # windows at most; one step is a factor of 1e3 or more for one coordinate at least, and doubles span 1e616


class Pinch(NamedTuple):
    """How much room the rows that hold the ball leave between them, and in which coordinates (k,) they do not close."""

    room: float
    open: Array

    @property
    def closed(self) -> bool:
        """Whether the rows close in every coordinate, so that `room` bounds the set."""
        return not self.open.any()

    @property
    def decided_by_rounding(self) -> bool:
        """Whether the room is no more than the rounding of the rows."""
        return self.room == 0.0


@dataclass(frozen=True)
class Window:
    """What is seen of {x : A x <= b} in x = centre + basis y, |y| <= `_HALF`."""

    # the coordinates
    centre: Array  # (n,)
    basis: Array  # (n, k)
    # the rows that depend on y, of unit norm, and by how much g may be wrong from rounding
    F: Array  # (m, k)
    g: Array  # (m,)
    error: Array  # (m,)
    index: Array  # (m,) int: their numbers in A
    near: Array  # (q,) int: those of F that can touch the window
    ball: Ball  # a largest ball in the window; its multipliers belong to the rows in `near`
    unbounded: Array  # (k,) bool: coordinates in which the set is known to have no end

    @property
    def multipliers(self) -> Array:
        """Multipliers of the ball for all rows, (m,)."""
        full = np.zeros(len(self.g))
        full[self.near] = self.ball.dual
        return full

    @cached_property
    def pinch(self) -> Pinch:
        """What the rows that hold the ball say together.

        With multipliers λ >= 0 and Fᵀλ = 0 every point has λᵀg >= 0: a negative λᵀg proves that the set is empty
        (Farkas), and a zero one that the rows hold with equality. The room is zero where rounding decides.
        """
        dual = self.ball.dual
        F = self.F[self.near]
        level = float(dual @ self.g[self.near])
        doubt = float(dual @ self.error[self.near])
        left_open = np.abs(dual @ F) > CLOSED * (dual @ np.abs(F))
        return Pinch(0.0 if abs(level) <= doubt else level, left_open)

    @cached_property
    def is_flat(self) -> bool:
        """Whether the set is thinner than `FLAT` of the window, or than the rounding of the rows that hold it."""
        if self.ball.radius <= FLAT:
            return True
        return bool(self.pinch.decided_by_rounding and self.ball.dual.any() and self.pinch.closed)


def look(A: Array, b: Array, terms: Array, centre: Array, basis: Array, *, cancelled: float) -> Window | None:
    """Return the window in which the extents of the set are one; None if the set is empty.

    The window ends where the set is solid and has the right size, or is flat: then `ball.radius` <= `FLAT`, and no
    closer look would change that.
    """
    k = basis.shape[1]
    basis = _FIRST * basis
    unbounded = np.zeros(k, bool)
    settled = False
    resized = 0
    for _ in range(_STEPS):
        window = _window(A, b, terms, centre, basis, unbounded, cancelled)
        if window is None or k == 0:
            return window
        radius = window.ball.radius
        if settled and not window.is_flat:
            return window
        if window.is_flat:
            pinch = window.pinch
            if pinch.room < 0 and radius < -(FLAT if settled else THIN) and pinch.closed:
                beyond, _ = _ends(window, unbounded)[2:]
                if not beyond.any():
                    return None
                basis = basis * np.where(beyond, _FURTHER, 1.0)  # it misses by less than it is long
                continue
            if radius < -THIN:
                basis = basis * np.where(pinch.open, _FURTHER, 1.0)
                continue
            if settled or (pinch.decided_by_rounding and pinch.closed):
                return window
        lower, upper, beyond, unbounded = _ends(window, unbounded)
        if beyond.any():
            basis = basis * np.where(beyond, _FURTHER, 1.0)
            continue
        middle, half = _frame(window, lower, upper, unbounded)
        if window.is_flat:  # closer only where the rows close: that makes their other coordinates felt
            half = np.where(window.pinch.open, np.maximum(half, 1.0), half)
        right_size = np.abs(np.log10(half[unbounded])).max(initial=0.0) < UNLIKE or resized > 3
        resized += 1 if unbounded.any() else 0
        settled = bool((half[~unbounded] >= SETTLED).all()) and right_size
        centre = centre + basis @ middle
        basis = basis * half
    return window


def _window(A: Array, b: Array, terms: Array, centre: Array, basis: Array, unbounded: Array,
            cancelled: float) -> Window | None:
    """Return what is seen in the coordinates given; None if a row that is parallel to the hull excludes all of it."""
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
        parallel = (left == 0.0) | ((left <= cancelled * steep) & (_HALF * np.abs(F).sum(axis=1) <= error))
        g = np.where(left < LOST * steep, g + error, g)  # of a row that the hull nearly holds only rounding is left
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
    near = (g <= _HALF * np.abs(F).sum(axis=1)).nonzero()[0]
    ball = Ball(1.0, np.zeros(F.shape[1]), np.zeros(len(near)))
    if len(near):
        ball = largest_ball(F[near], g[near], 1.0, box=_HALF)
    return Window(centre, basis, F, g, error, index, near, ball, unbounded)


def _extents(window: Window) -> tuple[Array, Array]:
    """Return the lower and upper ends (k,) of what is seen of the set, at most `_HALF`."""
    k = window.F.shape[1]
    F = window.F[window.near]
    g = window.g[window.near] + 1.01 * max(-window.ball.radius, 0.0)
    eye = np.eye(k)
    ends = maximise_in_box(np.concatenate([eye, -eye]), F, g, _HALF)
    return -ends[k:], ends[:k]


def _ends(window: Window, unbounded: Array) -> tuple[Array, Array, Array, Array]:
    """Return the extents, in which coordinates (k,) the set leaves the window, and in which it has no end."""
    lower, upper = _extents(window)
    beyond = ((lower < -0.99 * _HALF) | (upper > 0.99 * _HALF)) & ~unbounded
    if beyond.any():
        far = np.abs(window.basis).max(axis=0) > _FARTHEST
        endless = (_endless(window, lower, upper) | far) & beyond
        return lower, upper, beyond & ~endless, unbounded | endless
    return lower, upper, beyond, unbounded


def _endless(window: Window, lower: Array, upper: Array) -> Array:
    """Return the coordinates (k,) in which the set has no end, as a ray of its recession cone proves."""
    k = window.F.shape[1]
    answer = np.zeros(k, bool)
    for j in range(k):
        for end, side in ((upper[j], 1.0), (-lower[j], -1.0)):
            if end > 0.99 * _HALF and not answer[j]:
                answer[j] = ray_along(side * np.eye(k)[j], window.F) is not None
    return answer


def _frame(window: Window, lower: Array, upper: Array, unbounded: Array) -> tuple[Array, Array]:
    """Return middle and half width (k,) of the next window.

    A coordinate without an end gets the smallest length at which a row feels it as much as the other coordinates.
    """
    middle = (lower + upper) / 2
    half = np.maximum((upper - lower) / 2, CLOSER)
    if not unbounded.any():
        return middle, half
    ends = np.where(lower > -0.99 * _HALF, lower, np.where(upper < 0.99 * _HALF, upper, window.ball.centre))
    middle = np.where(unbounded, ends, middle)
    slope = np.abs(window.F)
    felt = slope[:, ~unbounded] @ half[~unbounded] + np.abs(window.g - window.F @ middle)
    felt = np.where(felt > np.maximum(window.error, CLOSER), felt, np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        length = np.where(slope > CANCELLED, felt[:, None] / slope, np.inf).min(axis=0, initial=np.inf)
    length = np.where(np.isfinite(length), np.clip(length, CLOSER, 1 / CLOSER), 1.0)
    return middle, np.where(unbounded, length, half)


def half_widths(window: Window) -> Array:
    """Return half the width (n,) of the set in every coordinate of x; 0 in those in which it is flat."""
    basis = window.basis
    k = basis.shape[1]
    reach = np.abs(basis).sum(axis=1)
    if k < len(basis) and k > 0 and len(window.near):
        mixed = np.count_nonzero(basis, axis=1) > 1
        D = basis[mixed] / reach[mixed, None]
        g = window.g[window.near] + 1.01 * max(-window.ball.radius, 0.0)
        ends = maximise_in_box(np.concatenate([D, -D]), window.F[window.near], g, _HALF)
        reach[mixed] *= np.maximum((ends[:len(D)] + ends[len(D):]) / 2, FLAT)
    return np.where(reach > ROUNDING * np.abs(window.centre), reach, 0.0)


def hidden_equalities(window: Window) -> Array:
    """Return the numbers in A of independent rows that hold with equality on the whole of a flat set.

    The slack of a row of multiplier λᵢ is at most radius / λᵢ: with the largest ones it is a few times `FLAT`. Those
    of the least doubt come first: a row that the hull nearly holds says little of where it goes.
    """
    dual = window.multipliers
    order = np.argsort(abs(window.ball.radius) / np.maximum(dual, TINY) + window.error)
    kept: list[int] = []
    directions = np.zeros((0, window.F.shape[1]))
    for i in order[dual[order] > 0.05 * dual.max()]:
        rest = window.F[i] - directions.T @ (directions @ window.F[i])
        size = np.linalg.norm(rest)
        if size > 0.01:
            directions = np.vstack([directions, rest / size])
            kept.append(int(i))
    return window.index[kept]
