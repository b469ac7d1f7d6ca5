"""What a set is stated by, and what it is known by: `Stated` and `Body`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from invariant_sets.exceptions import NumericalError
from invariant_sets.tolerances import MUCH

Array = np.ndarray


class Stated(NamedTuple):
    """Rows A x <= b, A_eq x = b_eq, and sizes of terms behind b (m,), b_eq (k,).

    A right-hand side that is a difference may be wrong by the rounding of what it was computed from.
    """

    A: Array
    b: Array
    A_eq: Array
    b_eq: Array
    terms: Array
    terms_eq: Array

    @classmethod
    def given(cls, A: Array, b: Array, A_eq: Array, b_eq: Array) -> Stated:
        """Rows as a caller states them, right-hand sides rounded."""
        return cls(A, b, A_eq, b_eq, np.abs(b), np.abs(b_eq))

    @property
    def unit(self) -> Stated:
        """Rows of norm one; rows of norm zero stay."""
        size, size_eq = (np.where(norms > 0.0, norms, 1.0) for norms in (row_norms(self.A), row_norms(self.A_eq)))
        return Stated(
            self.A / size[:, None],
            self.b / size,
            self.A_eq / size_eq[:, None],
            self.b_eq / size_eq,
            self.terms / size,
            self.terms_eq / size_eq,
        )


@dataclass(frozen=True)
class Body:
    """Set {centre + basis y : F y <= g}, solid and scaled in y."""

    centre: Array  # (n,): an interior point relative to the affine hull
    basis: Array  # (n, k): columns span the affine hull; they carry the scale. Diagonal if k = n
    # rows of unit norm, g > 0, and the sizes of the terms of g. Rows that never touch a bounded set are left out
    F: Array  # (m, k)
    g: Array  # (m,)
    sizes: Array  # (m,)
    bounded: bool  # whether the set is bounded
    free: Array  # (k,) int: the coordinate of x that column j of the basis moves and no other column does
    # half the widths of the bounding box; 0 where it is flat, a length of the rows where it has no end
    half_widths: Array  # (n,)
    # size of the terms that each coordinate of the centre was computed from, in the units of x: the set's place is
    # known to `PLACE` of it. Where slanted rows meet it is larger than the coordinate
    terms: Array  # (n,)

    @property
    def inverse(self) -> Array:
        """Matrix (k, n) that takes x − centre to y."""
        inverse = np.zeros(self.basis.shape[::-1])
        columns = np.arange(len(self.free))
        inverse[columns, self.free] = 1 / self.basis[self.free, columns]
        return inverse

    @property
    def normals(self) -> Array:
        """Rows (n − k, n) that span the orthogonal complement of the hull."""
        n = len(self.centre)
        tied = np.ones(n, bool)
        tied[self.free] = False
        return np.asarray((np.eye(n) - self.basis @ self.inverse)[tied])

    @property
    def rows(self) -> Stated:
        """Set as unit rows on x."""
        A = self.F @ self.inverse
        A_eq = self.normals
        if not (np.isfinite(A).all() and A.any(axis=1).all()):
            raise NumericalError("The hull", A.shape, "its coordinates are too large or too small for doubles")
        return Stated(
            A,
            self.g + A @ self.centre,
            A_eq,
            A_eq @ self.centre,
            self.sizes + np.abs(A) @ self.terms,
            np.abs(A_eq) @ self.terms,
        ).unit

    def holds_part_of(self, whole: Body) -> bool:
        """Whether the tightened set holds a copy `1 / MUCH` times the `whole`."""
        return bool((self.g > whole.g / MUCH).all())


def bare_body(centre: Array, basis: Array, free: Array, terms: Array) -> Body:
    """Hull {centre + basis y} as a body without rows."""
    none = np.zeros(0)
    half_widths = np.abs(basis).sum(axis=1)
    return Body(centre, basis, np.zeros((0, len(free))), none, none, False, free, half_widths, terms)


def row_norms(rows: Array) -> Array:
    """Norms (m,) of rows (m, n), without overflow of squares."""
    return np.asarray(np.hypot.reduce(rows, axis=1, initial=0.0))
