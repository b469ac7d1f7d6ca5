"""Whether a trajectory that is called SOLVED keeps its limits between the points, and has the cost that it says.

Fields of discs, crossed with the least energy: by `solve` on a mesh of 10, 20 or 40 intervals and by `refine`, beside a
visibility graph. Of a single integrator the least ∫u² is length²/T, of the shortest path that passes every disc on the
same side. Coarse and stiff meshes: beside a fine mesh of the plain script of `bench_optimal_control.py`, or of shooting
with the same inputs held and 64 times the steps.

    python benchmarks/trajectory_verdicts.py [fields] [meshes] [first seed]
"""

from __future__ import annotations

import heapq
import itertools
import sys
from collections import Counter
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from bench_optimal_control import plain

from mpc.optimal_control import HermiteSimpson, MultipleShooting, Phase, Radau, Trapezoidal, build, refine, solve

CROSSED = 1e-3  # of a radius
MISSED = 0.01  # of the cost
FINE = 300  # intervals of the plain script


@dataclass(frozen=True, eq=False)
class Field:
    """Discs between a start and an end."""

    centres: np.ndarray
    radii: np.ndarray
    start: np.ndarray
    end: np.ndarray
    duration: float

    def phase(self) -> Phase:
        """The least energy across it."""

        def inside(x: Any) -> Any:
            return ca.vertcat(*(r**2 - ca.sumsqr(x - ca.DM(c)) for c, r in zip(self.centres, self.radii)))

        return Phase(
            lambda u: u, 2, 2, start=self.start, end=self.end, duration=self.duration, path=inside,
            stage_cost=lambda u: ca.sumsqr(u),
        )  # fmt: skip

    def crossed(self, solution: Any) -> float:
        """How deep a trajectory goes into a disc, in its radius."""
        t = solution.times
        within = t[:-1, None] + np.diff(t)[:, None] * np.linspace(0, 1, 200)
        away = np.linalg.norm(solution.x(within.ravel())[:, None] - self.centres, axis=2)
        return float((1 - away / self.radii).max())

    def turned(self, points: np.ndarray) -> np.ndarray:
        """How far points (n, 2) turn about every centre, less what the straight way does, in whole turns."""
        return np.round((self.swept(points) - self.swept(np.stack([self.start, self.end]))) / (2 * np.pi)).astype(int)

    def swept(self, points: np.ndarray) -> np.ndarray:
        """The angle about every centre."""
        away = points[:, None] - self.centres
        angles = np.unwrap(np.arctan2(away[..., 1], away[..., 0]), axis=0)
        return angles[-1] - angles[0]

    def shortest(self, turned: np.ndarray) -> float:
        """Length of the shortest path that turns so about the centres: Dijkstra over tangents, arcs and turns."""
        edges = self._edges()
        straight = self.swept(np.stack([self.start, self.end]))
        best: dict[tuple, float] = {}
        order = itertools.count()
        queue: list[tuple] = [(0.0, next(order), 0, np.zeros(len(self.radii)))]
        while queue:
            length, _, node, swept = heapq.heappop(queue)
            key = (node, *np.round(swept, 4).tolist())
            if key in best:
                continue
            best[key] = length
            if node == 1:
                if (np.round((swept - straight) / (2 * np.pi)) == turned).all():
                    return length
                continue
            for after, more, angles in edges[node]:
                if np.abs(swept + angles).max() < 2 * np.pi:
                    heapq.heappush(queue, (length + more, next(order), after, swept + angles))
        return np.inf

    def _edges(self) -> list[list[tuple[int, float, np.ndarray]]]:
        """Where one can go from every node, how long that is and what angles it sweeps; 0 is the start, 1 the end."""
        circles = [(self.start, 0.0), (self.end, 0.0), *zip(self.centres, self.radii)]
        nodes, owner = [self.start, self.end], [0, 1]
        segments = []
        for (i, (a, ra)), (j, (b, rb)) in itertools.combinations(enumerate(circles), 2):
            gap = np.linalg.norm(b - a)
            along = (b - a) / gap
            across = np.array([-along[1], along[0]])
            signs = set(itertools.product((1, -1) if ra else (0,), (1, -1) if rb else (0,)))
            for one, other in signs or {(0, 0)}:
                turn = (one * ra - other * rb) / gap
                if abs(turn) >= 1:
                    continue
                normal = turn * along + np.sqrt(1 - turn**2) * across
                ends = a + one * ra * normal, b + other * rb * normal
                if self._blocked(np.linspace(*ends, 400)):
                    continue
                pair = []
                for k, point in zip((i, j), ends):
                    pair.append(k if k < 2 else len(nodes))
                    if k >= 2:
                        nodes.append(point)
                        owner.append(k)
                segments.append((*pair, np.stack(ends)))
        for k, (centre, radius) in enumerate(circles):
            own = [n for n in range(2, len(nodes)) if owner[n] == k]
            angle = {n: np.arctan2(*(nodes[n] - centre)[::-1]) for n in own}
            own.sort(key=lambda n: angle[n])
            for n, after in zip(own, own[1:] + own[:1]):
                swing = np.linspace(angle[n], angle[after] + 2 * np.pi * (after == own[0]), 100)
                arc = centre + radius * np.stack([np.cos(swing), np.sin(swing)], axis=1)
                if not self._blocked(arc):
                    segments.append((n, after, arc))
        edges: list[list[tuple[int, float, np.ndarray]]] = [[] for _ in nodes]
        for n, after, points in segments:
            length, swept = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()), self.swept(points)
            edges[n].append((after, length, swept))
            edges[after].append((n, length, -swept))
        return edges

    def _blocked(self, points: np.ndarray) -> bool:
        """Whether points (n, 2) are within a disc by more than rounding."""
        away = np.linalg.norm(points[:, None] - self.centres, axis=2)
        return bool((away < self.radii * (1 - 1e-6)).any())


def field(seed: int) -> Field:
    """Discs anywhere, on the straight way too, in a unit and with an origin of their own."""
    rng = np.random.default_rng(seed)
    unit, count = 10.0 ** rng.uniform(-2, 3), int(rng.integers(1, 7))
    origin = rng.uniform(-5, 5, 2)
    centres, radii = [], []
    while len(centres) < count:
        centre, radius = rng.uniform([0.5, -1], [3.5, 1]), rng.uniform(0.1, 0.5)
        centre[1] *= rng.random() > 0.2  # now and then on the line itself
        if all(np.linalg.norm(centre - end) > radius + 0.1 for end in ([0, 0], [4, 0])):
            centres.append(centre)
            radii.append(radius)
    start, end = np.array([0.0, 0.0]), np.array([4.0, 0.0])
    return Field(
        unit * (np.array(centres) + origin), unit * np.array(radii), unit * (start + origin), unit * (end + origin),
        10.0 ** rng.uniform(-1, 2),
    )  # fmt: skip


def judged_field(given: Field, found: Any) -> tuple[str, str]:
    """The status of a trajectory across a field, and what is wrong if that says SOLVED."""
    if not found.solved:
        return found.status.name, ""
    if (depth := given.crossed(found)) > CROSSED:
        return "SOLVED", f"crosses by {depth:.1e} of a radius"
    t = found.times
    points = found.x((t[:-1, None] + np.diff(t)[:, None] * np.linspace(0, 1, 20)).ravel())
    least = given.shortest(given.turned(points)) ** 2 / given.duration
    return "SOLVED", "" if abs(found.cost / least - 1) <= MISSED else f"costs {found.cost:.6g}, least {least:.6g}"


def coarse(seed: int) -> tuple[str, Phase, Any, int]:
    """A problem whose mesh may be too coarse for it: its kind, its statement, a scheme and a number of intervals."""
    rng = np.random.default_rng(1000 + seed)
    fast = 10.0 ** rng.uniform(0.3, 2.3)
    slow = rng.uniform(0.2, 2)
    k = 10.0 ** rng.uniform(-2, 2)
    made = {
        "oscillator": lambda: Phase(
            lambda x, u: ca.vertcat(x[1], -(fast**2) * x[0] + u), 2, 1, start=[0, 0], end=[k, 0],
            stage_cost=lambda u: u**2,
        ),
        "two time scales": lambda: Phase(
            lambda x, u: ca.vertcat(-fast * (x[0] - x[1]), -slow * x[1] + u), 2, 1, start=[k, -k], duration=2.0,
            stage_cost=lambda x, u: ca.sumsqr(x) + u**2,
        ),
        "tracking": lambda: Phase(
            lambda x, u: -slow * x + u, 1, 1, start=[k],
            stage_cost=lambda x, u, t: 100 * (x - k * ca.sin(fast * t)) ** 2 + u**2,
        ),
        "hypersensitive": lambda: Phase(
            lambda x, u: -(x**3) + u, 1, 1, start=[1], end=[1.5], duration=10 * fast,
            stage_cost=lambda x, u: (x**2 + u**2) / 2,
        ),
        "Van der Pol": lambda: Phase(
            lambda x, u: ca.vertcat(x[1], -x[0] + slow * 3 * x[1] * (1 - x[0] ** 2) + u), 2, 1, start=[1, 0],
            end=[0, None], duration=5.0, stage_cost=lambda x, u: ca.sumsqr(x) + u**2, u_bounds=(-1, 1),
        ),
        "shortest time": lambda: Phase(
            lambda x, u: ca.vertcat(x[1], u - slow * x[1] / k), 2, 1, start=[0, 0], end=[k * slow, 0],
            duration=(0.01, 1e4), duration_guess=3 * np.sqrt(k), u_bounds=(-1, 1), terminal_cost=lambda t: t,
        ),
        "least fuel": lambda: Phase(
            lambda x, u: ca.vertcat(x[1], u[0] - u[1] - slow * x[1]), 2, 2, start=[0, 0], end=[0.5, 0], duration=5.0,
            u_bounds=(0, 1), stage_cost=lambda u: ca.sum1(u),
        ),
        "pendulum": lambda: Phase(
            lambda x, u: ca.vertcat(x[1], u - fast * ca.sin(x[0])), 2, 1, start=[0, 0], end=[1.0, 0], duration=2.0,
            stage_cost=lambda u: u**2,
        ),
    }  # fmt: skip
    kind = sorted(made)[seed % len(made)]
    schemes = [Radau(int(rng.integers(1, 6))), HermiteSimpson(), Trapezoidal(), MultipleShooting(1)]
    return kind, made[kind](), schemes[int(rng.choice(4, p=[0.5, 0.2, 0.15, 0.15]))], int(rng.integers(2, 40))


def judged_mesh(phase: Phase, scheme: Any, intervals: int) -> tuple[str, str]:
    """The status of a solution on a mesh, and what is wrong if that says SOLVED."""
    found = solve(build(phase, scheme, intervals))
    if not found.solved:
        return found.status.name, ""
    if isinstance(scheme, MultipleShooting):
        least = [solve(build(phase, MultipleShooting(64), intervals), start=found).cost]
    else:  # of several optima that from the same guess, or the one that it lies in
        least = [plain(phase, FINE)[2], solve(build(phase, Radau(3), FINE), start=found).cost]
    apart = min(abs(found.cost / cost - 1) for cost in least)
    said = found.cost_error / abs(found.cost)
    wrong = f"cost {found.cost:.6g}, fine {least[0]:.6g}, apart {apart:.1e}, said {said:.1e}"
    return "SOLVED", "" if apart <= MISSED else wrong


def main() -> None:
    """Print both tables."""
    usual = ["20", "50", "0"]
    fields, meshes, first = (int(given) for given in sys.argv[1:] + usual[len(sys.argv) - 1 :])
    ways: dict[str, list[tuple[str, str]]] = {}
    for seed in range(first, first + fields):
        given = field(seed)
        on_mesh = int(np.random.default_rng(seed).choice([10, 20, 40]))
        for way, found in (
            ("discs, solve", solve(build(given.phase(), intervals=on_mesh), time_limit=20)),
            ("discs, refine", refine(given.phase(), time_limit=60)),
        ):
            ways.setdefault(way, []).append(judged_field(given, found))
            if ways[way][-1][1]:
                print(f"  {way}, seed {seed}: {ways[way][-1][1]}", flush=True)
    for seed in range(first, first + meshes):
        kind, phase, scheme, intervals = coarse(seed)
        ways.setdefault("coarse meshes, solve", []).append(judged_mesh(phase, scheme, intervals))
        if wrong := ways["coarse meshes, solve"][-1][1]:
            print(f"  {kind}, seed {seed}, {intervals} intervals of {scheme.name}: {wrong}", flush=True)
    print("| work | problems | SOLVED | of them wrong | others |\n|---|---|---|---|---|")
    for way, judged in ways.items():
        others = Counter(status for status, _ in judged)
        solved = others.pop("SOLVED", 0)
        wrong = sum(bool(text) for _, text in judged)
        words = ", ".join(f"{count} {status}" for status, count in others.most_common()) or "none"
        print(f"| {way} | {len(judged)} | {solved} | {wrong} | {words} |")


if __name__ == "__main__":
    main()
