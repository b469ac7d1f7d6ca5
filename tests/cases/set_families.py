"""Seeded families of polytopes, degenerate ones included, in any dimension."""

import numpy as np

from invariant_sets import Polytope


def rotation(rng, n):
    return np.linalg.qr(rng.normal(size=(n, n)))[0]


def random_rows(rng, n):
    A = rng.normal(size=(2 * n, n))
    right = rng.uniform(0.3, 1, len(A)) * np.linalg.norm(A, axis=1)
    return Polytope(np.vstack([A, np.eye(n), -np.eye(n)]), np.r_[right, np.ones(2 * n)])


def simplex(rng, n):
    return Polytope.from_vertices(rng.normal(size=(n + 1, n)) + 3)


def cut_cube(rng, n):
    d = rng.uniform(0.2, 1, n)
    return Polytope(np.vstack([np.eye(n), -np.eye(n), d]), np.r_[np.ones(2 * n), 0.6 * d.sum()])


def flat(rng, n):
    Q = rotation(rng, n)[:, : n - 1]
    return Polytope.from_vertices(rng.normal(size=(2 * n, n - 1)) @ Q.T + 0.5)


def needle(rng, n):
    size = np.r_[1e-6, np.ones(n - 2), 1e6][:n]
    return Polytope.from_vertices(rng.normal(size=(2 * n, n)) * size)


def tiny(rng, n):
    return random_rows(rng, n).scale(1e-6)


def huge(rng, n):
    return random_rows(rng, n).scale(1e6)


def repeated_rows(rng, n):
    P = cut_cube(rng, n)
    touching = rng.uniform(0.1, 1, n)  # touches the cube's corner (−1, …, −1) only
    A = np.vstack([P.A, 2 * P.A, P.A, -touching])
    return Polytope(A, np.r_[P.b, 2 * P.b, P.b, touching.sum()])


FAMILIES = [random_rows, simplex, cut_cube, flat, needle, tiny, huge, repeated_rows]
