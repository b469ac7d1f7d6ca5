"""Invariant sets side by side with the Python peers that are installed, one core, one run.

python benchmarks/bench_sets.py            everything, about a minute
python benchmarks/bench_sets.py --quick    fewer repetitions and designs, and not the largest chain

Peers are optional: `pip install polytope` in the same environment. Those that are missing are named, and their column
stays empty. Every peer runs the textbook recursion with its own set operations, in the faster of two ways.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import importlib.util
import logging
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.linalg import expm

from invariant_sets import ParametricSet, Polytope, maximal_control_invariant_set

PEERS = ("polytope", "cdd", "pypoman", "pycvxset", "pytope")
ILLUSTRATIVE = (Polytope.from_bounds([-10, -5], [5, 2]), Polytope.from_bounds([-1], [1]))
SUSPENSION = (
    Polytope.from_bounds([-0.25, -2.5, -0.5, -2.5], [0.25, 2.5, 0.5, 2.5]),
    Polytope.from_bounds([-1000], [1000]),
)


def illustrative(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return A and B(p) of the illustrative example."""
    return np.array([[0.8, 0.5], [0.5, 0.6]]), np.array([[0.5], [p[0]]])


def held(A: np.ndarray, B: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the exact zero-order hold of (A, B)."""
    n, m = B.shape
    M = np.zeros((n + m, n + m))
    M[:n] = np.hstack([A, B])
    M = expm(M * dt)
    return M[:n, :n], M[:n, n:]


def suspension(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return A(p) and B(p) of the quarter car at 0.05 s."""
    k, c = p
    body, wheel, tyre = 325.0, 65.0, 232.5e3
    A = np.array(
        [
            [0, 1, 0, 0],
            [-tyre / wheel, -c / wheel, k / wheel, c / wheel],
            [0, -1, 0, 1],
            [0, c / body, -k / body, -c / body],
        ]
    )
    return held(A, np.array([[0, -1 / wheel, 0, 1 / body]]).T, 0.05)


def chain(masses: int, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Return A and B of unit masses in a row, joined by unit springs and dampers, forced at the first; 0.5 s."""
    K = 2 * np.eye(masses) - np.eye(masses, k=1) - np.eye(masses, k=-1)
    K[-1, -1] = 1
    A = np.block([[np.zeros((masses, masses)), np.eye(masses)], [-K, -damping * K]])
    return held(A, np.eye(2 * masses)[:, [masses]], 0.5)


def milliseconds(work: Callable[[], Any], repeats: int) -> float:
    """Return the median time of `work` in milliseconds, after one call to warm up."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


# --- peers -----------------------------------------------------------------------------------------------------


def with_polytope(A: np.ndarray, B: np.ndarray, X: Polytope, U: Polytope, way: str) -> tuple[Any, int]:
    """Return the set and the steps of the plain recursion in `polytope`, by projection or by vertices."""
    import polytope as pc

    n = len(A)
    state, S = pc.Polytope(X.A, X.b), pc.Polytope(X.A, X.b)
    for step in range(1, 200):
        if way == "projection":
            rows = np.vstack([np.hstack([S.A @ A, S.A @ B]), np.hstack([np.zeros((len(U.b), n)), U.A])])
            before = pc.Polytope(rows, np.append(S.b, U.b)).project(range(1, n + 1))
        else:
            points = (pc.extreme(S)[:, None] - (U.vertices @ B.T)[None]).reshape(-1, n)
            hull = pc.qhull(points)
            before = pc.Polytope(hull.A @ A, hull.b)
        smaller = pc.reduce(before.intersect(state), abs_tol=1e-12)
        if (pc.extreme(S) @ smaller.A.T - smaller.b).max() <= 1e-7:
            return smaller, step
        S = smaller
    raise RuntimeError("no end after 200 steps")


def volume(S: Any) -> float:
    """Return the exact volume of a set of `polytope` (its own method is a Monte-Carlo estimate)."""
    return Polytope(S.A, S.b).volume


def polytope_time(A: np.ndarray, B: np.ndarray, X: Polytope, U: Polytope) -> tuple[float, str]:
    """Return the time of the faster way in milliseconds, and what to say about it."""
    best, note = np.inf, "fails"
    for way in ("vertices", "projection"):
        try:
            S, steps = with_polytope(A, B, X, U, way)
            spent = milliseconds(lambda way=way: with_polytope(A, B, X, U, way), 3)
        except Exception as error:
            note = note if np.isfinite(best) else f"fails: {type(error).__name__}"
            continue
        if spent < best:
            best, note = spent, f"by {way}, {steps} steps, {len(S.b)} facets, volume {volume(S):.9g}, not certified"
    return best, note


# --- the tables --------------------------------------------------------------------------------------------------


def single_sets(have_polytope: bool, repeats: int) -> None:
    """Print the time of one set, certificate included, beside polytope."""
    print("maximal control invariant set, certificate included")
    for name, (A, B), (X, U), share in (
        ("illustrative p = 1", illustrative(np.ones(1)), ILLUSTRATIVE, 50),
        ("suspension", suspension(np.array([27692.0, 1906.5])), SUSPENSION, 5),
    ):

        def fresh(A=A, B=B, X=X, U=U):  # new sets every time, so that nothing is cached
            return maximal_control_invariant_set(A, B, Polytope(X.A, X.b), Polytope(U.A, U.b))

        mine, result = milliseconds(fresh, repeats), fresh()
        print(
            f"  {name:20s} here {mine:8.2f} ms   {result.status.name}, {len(result.set.b)} facets, "
            f"{len(result.set.vertices)} vertices, volume {result.set.volume:.9g}, "
            f"violation {result.certificate.violation:.1e}, gap {result.certificate.gap:.1e}"
        )
        if have_polytope:
            theirs, note = polytope_time(A, B, X, U)
            print(f"  {'':20s} polytope {theirs:.1f} ms ({note}); ratio {theirs / mine:.0f}, required {share}")


def families(designs: tuple[int, int]) -> None:
    """Print the time of many designs, each computed once."""
    print("sets as functions of the design, one core, one state a design")
    rng = np.random.default_rng(0)
    for name, matrices, (X, U), count, low, high, limit in (
        ("illustrative", illustrative, ILLUSTRATIVE, designs[0], [0.5], [3.0], 1.0),
        ("suspension", suspension, SUSPENSION, designs[1], [1e4, 500], [4e4, 3000], 15.0),
    ):
        family = ParametricSet(matrices, X, U)
        p = rng.uniform(low, high, (count, len(low)))
        lower, upper = X.bounding_box()
        x = rng.uniform(lower, upper, (count, X.dim))
        start, busy = time.perf_counter(), time.process_time()
        inside = family.contains(x, p)
        spent, busy = time.perf_counter() - start, time.process_time() - busy
        worst = max(family.result(q).certificate.violation for q in p)
        print(
            f"  {count:5d} {name:14s} {spent:7.2f} s, of which {busy:.2f} s on the processor (required "
            f"{limit:g} s for 300 and 3000); "
            f"{inside.mean():.0%} inside, worst violation {worst:.1e}"
        )


def membership(repeats: int) -> None:
    """Print the time of 1e6 states against 24 facets."""
    C = maximal_control_invariant_set(*suspension(np.array([27692.0, 1906.5])), *SUSPENSION).set
    x = np.random.default_rng(0).uniform(-1, 1, (1_000_000, 4)) * [0.25, 2.5, 0.5, 2.5]
    mine = milliseconds(lambda: C.contains(x), repeats)
    product = milliseconds(lambda: x @ C.A.T, repeats)
    test = milliseconds(lambda: (x @ C.A.T <= C.b).all(axis=1), repeats)
    print(
        f"1e6 states against {len(C.b)} facets: contains {mine:.0f} ms, the product alone {product:.0f} ms, "
        f"product, comparison and all {test:.0f} ms (required: no slower than the product, < 200 ms)"
    )


def growth(*, largest: bool) -> None:
    """Print time, facets and volume of spring-mass chains; the largest takes from seconds to minutes."""
    print("growth: spring-mass chains, |x| <= 1, |u| <= 0.5, 0.5 s")
    for damping, masses in ((1.0, 1), (1.0, 2), (1.0, 3), (0.1, 1), (0.1, 2), *[(0.1, 3)] * largest):
        A, B = chain(masses, damping)
        n = 2 * masses
        X, U = Polytope.from_bounds(-np.ones(n), np.ones(n)), Polytope.from_bounds([-0.5], [0.5])
        spent = milliseconds(lambda A=A, B=B, X=X, U=U: maximal_control_invariant_set(A, B, X, U), 1)
        result = maximal_control_invariant_set(A, B, X, U)
        C = result.set
        print(
            f"  damping {damping}, {n} states: {spent:9.2f} ms, {result.status.name}, {result.iterations} steps, "
            f"{len(C.b)} facets, {len(C.vertices)} vertices, volume {C.volume:.6g}, "
            f"violation {result.certificate.violation:.1e}, gap {result.certificate.gap:.1e}"
        )


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer repetitions and designs, and not the largest chain")
    quick = parser.parse_args().quick
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    missing = [name for name in PEERS if importlib.util.find_spec(name) is None]
    print("peers missing here, not compared:", ", ".join(missing) or "none")
    have_polytope = "polytope" not in missing
    if have_polytope:
        import polytope

        print(f"polytope {polytope.__version__} with the LP solver {polytope.solvers.default_solver}")
    single_sets(have_polytope, 5 if quick else 50)
    families((30, 100) if quick else (300, 3000))
    membership(3 if quick else 9)
    growth(largest=not quick)


if __name__ == "__main__":
    main()
