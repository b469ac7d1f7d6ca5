"""Points, segments and other sets without volume, and bounds that mean "no limit", judged by exact rationals.

python benchmarks/sets_without_volume.py                   the table: 10 000 cases a row, one hour
python benchmarks/sets_without_volume.py --count 200       fewer
python benchmarks/sets_without_volume.py --seed 7          others

Every double is a rational, so `fractions` says exactly which points a set has. A case of the first rows is drawn with
small integer vertices in one to four dimensions, half of them moved, turned and stated in units from 1e-6 to 1e6.
An answer is wrong where a vertex is no point of the exact set, or a point of that is missing, by more than 1e-9 of the
sets at hand and 1e-12 of their distance from the origin. The oracle shares no code with the package.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import itertools
import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from invariant_sets import (
    ParametricSet,
    Polytope,
    controllable_set,
    maximal_control_invariant_set,
    maximal_positively_invariant_set,
    predecessor_set,
    reachable_set,
)
from mpc import LinearMPC

Array = np.ndarray
Point = list[Fraction]
NO_LIMIT = (1e6, 1e9, 1e11, 1e12, 1e15, 1e18, 1e20, 1e30, 1e100, 1e200, 1e300, np.inf)


# --- exact points ---------------------------------------------------------------------------------------------------


def exact(V: Any) -> list[Point]:
    """Return points (k, n) of doubles as the rationals that they are."""
    return [[Fraction(float(x)) for x in v] for v in V]


def sums(P: list[Point], Q: list[Point]) -> list[Point]:
    """Return every p + q."""
    return [[x + y for x, y in zip(p, q)] for p in P for q in Q]


def image(M: Array, P: list[Point]) -> list[Point]:
    """Return every M p."""
    rows = exact(M)
    return [[sum((m * x for m, x in zip(row, p)), Fraction(0)) for row in rows] for p in P]


def solved(M: Array, right: list[Fraction]) -> Point:
    """Return x with M x = right, by Gauss-Jordan elimination in rationals."""
    rows = [[*row, value] for row, value in zip(exact(M), right)]
    n = len(rows)
    for j in range(n):
        pivot = next(i for i in range(j, n) if rows[i][j])
        rows[j], rows[pivot] = rows[pivot], rows[j]
        rows[j] = [x / rows[j][j] for x in rows[j]]
        for i in range(n):
            if i != j and rows[i][j]:
                rows[i] = [x - rows[i][j] * y for x, y in zip(rows[i], rows[j])]
    return [row[n] for row in rows]


def misfit(R: Polytope, points: list[Point], room: Array, *, count: bool = False) -> str:
    """Return what is wrong with R as the hull of exact points; empty if nothing.

    `room` (n,) is what a coordinate may be wrong by. With `count` every vertex must be a corner (plane sets only).
    """
    if R.is_empty:
        return "empty"
    if not R.is_bounded:
        return "unbounded"
    V = R.vertices
    lower, upper = R.bounding_box()
    if not (np.isfinite(V).all() and np.isfinite(lower).all() and np.isfinite(upper).all()):
        return "not finite"
    near = np.array([[float(x) for x in p] for p in points])
    for v in V:  # the differences are exact for the nearest point
        k = int((np.abs(near - v) / room).max(axis=1).argmin())
        if any(abs(float(Fraction(float(a)) - b)) > r for a, b, r in zip(v, points[k], room)):
            return "a vertex too many"
    ends = np.array([near.min(axis=0), near.max(axis=0)])
    if (np.abs(np.array([lower, upper]) - ends) > room).any():
        return "bounding box"
    rows = np.vstack([R.A, R.A_eq, -R.A_eq])
    right = np.concatenate([R.b, R.b_eq, -R.b_eq])
    distinct = [points[k] for k in np.unique(near, axis=0, return_index=True)[1]]
    for row, b in zip(rows, right):
        exact_row = [Fraction(float(a)) for a in row]
        slack = float(np.abs(row) @ (room + 1e-15 * np.abs(near).max(axis=0)))  # and the rounding of the row's terms
        for p in distinct:
            if float(sum((a * x for a, x in zip(exact_row, p)), Fraction(0)) - Fraction(float(b))) > slack:
                return "a point is cut off"
    if not R.contains(near).all():
        return "contains denies a point"
    if count and len(V) != corners(distinct):
        return f"{len(V)} vertices for {corners(distinct)} corners"
    return ""


def corners(points: list[Point]) -> int:
    """Return how many corners the hull of exact points of the plane has (Andrew's monotone chain)."""
    points = sorted({tuple(p) for p in points})  # type: ignore[misc]
    if len(points) < 3:
        return len(points)
    total = 0
    for side in (points, points[::-1]):
        chain: list[Any] = []
        for p in side:
            while len(chain) > 1 and (
                (chain[-1][0] - chain[-2][0]) * (p[1] - chain[-2][1])
                <= (chain[-1][1] - chain[-2][1]) * (p[0] - chain[-2][0])
            ):
                chain.pop()
            chain.append(p)
        total += len(chain) - 1
    return total


# --- cases ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Place:
    """x = units (turn y + away): where small integer points y are stated."""

    turn: Array
    away: Array
    units: Array

    @classmethod
    def drawn(cls, rng: np.random.Generator, n: int) -> Place:
        """Return the natural place, or one that is turned, moved or in other units."""
        turn = np.linalg.qr(rng.normal(size=(n, n)))[0] if rng.random() < 0.4 else np.eye(n)
        away = np.round(10 ** rng.uniform(0, 6) * rng.normal(size=n)) if rng.random() < 0.4 else np.zeros(n)
        return cls(turn, away, 10 ** rng.uniform(-6, 6, n) if rng.random() < 0.3 else np.ones(n))

    def points(self, Y: Array, *, moved: bool = True) -> Array:
        """Return the points Y (k, n) there."""
        return (Y @ self.turn.T + moved * self.away) * self.units

    def room(self, *sets: Array) -> Array:
        """Return what a coordinate of an answer may be wrong by."""
        away = np.abs(self.away).max() + sum(np.abs(Y).max() for Y in sets)
        return self.units * (1e-9 * sum(max(np.ptp(Y, axis=0).max(), 1e-3) for Y in sets) + 1e-12 * away)


def integers(rng: np.random.Generator, n: int, *, flat: bool = False) -> Array:
    """Return up to n + 3 points with entries from -3 to 3; few or coplanar ones if `flat`."""
    most = int(rng.integers(1, n + 1)) if flat and rng.random() < 0.7 else int(rng.integers(1, n + 4))
    V = rng.integers(-3, 4, (most, n)).astype(float)
    if flat and len(V) > n:
        V[:, rng.integers(n)] = float(rng.integers(-3, 4))
    return V


def difference_case(rng: np.random.Generator) -> str:
    """Return what is wrong with (P + Q) - Q for a P without volume; empty if nothing."""
    n = int(rng.integers(1, 5))
    P = integers(rng, n, flat=rng.random() < 0.8)
    Q = integers(rng, n, flat=rng.random() < 0.3)
    place = Place.drawn(rng, n)
    first = place.points(P)
    second = Polytope.from_vertices(place.points(Q, moved=rng.random() < 0.5))
    R = Polytope.from_vertices(first).minkowski_sum(second).pontryagin_difference(second)
    return misfit(R, exact(first), place.room(P, Q))


def itself_case(rng: np.random.Generator) -> str:
    """Return what is wrong with X - X, which is {0} for a bounded X and a cone for an unbounded one."""
    n = int(rng.integers(1, 5))
    A = rng.integers(-2, 3, (int(rng.integers(1, n + 4)), n)).astype(float)
    A = np.vstack([A[A.any(axis=1)], np.vstack([np.eye(n), -np.eye(n)])[rng.random(2 * n) < 0.9]])
    if not len(A):
        return ""
    b = rng.integers(0, 5, len(A)).astype(float)
    place = Place.drawn(rng, n)
    rows = (A @ place.turn.T) / place.units
    X = Polytope(rows, b + rows @ (place.away * place.units))
    if X.is_empty:
        return ""
    D = X.pontryagin_difference(X)
    if not D.contains(np.zeros(n)):
        return "empty" if D.is_empty else "0 is missing"
    if not X.is_bounded:
        return "bounded" if D.is_bounded else ""
    width = np.ptp(X.vertices, axis=0)
    size = np.full(n, np.abs(b).max() + np.abs(place.away).max() + 1.0)
    return misfit(D, [[Fraction(0)] * n], 1e-9 * width + 1e-12 * size * place.units)


def sum_case(rng: np.random.Generator) -> str:
    """Return what is wrong with P + Q, P + P, and their image."""
    n = int(rng.integers(1, 5))
    P = integers(rng, n, flat=True)
    Q = P if rng.random() < 0.3 else integers(rng, n, flat=rng.random() < 0.5)
    place = Place.drawn(rng, n)
    first = place.points(P)
    second = place.points(Q)
    S = Polytope.from_vertices(first).minkowski_sum(Polytope.from_vertices(second))
    plain = n == 2 and (place.turn == np.eye(n)).all() and (place.units == 1).all()
    wrong = misfit(S, sums(exact(first), exact(second)), place.room(P, Q), count=plain)
    if wrong:
        return wrong
    M = rng.integers(-2, 3, (int(rng.integers(1, 4)), n)).astype(float)
    room = np.abs(M / place.units) @ place.room(P, Q) + 1e-300
    R = Polytope.from_vertices(first).affine_map(M / place.units)
    return misfit(R, image(M / place.units, exact(first)), np.maximum(room, room.max() * 1e-3)) and "image"


def reach_case(rng: np.random.Generator) -> str:
    """Return what is wrong with the states that are reached from a known start, or that reach a known end."""
    n = int(rng.integers(1, 5))
    A = np.triu(rng.integers(-1, 2, (n, n)), 1) + np.diag(rng.choice([-1, 1], n)).astype(float)
    turn = rng.permutation(n)
    A = A[turn][:, turn]
    B = rng.integers(-1, 2, (n, int(rng.integers(1, 3)))).astype(float)
    U = integers(rng, B.shape[1], flat=rng.random() < 0.6)
    start = integers(rng, n, flat=True)
    start = start[:1] if rng.random() < 0.7 else start
    away = np.round(10 ** rng.uniform(0, 6) * rng.normal(size=n)) * (rng.random() < 0.4)
    steps = int(rng.integers(1, 4))
    first = Polytope.from_vertices(start + away)
    inputs = Polytope.from_vertices(U)
    backwards = rng.random() < 0.4
    moves = image(B, exact(U))
    points = exact(start + away)
    if backwards:
        whole = Polytope(np.zeros((0, n)), np.zeros(0))
        result = controllable_set(A, B, whole, inputs, first, steps)
        back = np.array([[float(x) for x in solved(A, [Fraction(int(i == j)) for i in range(n)])] for j in range(n)]).T
        for _ in range(steps):
            points = image(back, sums(points, [[-x for x in m] for m in moves]))
    else:
        result = reachable_set(A, B, first, inputs, steps)
        for _ in range(steps):
            points = sums(image(A, points), moves)
    points = [list(p) for p in {tuple(p) for p in points}]
    if result.status.name != "CONVERGED":
        return result.status.name
    size = max(float(abs(x)) for p in [*points, *exact(start + away)] for x in p)
    return misfit(result.set, points, np.full(n, 1e-9 * 20 + 1e-12 * size))


def segment_case(rng: np.random.Generator) -> str:
    """Return what is wrong with a short segment far away, by its ends, by equalities or by opposite rows."""
    n = int(rng.integers(2, 5))
    length = 10 ** rng.uniform(-8, -2)
    distance = 10 ** rng.uniform(0, 6)
    d = rng.normal(size=n)
    d /= np.linalg.norm(d)
    p = rng.normal(size=n)
    p *= distance / np.linalg.norm(p)
    room = np.full(n, 1e-9 * length + 1e-12 * distance)
    kind = int(rng.integers(3))
    if kind == 0:
        ends = np.array([p, p + length * d])
        S = Polytope.from_vertices(ends)
        points = exact(ends)
        room = np.full(n, 1e-9 * length + 4e-16 * distance)
    else:
        across = np.linalg.svd(d[None])[2][1:]
        E = rng.normal(size=(n - 1, n - 1)) @ across + 0.0
        a = d + 0.5 * rng.normal(size=n)
        a *= np.sign(a @ d)
        e = E @ p
        low = float(a @ p)
        high = low + length * float(a @ d)
        condition = np.linalg.cond(np.vstack([E / np.linalg.norm(E, axis=1)[:, None], a / np.linalg.norm(a)]))
        if condition > 100:
            return ""
        room = room * condition
        points = [solved(np.vstack([E, a]), [*map(Fraction, e.tolist()), Fraction(end)]) for end in (low, high)]
        if kind == 1:
            S = Polytope([a, -a], [high, -low], E, e)
        else:
            S = Polytope(np.vstack([a, -a, E, -E]), np.concatenate([[high, -low], e, -e]))
    wrong = misfit(S, points, room)
    if wrong:
        return f"by {('ends', 'equalities', 'opposite rows')[kind]}: {wrong}"
    if length > 1e-12 * distance * 1e3 and S.affine_dim != 1:
        return f"dimension {S.affine_dim}"
    choice = int(rng.integers(4))
    if choice == 0:
        return misfit(S.minkowski_sum(S), sums(points, points), 2 * room) and "sum"
    if choice == 1:
        return misfit(S.pontryagin_difference(S), [[Fraction(0)] * n], room) and "difference"
    if choice == 2:
        M = np.linalg.qr(rng.normal(size=(n, n)))[0]
        return misfit(S.affine_map(M), image(M, points), np.full(n, n * room.max())) and "image"
    box = Polytope.from_bounds(-np.ones(n), np.ones(n))
    return misfit(S.minkowski_sum(box).pontryagin_difference(box), points, room + 1e-9) and "sum and difference"


# --- bounds that say nothing ----------------------------------------------------------------------------------------


def no_limit_case(rng: np.random.Generator) -> str:
    """Return what a bound "no limit" changes, in one of the functions of the package; empty if nothing."""
    n = int(rng.integers(1, 4))
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.3, 1.3) / max(np.abs(np.linalg.eigvals(A)).max(), 1e-3)
    B = rng.normal(size=(n, int(rng.integers(1, 3))))
    units = 10 ** rng.uniform(-4, 4, n) if rng.random() < 0.3 else np.ones(n)
    A = A * units[:, None] / units
    B = B * units[:, None]
    lower = -rng.uniform(1, 5, n) * units
    upper = rng.uniform(1, 5, n) * units
    which = rng.random(n) < 0.4
    big = float(rng.choice(NO_LIMIT))
    size = np.where(which, big, 0.0) if rng.random() < 0.5 else np.where(which, big * 10 ** rng.uniform(-1, 0, n), 0.0)
    open_ = (np.where(which, -np.inf, lower), np.where(which, np.inf, upper))
    stated = (np.where(which, -size, lower), np.where(which, size, upper))
    u = rng.uniform(0.5, 2, B.shape[1])
    inputs = [(-u, u), (-u, u)]
    if rng.random() < 0.2:
        inputs = [(-u * np.inf, u * np.inf), (-u * big, u * big)]
    name = str(
        rng.choice(
            ["control", "positive", "predecessor", "controllable", "reachable", "family", "bounds", "plan", "law"]
        )
    )
    small = 0.3 * rng.uniform(0.5, 1, n) * units
    call: Callable[[Any, Any], Any] = {
        "control": lambda X, U: maximal_control_invariant_set(A, B, X, U, max_iterations=60),
        "positive": lambda X, U: maximal_positively_invariant_set(A / 1.4, X, max_iterations=60),
        "predecessor": lambda X, U: predecessor_set(A, B, X, U, X=X),
        "controllable": lambda X, U: controllable_set(A, B, X, U, (-small, small), 2),
        "reachable": lambda X, U: reachable_set(A, B, (-small, small), (-u, u), 2, X=X),
        "family": lambda X, U: ParametricSet(lambda p: (A, B * p), X, U, max_iterations=60).result([1.0]),
        "bounds": lambda X, U: Polytope.from_bounds(*X).intersection(Polytope.from_bounds(-9 * units, 9 * units)),
        "plan": lambda X, U: LinearMPC(A, B, X=X, U=U, Q=np.diag(units**-2), R=np.eye(len(u)), horizon=3),
        "law": lambda X, U: LinearMPC(A, B, X=X, U=U, Q=np.diag(units**-2), R=np.eye(len(u)), horizon=3).explicit(
            theta_set=(-units, units)
        ),
    }[name]
    plain = call(open_, inputs[0])
    result = call(stated, inputs[1])
    if name in ("plan", "law"):
        fine = name == "plan" or (plain.status is result.status and len(plain.regions) == len(result.regions))
        X0 = rng.uniform(-1, 1, (5, n)) * units
        same = all(np.allclose(plain(x), result(x), rtol=1e-6, atol=1e-6, equal_nan=True) for x in X0)
        return "" if fine and same else f"{name}: another one"
    if isinstance(plain, Polytope):
        return "" if plain.equals(result, 1e-9) and plain.volume == result.volume else f"{name}: another set"
    if not (plain.set.is_bounded and plain.outer.is_bounded):  # the bound is what ends the set
        fine = result.set.is_empty == plain.set.is_empty and (result.certificate.holds or result.set.is_empty)
        if plain.status.name == "CONVERGED" and not fine:
            return f"{name}: {result.status.name} where it has no end"
        smaller = np.where(which, 1e4 * units, 0.0)  # a bound that is far away, and ends the set all the same
        near = call(
            (np.where(which, -smaller, lower), np.where(which, smaller, upper)),
            inputs[1] if np.isfinite(inputs[0][1]).all() else (-1e4 * u, 1e4 * u),
        )
        if name == "reachable" or near.status.name != "CONVERGED" or result.status.name != "CONVERGED":
            return ""
        window = Polytope.from_bounds(-9 * units, 9 * units)
        same = near.set.intersection(window).equals(result.set.intersection(window), 1e-6)
        return "" if same else f"{name}: another set near the origin"
    if plain.status is not result.status or plain.certificate.holds is not result.certificate.holds:
        return f"{name}: {result.status.name} for {plain.status.name}"
    fine = plain.status.name != "CONVERGED" or plain.set.equals(result.set, 1e-6)  # else where it stopped is no set
    return "" if fine else f"{name}: another set"


CASES: dict[str, Callable[[np.random.Generator], str]] = {
    "(P + Q) - Q = P": difference_case,
    "X - X holds 0": itself_case,
    "sums and images": sum_case,
    "reach of known starts": reach_case,
    "segments 1e-8 to 1e-2 long at 1 to 1e6": segment_case,
    "bounds of 1e6 to 1e300 and inf": no_limit_case,
}


def verdict(case: Callable[[np.random.Generator], str], seed: int, k: int) -> str:
    """Return what is wrong with case k; empty if nothing. What is raised, and a warning, is wrong too."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return case(np.random.default_rng((seed, k)))
        except Exception as error:
            return f"{type(error).__name__}: {str(error)[:60]}"


def wrong_cases(name: str, count: int, seed: int) -> list[tuple[int, str]]:
    """Return number and fault of the cases of a row that are wrong."""
    return [(k, wrong) for k in range(count) if (wrong := verdict(CASES[name], seed, k))]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=10_000, help="cases a row")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--row", type=int, choices=range(len(CASES)), help="one row of the table alone")
    options = parser.parse_args()
    for name in CASES if options.row is None else list(itertools.islice(CASES, options.row, options.row + 1)):
        start = time.process_time()
        wrong = wrong_cases(name, options.count, options.seed)
        print(f"{name}: {len(wrong)} of {options.count} wrong, {time.process_time() - start:.0f} s of processor time")
        for fault, many in Counter(fault for _, fault in wrong).most_common():
            print(f"    {many}: {fault}; case {next(k for k, other in wrong if other == fault)}", flush=True)


if __name__ == "__main__":
    main()
