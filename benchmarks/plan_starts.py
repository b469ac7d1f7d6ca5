"""Plans from several starts beside the best of 50 Ipopt starts of a plain script.

    python benchmarks/plan_starts.py [--problems 100] [--first 0] [--starts 5] [--others 50]

Random problems with several optima in units drawn at random: a mass between discs, a point between wells of a
potential, and swings of a pendulum whose torque cannot lift it. Both solve the same program: Runge–Kutta steps of order
4, inputs held. The plain script shares nothing else: straight lines and random splines are its guesses. One thread.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from mpc.optimal_control import MultipleShooting, Phase, build, solve

GAIN = 1e-3  # How much dearer than the best a plan may be [-].


@dataclass(frozen=True)
class Case:
    """Random problem, in units of its own; all sizes about one before that."""

    name: str
    rates: Callable[[Any, Any], Any]
    cost: Callable[[Any, Any], Any]
    path: Callable[[Any], Any] | None
    start: np.ndarray
    end: np.ndarray  # NaN where free
    box: np.ndarray  # (nx,): half-widths of states, where guesses are drawn too
    most: np.ndarray  # (nu,): of inputs
    duration: float
    steps: int
    units: tuple[np.ndarray, np.ndarray, float, float]  # of states, inputs, time and cost

    def dynamics(self, x: Any, u: Any) -> Any:
        """dx/dt in its units."""
        of_x, of_u, of_t, _ = self.units
        return self.rates(x / of_x, u / of_u) * of_x / of_t

    def price(self, x: Any, u: Any) -> Any:
        """Stage cost in its units."""
        of_x, of_u, of_t, of_cost = self.units
        return self.cost(x / of_x, u / of_u) * of_cost / of_t

    def limits(self, x: Any) -> Any:
        """Limits ≤ 0."""
        return ca.vertcat() if self.path is None else self.path(x / self.units[0])


def discs(rng: np.random.Generator) -> dict[str, Any]:
    """A mass in the plane, from left to right between discs."""
    start, end = np.array([-4.5, rng.uniform(-2, 2), 0, 0]), np.array([4.5, rng.uniform(-2, 2), 0, 0])
    centres, radii = np.zeros((0, 2)), rng.uniform(0.5, 1.3, rng.integers(3, 8))
    for _ in radii:
        centres = np.vstack([centres, rng.uniform([-3, -2.5], [3, 2.5])])

    def path(x: Any) -> Any:
        return ca.vertcat(*(1 - ca.sumsqr(x[:2] - ca.DM(c)) / r**2 for c, r in zip(centres, radii)))

    return {
        "rates": lambda x, u: ca.vertcat(x[2:], u), "cost": lambda x, u: ca.sumsqr(u), "path": path, "start": start,
        "end": end, "box": np.array([5, 5, 4, 4.0]), "most": np.array([2, 2.0]), "duration": rng.uniform(6, 10),
        "steps": 50,
    }  # fmt: skip


def wells(rng: np.random.Generator) -> dict[str, Any]:
    """A point in the plane that is drawn to one of several wells."""
    count = rng.integers(4, 9)
    centres, depths = rng.uniform(-2.5, 2.5, (count, 2)), rng.uniform(0.5, 1.5, count)
    widths = rng.uniform(0.3, 0.9, count)

    def cost(x: Any, u: Any) -> Any:
        drawn = (a * ca.exp(-ca.sumsqr(x - ca.DM(c)) / (2 * s**2)) for a, c, s in zip(depths, centres, widths))
        return 2 - sum(drawn) + 0.1 * ca.sumsqr(u)

    return {
        "rates": lambda x, u: u, "cost": cost, "path": None, "start": rng.uniform(-2.5, 2.5, 2),
        "end": np.full(2, np.nan), "box": np.array([3, 3.0]), "most": np.array([3, 3.0]),
        "duration": rng.uniform(2, 6), "steps": 40,
    }  # fmt: skip


def pendulum(rng: np.random.Generator) -> dict[str, Any]:
    """A pendulum that is to stand up, by a torque that cannot lift it at once."""
    damping, weight = rng.uniform(0, 0.2), 10 ** rng.uniform(-2, 0)
    return {
        "rates": lambda x, u: ca.vertcat(x[1], -ca.sin(x[0]) - damping * x[1] + u),
        "cost": lambda x, u: 1 + ca.cos(x[0]) + 0.1 * x[1] ** 2 + weight * u**2, "path": None,
        "start": np.array([rng.uniform(-1, 1), rng.uniform(-1, 1)]), "end": np.full(2, np.nan),
        "box": np.array([7, 4.0]), "most": np.array([rng.uniform(0.25, 0.9)]), "duration": rng.uniform(6, 12),
        "steps": 60,
    }  # fmt: skip


FAMILIES = (discs, wells, pendulum)


def case(seed: int) -> Case:
    """Problem of a seed; three families in turn."""
    rng, family = np.random.default_rng(seed), FAMILIES[seed % len(FAMILIES)]
    stated = family(rng)
    units = (
        10 ** rng.uniform(-3, 3, len(stated["box"])), 10 ** rng.uniform(-3, 3, len(stated["most"])),
        10 ** rng.uniform(-2, 2), 10 ** rng.uniform(-3, 3),
    )  # fmt: skip
    return Case(family.__name__, units=units, **stated)


def statement(one: Case) -> Phase:
    """Phase of a problem."""
    of_x, of_u, of_t, _ = one.units
    end = one.end * of_x
    return Phase(
        dynamics=one.dynamics, states=len(of_x), inputs=len(of_u), stage_cost=one.price,
        path=None if one.path is None else one.limits, start=one.start * of_x, duration=one.duration * of_t,
        end=None if np.isnan(end).all() else end, x_bounds=(-one.box * of_x, one.box * of_x),
        u_bounds=(-one.most * of_u, one.most * of_u),
    )  # fmt: skip


def plain(one: Case, starts: int, seed: int) -> np.ndarray:
    """Costs (starts,) by a plain script, in the units of the case; infinite where Ipopt did not succeed."""
    nx, nu, N, h = len(one.box), len(one.most), one.steps, one.duration / one.steps
    x, u, cost = ca.SX.sym("x", nx), ca.SX.sym("u", nu), one.cost
    k1 = one.rates(x, u)
    k2 = one.rates(x + h / 2 * k1, u)
    k3 = one.rates(x + h / 2 * k2, u)
    k4 = one.rates(x + h * k3, u)
    paid = cost(x, u) + 2 * cost(x + h / 2 * k1, u) + 2 * cost(x + h / 2 * k2, u) + cost(x + h * k3, u)
    step = ca.Function("step", [x, u], [x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), h / 6 * paid])
    X, U = ca.MX.sym("X", nx, N + 1), ca.MX.sym("U", nu, N)
    after, costs = step.map(N)(X[:, :-1], U)
    g, low = [ca.vec(X[:, 1:] - after)], [np.zeros(nx * N)]
    if one.path is not None:
        limits = ca.Function("limits", [x], [one.path(x)])
        g.append(ca.vec(limits.map(N + 1)(X)))
        low.append(np.full(g[-1].numel(), -np.inf))
    options = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "ipopt.max_iter": 500}
    program: dict[str, ca.MX] = {"x": ca.veccat(X, U), "f": ca.sum2(costs), "g": ca.vertcat(*g)}
    solver = ca.nlpsol("plain", "ipopt", program, options)  # type: ignore[arg-type]
    sides = []
    for sign in (-1, 1):
        states = np.tile(sign * one.box, (N + 1, 1))
        states[0] = one.start
        states[-1] = np.where(np.isnan(one.end), states[-1], one.end)
        sides.append(np.r_[states.ravel(), np.tile(sign * one.most, N)])
    rng, found = np.random.default_rng(seed), []
    last = np.where(np.isnan(one.end), one.start, one.end)
    way = np.linspace(0, 1, N + 1)
    for k in range(starts):
        knots = np.linspace(0, 1, 5)
        table = rng.uniform(-one.box, one.box, (5, nx))
        table[0], table[-1] = one.start, np.where(np.isnan(one.end), table[-1], one.end)
        inputs = rng.uniform(-one.most, one.most, (5, nu))
        if k == 0:
            table, inputs = one.start + knots[:, None] * (last - one.start), 0 * inputs
        guess = [np.stack([np.interp(way[: N + 1 - m], knots, column) for column in T.T], axis=1)
                 for m, T in enumerate((table, inputs))]  # fmt: skip
        result = solver(x0=np.concatenate([part.ravel() for part in guess]), lbx=sides[0], ubx=sides[1],
                        lbg=np.concatenate(low), ubg=0)  # fmt: skip
        found.append(float(result["f"]) if solver.stats()["success"] else np.inf)
    return np.array(found)


def main() -> None:
    """Print a row for each family, and for all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in (("problems", 100), ("first", 0), ("starts", 5), ("others", 50)):
        parser.add_argument(f"--{name}", type=int, default=value)
    asked = parser.parse_args()
    kept: dict[str, list[tuple[float, ...]]] = {}
    for seed in range(asked.first, asked.first + asked.problems):
        one = case(seed)
        began = time.perf_counter()
        costs = plain(one, asked.others, seed) * one.units[3]
        theirs, began = time.perf_counter() - began, time.perf_counter()
        program = build(statement(one), MultipleShooting(), one.steps)
        alone, several = (solve(program, starts=count) for count in (1, asked.starts))
        best = costs.min()
        limit = best + GAIN * abs(best)
        within = [plan.solved_on_mesh and plan.cost <= limit for plan in (alone, several)]
        lucky = 1 - (1 - np.mean(costs <= limit)) ** asked.starts  # chance that so many of the plain starts find it
        better = several.solved_on_mesh and several.cost < best - GAIN * abs(best)
        kept.setdefault(one.name, []).append((*within, better, lucky, several.solve_time, theirs))
        if not within[1]:
            found, dearer = np.mean(costs <= limit), several.cost / best - 1
            print(f"seed {seed}, {one.name}: {dearer:.1%} dearer; {found:.0%} of the plain starts find it", flush=True)
    every = [row for rows in kept.values() for row in rows]
    print(f"| problems | one start within 0.1 % | starts={asked.starts} within 0.1 % | better by 0.1 % "
          f"| {asked.starts} plain starts, expected | s | {asked.others} plain starts, s |")  # fmt: skip
    print("|---|---|---|---|---|---|---|")
    for name, rows in (*kept.items(), ("all", every)):
        one, several, better, lucky, own, theirs = np.array(rows, dtype=float).T
        print(f"| {len(rows)} {name} | {one.sum():.0f} | {several.sum():.0f} | {better.sum():.0f} | {lucky.sum():.1f} "
              f"| {np.median(own):.2f} | {np.median(theirs):.2f} |")  # fmt: skip


if __name__ == "__main__":
    main()
