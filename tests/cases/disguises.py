"""Sets of every kind in natural units, and other descriptions of the same sets: units, order, more rows, shears."""

from dataclasses import dataclass

import numpy as np

from invariant_sets import Polytope


@dataclass(frozen=True)
class Rows:
    """{x : A x <= b, E x = e}."""

    A: np.ndarray
    b: np.ndarray
    E: np.ndarray
    e: np.ndarray

    @property
    def polytope(self):
        return Polytope(self.A, self.b, self.E, self.e)

    def mapped(self, inverse):
        """Return the rows of {M x} with M = inverse⁻¹."""
        return Rows(self.A @ inverse, self.b, self.E @ inverse, self.e)

    def inequalities(self, A, b):
        return Rows(np.asarray(A), np.asarray(b), self.E, self.e)


def only(A, b):
    A = np.asarray(A, float)
    return Rows(A, np.asarray(b, float), np.zeros((0, A.shape[1])), np.zeros(0))


# --- the sets, each with its affine dimension relative to n and whether it is bounded ----------------------------


def box(rng, n):
    lower = rng.normal(size=n)
    return only(np.vstack([np.eye(n), -np.eye(n)]), np.r_[lower + rng.uniform(0.1, 3, n), -lower])


def solid(rng, n):
    A = np.vstack([rng.normal(size=(2 * n, n)), np.eye(n), -np.eye(n)])
    return only(A, np.r_[rng.uniform(0.3, 1, 2 * n), np.full(2 * n, 2.0)])


def thin(rng, n):
    Q, width = np.linalg.qr(rng.normal(size=(n, n)))[0], 10.0 ** rng.uniform(-5, 0, n)
    centre = Q @ rng.normal(size=n)
    return only(np.vstack([Q, -Q]), np.r_[width + centre, width - centre])


def slab(rng, n):
    N = np.round(rng.normal(size=(n - 1, n)), 2)
    return only(np.vstack([N, -N]), rng.uniform(0.1, 1, 2 * (n - 1)))


def cone(rng, n):
    A = rng.normal(size=(n + 1, n))
    A *= np.where(A.sum(axis=1) > 0, 1, -1)[:, None]  # −(1, …, 1) is a ray
    return only(A, A @ rng.normal(size=n))


def homogeneous_cone(rng, n):
    rows = cone(rng, n)
    return only(rows.A, 0 * rows.b)


def with_equality(rng, n):
    E = np.round(rng.normal(size=(1, n)), 2)
    rows = solid(rng, n)
    return Rows(np.vstack([rows.A, 0.5 * E, -E]), np.r_[rows.b, 1.0, 2.0], E, np.array([0.05]))


def hidden_equality(rng, n):
    rows, a = solid(rng, n), np.round(rng.normal(size=n), 2)
    return only(np.vstack([rows.A, a, -3 * a]), np.r_[rows.b, 0.05, -0.15])


def point(rng, n):
    A, x = np.vstack([rng.normal(size=(n, n)), -np.ones(n)]), np.round(rng.normal(size=n), 3)
    A[n] = -A[:n].sum(axis=0)
    return only(A, A @ x)


def empty(rng, n):
    rows, a = solid(rng, n), rng.normal(size=n)
    return only(np.vstack([rows.A, a, -a]), np.r_[rows.b, 0.0, -0.01])


BOUNDED = [box, solid, thin]
KINDS = [*BOUNDED, slab, cone, homogeneous_cone, with_equality, hidden_equality, point, empty]
DIMENSION = {with_equality: -1, hidden_equality: -1}


# --- other descriptions of the same set ----------------------------------------------------------------------------


def shuffled(rng, rows):
    order, order_eq = rng.permutation(len(rows.b)), rng.permutation(len(rows.e))
    return Rows(rows.A[order], rows.b[order], rows.E[order_eq], rows.e[order_eq])


def duplicated(rng, rows):
    i, factor = rng.integers(0, len(rows.b), 3), 10.0 ** rng.integers(-6, 7, 3)
    more = rows.inequalities(np.vstack([rows.A, rows.A[i] * factor[:, None]]), np.r_[rows.b, rows.b[i] * factor])
    return Rows(more.A, more.b, np.vstack([more.E, -7 * more.E]), np.r_[more.e, -7 * more.e])


def with_far_rows(rng, rows):
    i = rng.integers(0, len(rows.b), 2)
    far = np.linalg.norm(rows.A[i], axis=1) * 10.0 ** np.array([rng.integers(9, 16), rng.integers(20, 290)])
    return rows.inequalities(np.vstack([rows.A, rows.A[i]]), np.r_[rows.b, np.abs(rows.b[i]) + far])


def with_sums(rng, rows):
    """Rows that are sums of two others touch the set at most, and cut nothing off."""
    i, j = rng.integers(0, len(rows.b), (2, 3))
    weight = rng.uniform(0.5, 2, 3)
    return rows.inequalities(
        np.vstack([rows.A, rows.A[i] + weight[:, None] * rows.A[j]]), np.r_[rows.b, rows.b[i] + weight * rows.b[j]]
    )


def rescaled_rows(rng, rows):
    factor, factor_eq = 10.0 ** rng.integers(-8, 9, len(rows.b)), 10.0 ** rng.integers(-8, 9, len(rows.e))
    return Rows(rows.A * factor[:, None], rows.b * factor, rows.E * factor_eq[:, None], rows.e * factor_eq)


SAME_SET = [shuffled, duplicated, with_far_rows, with_sums, rescaled_rows]


def units(rng, n, decades=8):
    """Return the diagonal M of x' = M x, from 1e-8 to 1e8 and as wide as that."""
    return np.diag(10.0 ** rng.permutation(np.linspace(-decades, decades, n)))


def permutation(rng, n):
    return np.eye(n)[rng.permutation(n)]


def shear(rng, n):
    return np.eye(n) + np.triu(rng.integers(-2, 3, (n, n)), 1)


MAPS = [units, permutation, shear]
