"""Random slabs, cones, boxes and polytopes in mixed units, judged by HiGHS in natural units.

python benchmarks/adversarial_polytopes.py                 supports and bounding boxes, sums, projections, flat sets
python benchmarks/adversarial_polytopes.py --count 200     fewer
python benchmarks/adversarial_polytopes.py --seed 7        others

Every set is stated a second time: its coordinates in units from 1e-8 to 1e8, its rows scaled, repeated, shuffled, and
joined by rows that are far away. HiGHS is asked twice in natural units, with the cost and with zero cost; where it
finds a point but no optimum, it looks for a ray.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from invariant_sets import InvariantSetsError, Polytope

Array = np.ndarray
SOLVER = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
WRONG = 1e-7  # of the size of the set: a support that is off by more is wrong


@dataclass(frozen=True)
class Rows:
    """{x : A x <= b, E x = e}."""

    A: Array
    b: Array
    E: Array
    e: Array


def slab(rng: np.random.Generator, n: int) -> Rows:
    """Return one slab or several; in half of the cases with normals of two decimals."""
    normals = rng.normal(size=(int(rng.integers(1, n)), n))
    normals = np.round(normals, 2) if rng.random() < 0.5 else normals
    return unequal(np.vstack([normals, -normals]), rng.uniform(0.1, 2, 2 * len(normals)))


def cone(rng: np.random.Generator, n: int) -> Rows:
    """Return a cone around −(1, …, 1), with its apex at the origin or elsewhere."""
    A = rng.normal(size=(int(rng.integers(1, 2 * n)), n))
    A *= np.where(A.sum(axis=1) > 0, 1, -1)[:, None]
    return unequal(A, A @ (rng.normal(size=n) * rng.integers(0, 2)))


def box(rng: np.random.Generator, n: int) -> Rows:
    """Return a box."""
    lower = rng.normal(size=n)
    return unequal(np.vstack([np.eye(n), -np.eye(n)]), np.append(lower + rng.uniform(0.1, 3, n), -lower))


def thin_box(rng: np.random.Generator, n: int) -> Rows:
    """Return a rotated box with widths from 1e-5 to 1, at the origin or elsewhere."""
    Q, width = np.linalg.qr(rng.normal(size=(n, n)))[0], 10 ** rng.uniform(-5, 0, n)
    centre = Q @ np.ones(n) * rng.integers(0, 2)
    return unequal(np.vstack([Q, -Q]), np.append(width + centre, width - centre))


def polyhedron(rng: np.random.Generator, n: int) -> Rows:
    """Return rows in random directions around the origin: bounded or not."""
    A = rng.normal(size=(int(rng.integers(1, 4 * n)), n))
    return unequal(A, rng.uniform(0.1, 1, len(A)))


def cut(rng: np.random.Generator, n: int) -> Rows:
    """Return a polyhedron cut by equalities."""
    rows, E = polyhedron(rng, n), rng.normal(size=(int(rng.integers(1, n)), n))
    return Rows(rows.A, rows.b, E, E @ (0.02 * rng.normal(size=n)) * rng.integers(0, 2))


def unequal(A: Array, b: Array) -> Rows:
    """Return inequalities alone."""
    return Rows(A, b, np.zeros((0, A.shape[1])), np.zeros(0))


FAMILIES: tuple[Callable[[np.random.Generator, int], Rows], ...] = (slab, cone, box, thin_box, polyhedron, cut)


def disguised(rng: np.random.Generator, rows: Rows, units: Array) -> Polytope:
    """Return the set in other units, with its rows scaled, repeated and shuffled, and with a row far away."""
    A, b = rows.A / units, rows.b
    if rng.random() < 0.5:
        i, factor = rng.integers(0, len(b), 2), 10 ** rng.uniform(-6, 6, 2)
        A, b = np.vstack([A, A[i] * factor[:, None]]), np.append(b, b[i] * factor)
    if rng.random() < 0.5:
        i = int(rng.integers(0, len(b)))
        A, b = np.vstack([A, A[i]]), np.append(b, b[i] + np.linalg.norm(A[i]) * 10.0 ** rng.integers(10, 290))
    order = rng.permutation(len(b))
    return Polytope(A[order], b[order], rows.E / units, rows.e)


def highs_support(rows: Rows, D: Array) -> Array | None:
    """Return the support in the directions D; None if there is no point. NaN where HiGHS decides nothing."""
    sets = {
        "A_ub": rows.A,
        "b_ub": rows.b,
        "A_eq": rows.E if len(rows.e) else None,
        "b_eq": rows.e if len(rows.e) else None,
    }
    if linprog(np.zeros(rows.A.shape[1]), **sets, bounds=(None, None), options=SOLVER).status == 2:
        return None
    values = []
    for d in D:
        answer = linprog(-d, **sets, bounds=(None, None), options=SOLVER)
        if answer.status == 0:
            values.append(-answer.fun)
            continue
        cone = {**sets, "b_ub": 0 * rows.b, "b_eq": 0 * rows.e if len(rows.e) else None}
        ray = linprog(-d, **cone, bounds=(-1, 1), options=SOLVER)
        values.append(np.inf if ray.status == 0 and -ray.fun > 1e-7 else np.nan)
    return np.array(values)


def differ(values: Array, expected: Array, size: float) -> bool:
    """Return whether a value differs, where the expected one is known."""
    known = ~np.isnan(expected)
    values, expected = values[known], expected[known]
    infinite = ~np.isfinite(expected)
    if (values[infinite] != expected[infinite]).any():
        return True
    values, expected = values[~infinite], expected[~infinite]
    return bool((np.abs(values - expected) > WRONG * (np.abs(expected) + size)).any())


def support_case(seed: int, k: int, decades: float) -> str:
    """Return what is wrong with support and bounding box of case k; empty if nothing."""
    rng = np.random.default_rng((seed, k))
    n, family = int(rng.integers(2, 7)), FAMILIES[int(rng.integers(len(FAMILIES)))]
    rows, units = family(rng, n), 10 ** rng.uniform(-decades, decades, n)
    D = np.vstack([np.eye(n), -np.eye(n), rng.normal(size=(3, n)), rows.A[:2]])
    expected = highs_support(rows, D)
    name = f"{k}: {family.__name__}, n = {n}"
    try:
        P = disguised(rng, rows, units)
        values = P.support(D / units)
        if expected is None:
            return "" if P.is_empty else f"{name}: not empty"
        sides = np.append(P.bounding_box()[1] / units, -P.bounding_box()[0] / units)
    except InvariantSetsError as error:
        return f"{name}: {error}"
    size = 0.01 * float(np.abs(expected[np.isfinite(expected)]).max(initial=1e-12))
    if differ(values, expected, size):
        return f"{name}: support"
    return f"{name}: bounding box" if differ(sides, expected[: 2 * n], size) else ""


def sum_case(seed: int, k: int, decades: float) -> str:
    """Return what is wrong with the sum of two sets and with a projection; empty if nothing.

    The support of a sum is the sum of the supports; that of a projection is that of the set.
    """
    rng = np.random.default_rng((seed, k, 1))
    n = int(rng.integers(2, 6))
    units = 10 ** rng.uniform(-decades, decades, n)
    first, second = polyhedron(rng, n), (polyhedron, box)[int(rng.integers(2))](rng, n)
    P, Q = Polytope(first.A / units, first.b), Polytope(second.A / units, second.b)
    D = np.vstack([first.A, second.A, rng.normal(size=(10, n)), np.eye(n)]) / units
    try:
        if differ(P.minkowski_sum(Q, time_limit=30).support(D), P.support(D) + Q.support(D), 1.0):
            return f"{k}: sum, n = {n}"
        kept, D = [0, n - 1], np.zeros((8, n))
        D[:, kept] = rng.normal(size=(8, 2)) / units[kept]
        wrong = differ(P.projection(kept).support(D[:, kept]), P.support(D), 1.0)
    except InvariantSetsError as error:
        return f"{k}: sum or projection, n = {n}: {error}"
    return f"{k}: projection, n = {n}" if wrong else ""


def flat_case(seed: int, k: int, decades: float) -> str:
    """Return what is wrong with a point or a flat box, given by opposite rows in rotated coordinates; empty if nothing.

    y in [lower, upper] with x = units · (Q y); redundant rows that touch the set or are far away, and scaled copies.
    """
    rng = np.random.default_rng((seed, k, 2))
    n = int(rng.integers(2, 7))
    solid = int(rng.choice([0, 0, 1, n - 1, rng.integers(0, n)]))
    Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
    lower = rng.normal(size=n) * (rng.random() < 0.7)
    upper = lower + np.where(np.arange(n) < solid, rng.uniform(0.1, 2, n), 0.0)
    units = 10 ** rng.uniform(-decades, decades, n)
    touching = rng.normal(size=(int(rng.integers(0, 4)), n))
    reach = (
        np.maximum(touching, 0) @ upper + np.minimum(touching, 0) @ lower + rng.choice([0.0, 1.0, 1e6], len(touching))
    )
    A, b = np.vstack([Q.T, -Q.T, touching @ Q.T]) / units, np.concatenate([upper, -lower, reach])
    copied = rng.integers(0, len(b), int(rng.integers(0, 4)))
    factors = 10 ** rng.uniform(-6, 6, len(b) + len(copied)) if rng.random() < 0.7 else np.ones(len(b) + len(copied))
    order = rng.permutation(len(factors))
    P = Polytope((np.vstack([A, A[copied]]) * factors[:, None])[order], (np.append(b, b[copied]) * factors)[order])
    D = np.vstack([np.eye(n), -np.eye(n), rng.normal(size=(4, n))])
    expected = np.maximum(D, 0) @ upper + np.minimum(D, 0) @ lower
    name = f"{k}: flat, n = {n}, {solid} solid"
    try:
        if P.affine_dim != solid or not P.is_bounded:
            return f"{name}: dimension {P.affine_dim}, bounded {P.is_bounded}"
        if differ(P.support(D @ Q.T / units), expected, 1.0):
            return f"{name}: support"
        small = P.minimal()
        return "" if P.equals(small) and small.affine_dim == solid else f"{name}: minimal"
    except InvariantSetsError as error:
        return f"{name}: {error}"


def wrong_cases(case: Callable[[int, int, float], str], count: int, seed: int, decades: float) -> list[str]:
    """Return what is wrong, one line a case."""
    return [wrong for k in range(count) if (wrong := case(seed, k, decades))]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=2000, help="number of sets")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    for name, case, count in (
        ("support and bounding box, n = 2 to 6", support_case, options.count),
        ("sums and projections, n = 2 to 5", sum_case, max(1, options.count * 3 // 20)),
        ("points and flat boxes, n = 2 to 6", flat_case, options.count),
    ):
        for decades in (0.0, 8.0):
            start = time.perf_counter()
            wrong = wrong_cases(case, count, options.seed, decades)
            print(
                f"{name}, units over {2 * decades:.0f} decades: {len(wrong)} of {count} wrong, "
                f"{time.perf_counter() - start:.0f} s"
            )
            print("".join(f"    {line}\n" for line in wrong), end="", flush=True)


if __name__ == "__main__":
    main()
