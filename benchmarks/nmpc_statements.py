"""Random statements of nonlinear MPC by a `Phase`, beside plain CasADi and Ipopt from the same start and ten others.

    python benchmarks/nmpc_statements.py [--first SEED] [--count N] [--starts N] [--decades N]   # first plans
    python benchmarks/nmpc_statements.py --loops                                  # closed loops
    python benchmarks/nmpc_statements.py --kicks [--first SEED] [--count N] [--decades N]  # random ones, kicked

A statement has one of six plants in random units (three decades to either side, or `--decades`), a horizon of 8 to 30
samples, and by chance: obstacles, a box or a ball as terminal set, end conditions, an economic cost, parameters that
change over the horizon, references, soft limits, limits and prices of changes of the inputs; some cannot be met. The
reference is multiple shooting written here, from the state held, and from ten other places: roll-outs of inputs by
chance and straight ways.
Required: never dearer than the reference from the same start, nor than the best of all eleven, by more than 1e-6; never
SOLVED where no start is feasible, nor where a limit is passed by more than 3e-6 of its size.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import casadi as ca
import numpy as np

from mpc import Status
from mpc.optimal_control import NonlinearMPC, Phase, loop_planner, paths
from mpc.optimal_control.sqp import next_step


def rk4(rate: Any, x: Any, h: float, parts: int = 2) -> Any:
    """State after h."""
    h = h / parts
    for _ in range(parts):
        k1 = rate(x)
        k2 = rate(x + h / 2 * k1)
        k3 = rate(x + h / 2 * k2)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3))
    return x


def unicycle(x: Any, u: Any, w: Any) -> Any:
    """Position, heading; speed, turn; a current by w."""
    return rk4(lambda z: ca.vertcat(u[0] * ca.cos(z[2]) + 0.2 * w, u[0] * ca.sin(z[2]), u[1]), x, 0.2)


def point(x: Any, u: Any, w: Any) -> Any:
    """Position and speed in the plane with air resistance; w is a wind."""
    return rk4(lambda z: ca.vertcat(z[2], z[3], u[0] - 0.3 * z[2] * ca.sqrt(0.01 + z[2] ** 2) + 0.3 * w, u[1]), x, 0.2)


def tank(x: Any, u: Any, w: Any) -> Any:
    """Reactor of second order about a working point: concentration and temperature; w is a heat load."""

    def rate(z: Any) -> Any:
        burnt = 0.6 * (1 + 0.5 * z[0]) ** 2 * ca.exp(0.8 * z[1])
        return ca.vertcat(0.6 - burnt - 0.5 * z[0], burnt - 0.6 - z[1] + 0.8 * u[0] + 0.2 * w)

    return rk4(rate, x, 0.3)


def pendulum(x: Any, u: Any, w: Any) -> Any:
    """Angle from hanging and its rate; torque; w is a push."""
    return rk4(lambda z: ca.vertcat(z[1], -2 * ca.sin(z[0]) - 0.1 * z[1] + u[0] + 0.2 * w), x, 0.15)


def oscillator(x: Any, u: Any, w: Any) -> Any:
    """Van der Pol."""
    return rk4(lambda z: ca.vertcat(z[1], (1 - z[0] ** 2) * z[1] - z[0] + u[0] + 0.2 * w), x, 0.15)


def fish(x: Any, u: Any, w: Any) -> Any:
    """Predator and prey about their balance in logarithms; harvest of each; w is food."""
    return rk4(lambda z: ca.vertcat(1 - ca.exp(z[1]) + 0.3 * w - 0.5 * u[0], ca.exp(z[0]) - 1 - 0.5 * u[1]), x, 0.2)


PLANTS = {  # states that a start has, inputs, whether the first two states are a place
    unicycle: ([2.5, 2, 1.5], [1, 1.5], True), point: ([2.5, 2.5, 0.5, 0.5], [1.2, 1.2], True),
    tank: ([0.5, 0.5], [1.5], False), pendulum: ([2.0, 1.0], [1.5], False), oscillator: ([1.5, 1.5], [1.5], False),
    fish: ([0.6, 0.6], [0.8, 0.8], False),
}  # fmt: skip


@dataclass
class Statement:
    """Functions of x, u, w, p, t, u_prev in plain units, and the units that they are stated in."""

    plant: Any
    N: int
    x: np.ndarray
    size_x: np.ndarray
    size_u: np.ndarray
    unit: float  # of the cost
    w: np.ndarray  # (N + 1, 2): disturbance or parameter, and reference
    p: float
    kind: list[str] = field(default_factory=list)
    Q: Any = None
    R: Any = None
    economic: Any = None
    ball: float = 0.0
    end: Any = None
    terminal: float = 5.0
    obstacles: Any = ()
    soft: Any = None
    bound: Any = None
    moves: float = 0.0
    rate: Any = None
    power: float = 0.0

    def stage(self, x: Any, u: Any, w: Any, p: Any, last: Any) -> Any:
        """Cost of a stage."""
        target = ca.vertcat(w[1], ca.DM.zeros(x.numel() - 1))
        cost = ca.bilin(ca.DM(self.R), u) + self.moves * ca.sumsqr(u - last)
        if self.economic is not None:
            return cost + p * ca.dot(ca.DM(self.economic), x) + 0.3 * ca.sumsqr(x)
        return cost + p * ca.bilin(ca.DM(self.Q), x - target)

    def last(self, x: Any, w: Any, p: Any) -> Any:
        """Cost of the end."""
        return 0 if self.economic is not None else self.terminal * p * ca.bilin(ca.DM(self.Q), x) + 0 * w[0]

    def limits(self, x: Any, u: Any, t: Any) -> list[Any]:
        """Hard limits ≤ 0 besides bounds: discs that move, and a limit of x and u together."""
        found = [r**2 - (x[0] - cx - v * t) ** 2 - (x[1] - cy) ** 2 for cx, cy, r, v in self.obstacles]
        return [*found, *([u[0] * x[1] - self.power] if self.power else [])]

    def soft_value(self, x: Any) -> Any:
        """Soft limit ≤ 0."""
        return x[1] - self.soft[0]


def random_statement(seed: int, decades: int = 3) -> Statement:
    """Statement of a seed."""
    rng = np.random.default_rng(seed)
    plant = list(PLANTS)[seed % len(PLANTS)]
    about, limit, place = PLANTS[plant]
    nx, nu, N = len(about), len(limit), int(rng.integers(8, 31))
    x = rng.uniform(-1, 1, nx) * about
    w = np.zeros((N + 1, 2))
    size_x, size_u, unit = (10.0 ** rng.integers(-decades, decades + 1, count) for count in (nx, nu, 1))
    one = Statement(plant, N, x, size_x, size_u, float(unit[0]), w, float(rng.uniform(0.5, 2)))
    one.Q, one.R = np.diag(rng.uniform(0.2, 2, nx)), np.diag(rng.uniform(0.05, 0.5, nu))

    def some(name: str, chance: float) -> bool:
        if rng.random() < chance:
            one.kind.append(name)
            return True
        return False

    if some("p over horizon", 0.5):
        w[:, 0] = np.sin(np.arange(N + 1) * rng.uniform(0.2, 1) + rng.uniform(0, 6))
    if some("economic", 0.3):
        one.economic = rng.normal(size=nx)
    elif some("reference", 0.4):
        w[:, 1] = 0.5 * np.cos(np.arange(N + 1) * rng.uniform(0.1, 0.5))
    if place and some("obstacle", 0.7):
        discs = []
        for _ in range(rng.integers(1, 3)):
            radius, along = rng.uniform(0.2, 0.6), rng.uniform(0.3, 0.7)
            centre = along * x[:2] + rng.normal(size=2) * 0.2
            radius = min(radius, 0.7 * np.linalg.norm(centre - x[:2]))
            discs.append((*centre, radius, rng.choice([0.0, 0.02])))
        one.obstacles = discs
    if some("power", 0.2):
        one.power = float(max(rng.uniform(0.2, 1), 1e-3))
    if some("state bounds", 0.4):
        one.bound = np.maximum(np.abs(x), 0.3 * np.asarray(about)) * rng.uniform(1.02, 1.5)
    if some("soft", 0.4):
        one.soft = (float(rng.uniform(-0.3, 0.5)), float(rng.uniform(0, 5)), float(rng.uniform(0.1, 5)))
    if some("ball at end", 0.25):
        one.ball = float(rng.uniform(0.3, 1.0) * np.linalg.norm(about))
    elif some("end condition", 0.15):
        one.end = float(rng.uniform(-0.3, 0.3))
    if some("rate limit", 0.4):
        one.rate = rng.uniform(0.2, 0.8, nu) * limit
    if some("price of moves", 0.3):
        one.moves = float(rng.uniform(0.1, 2))
    return one


def law_of(one: Statement, starts: int) -> tuple[NonlinearMPC, dict[str, Any]]:
    """Controller of a statement in its units, and the signals of a sample."""
    sx, su, nx = ca.DM(one.size_x), ca.DM(one.size_u), len(one.x)
    limit = np.asarray(PLANTS[one.plant][1])
    carried = one.rate is not None or one.moves > 0

    def path(x: Any, u: Any, t: Any) -> Any:
        x, u = x / sx, u / su
        return ca.vertcat(*one.limits(x, u, t), *([] if one.soft is None else [one.soft_value(x)]))

    def cost(x: Any, u: Any, w: Any, p: Any) -> Any:
        return one.unit * one.stage(x / sx, u / su, w, p, 0)

    def cost_with_moves(x: Any, u: Any, w: Any, p: Any, u_prev: Any) -> Any:
        return one.unit * one.stage(x / sx, u / su, w, p, u_prev / su)

    hard = len(one.obstacles) + bool(one.power)
    prices = None
    if one.soft is not None:
        prices = tuple([*[None] * hard, one.unit * price] for price in one.soft[1:])
    stated: dict[str, Any] = {}
    if hard or one.soft is not None:
        stated |= {"path": path, "path_prices": prices}
    if one.ball:
        stated |= {"boundary": lambda x: ca.sumsqr(x / sx) - one.ball**2, "boundary_bounds": (-np.inf, 0)}
    if one.end is not None:
        stated |= {"boundary": lambda x: x[0] / sx[0] - one.end}
    if one.bound is not None:
        stated |= {"x_bounds": (-one.bound * one.size_x, one.bound * one.size_x)}
    phase = Phase(
        lambda x, u, w: sx * one.plant(x / sx, u / su, w[0]), nx, len(limit), discrete=True, duration=one.N,
        stage_cost=cost_with_moves if one.moves else cost,
        terminal_cost=lambda x, w, p: one.unit * one.last(x / sx, w, p),
        u_bounds=(-limit * one.size_u, limit * one.size_u), signal=one.w, **stated,
    )  # fmt: skip
    rate = None if one.rate is None else one.rate * one.size_u
    signals: dict[str, Any] = {"u_prev": np.zeros(len(limit))} if carried else {}
    if hard or one.soft is not None:
        signals["t"] = 0.0
    return NonlinearMPC(phase, p=[one.p], rate_limit=rate, starts=starts), signals


class Reference:
    """Plain multiple shooting in plain units, by Ipopt."""

    def __init__(self, one: Statement) -> None:
        self.one, nx = one, len(one.x)
        limit = np.asarray(PLANTS[one.plant][1])
        nu, N = len(limit), one.N
        X, U, e = ca.MX.sym("x", nx, N + 1), ca.MX.sym("u", nu, N), ca.MX.sym("e", N + 1)
        x, u, w, last, t = (ca.SX.sym(n, s) for n, s in (("x", nx), ("u", nu), ("w", 2), ("last", nu), ("t", 1)))
        step = ca.Function("step", [x, u, w], [one.plant(x, u, w[0])])
        stage = ca.Function("stage", [x, u, w, last], [one.stage(x, u, w, one.p, last)])
        cost, rows, low, high = 0, [], [], []

        def keep(value: Any, least: Any, most: Any) -> None:
            rows.append(value)
            low.append(np.broadcast_to(least, value.shape[0]))
            high.append(np.broadcast_to(most, value.shape[0]))

        path = ca.Function("path", [x, u, t], [ca.vertcat(ca.SX(0, 1), *one.limits(x, u, t))])
        of_u = np.zeros(path.numel_out(0), dtype=bool)
        of_u[path.jac_sparsity(0, 1).row()] = True
        for k in range(N):
            before = U[:, k - 1] if k else ca.DM.zeros(nu)
            cost += stage(X[:, k], U[:, k], one.w[k], before)
            keep(X[:, k + 1] - step(X[:, k], U[:, k], one.w[k]), 0, 0)
            if one.rate is not None:
                keep(U[:, k] - before, -one.rate, one.rate)
            chosen = np.flatnonzero(of_u | (k > 0)).tolist()
            if chosen:
                keep(path(X[:, k], U[:, k], k)[chosen], -np.inf, 0)
        if not of_u.all():
            keep(path(X[:, N], U[:, N - 1], N)[np.flatnonzero(~of_u).tolist()], -np.inf, 0)
        cost += one.last(X[:, N], one.w[N], one.p)
        if one.soft is not None:
            for k in range(1, N + 1):
                keep(one.soft_value(X[:, k]) - e[k], -np.inf, 0)
            cost += one.soft[1] * ca.sum1(e) + one.soft[2] * ca.sumsqr(e)
        if one.ball:
            keep(ca.sumsqr(X[:, N]) - one.ball**2, -np.inf, 0)
        if one.end is not None:
            keep(X[0, N] - one.end, 0, 0)
        nlp = {"x": ca.vertcat(ca.vec(X), ca.vec(U), e), "f": cost, "g": ca.vertcat(*rows)}
        self.solver = ca.nlpsol("reference", "ipopt", nlp, {
            "ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "ipopt.tol": 1e-9, "ipopt.max_iter": 1000,
            "expand": True, "show_eval_warnings": False, "ipopt.bound_relax_factor": 0.0,
        })  # fmt: skip
        self.rows = np.concatenate(low), np.concatenate(high)
        bound = np.full(nx, np.inf) if one.bound is None else one.bound
        self.low = np.concatenate([one.x, np.tile(-bound, N), np.tile(-limit, N), np.zeros(N + 1)])
        self.high = np.concatenate([one.x, np.tile(bound, N), np.tile(limit, N), np.full(N + 1, np.inf)])
        self.g = ca.Function("g", [nlp["x"]], [nlp["f"], nlp["g"]])
        self.step, self.limit = step, limit

    def from_(self, states: np.ndarray, inputs: np.ndarray) -> tuple[float, np.ndarray]:
        """Cost and unknowns of an optimum, infinite where none was found."""
        guess = np.concatenate([states.ravel(), inputs.ravel(), np.zeros(self.one.N + 1)])
        found = self.solver(x0=guess, lbx=self.low, ubx=self.high, lbg=self.rows[0], ubg=self.rows[1])
        good = self.solver.stats()["success"] and self.solver.stats()["return_status"] == "Solve_Succeeded"
        return float(found["f"]) if good else np.inf, np.asarray(found["x"]).ravel()

    def starts(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """State held, and ten other places."""
        one, rng = self.one, np.random.default_rng(99)
        N, nu = one.N, len(self.limit)
        held = np.tile(one.x, (N + 1, 1))
        found = [(held, np.zeros((N, nu)))]
        way = np.linspace(1, 0, N + 1)[:, None]
        for side in (-1, 0, 1):
            bent = held * way
            bent[:, 0] -= side * np.sin(np.pi * way[:, 0]) * one.x[1]
            bent[:, 1] += side * np.sin(np.pi * way[:, 0]) * one.x[0]
            found.append((bent, np.zeros((N, nu))))
        for _ in range(7):
            inputs = np.repeat(rng.uniform(-1, 1, (1 + N // 5, nu)) * self.limit, 5, axis=0)[:N]
            states = [one.x]
            for k in range(N):
                states.append(np.asarray(self.step(states[-1], inputs[k], one.w[k])).ravel())
            found.append((np.array(states), inputs))
        return found

    def worth(self, states: np.ndarray, inputs: np.ndarray) -> tuple[float, float]:
        """Cost of a plan, and the most by which it passes anything."""
        one = self.one
        e = np.zeros(one.N + 1)
        if one.soft is not None:
            e[1:] = np.maximum(states[1:, 1] - one.soft[0], 0)
        v = np.concatenate([states.ravel(), inputs.ravel(), e])
        f, g = self.g(v)
        g = np.asarray(g).ravel()
        over = max(np.maximum(self.rows[0] - g, g - self.rows[1]).max(), np.maximum(self.low - v, v - self.high).max())
        return float(f), float(over)


def first_plans(first: int, count: int, starts: int, decades: int) -> None:
    """Print the table."""
    tally: Counter[str] = Counter()
    kinds: dict[str, Counter[str]] = {}
    times = []
    for seed in range(first, first + count):
        one = random_statement(seed, decades)
        reference = Reference(one)
        law, signals = law_of(one, starts)
        began = time.perf_counter()
        plan = law.solve(one.x * one.size_x, **signals)
        times.append(time.perf_counter() - began)
        costs = [reference.from_(*start)[0] for start in reference.starts()]
        same, best = costs[0], min(costs)
        cost, over = reference.worth(plan.states / one.size_x, plan.inputs / one.size_u)
        room = 1e-6 * max(1.0, abs(best)) if np.isfinite(best) else 0.0
        marks = [plan.status.name if np.isfinite(best) else f"infeasible: {plan.status.name}"]
        if plan.status is Status.SOLVED:
            checks = {"passes a limit": over > 3e-6, "dearer than from the same start": cost > same + room,
                      "dearer than the best of eleven": cost > best + room,
                      "cost told wrong": abs(plan.cost / one.unit - cost) > 1e-5 * max(1, abs(cost))}  # fmt: skip
            marks += [mark for mark, there in checks.items() if there] or ["as good as the best"]
            marks += ["better than the best"] if cost < best - room and np.isfinite(best) else []
        tally.update(marks)
        for kind in one.kind or ["none"]:
            kinds.setdefault(kind, Counter()).update(marks)
        if not {"SOLVED", "as good as the best"} <= set(marks):
            print(seed, one.plant.__name__, one.N, ", ".join(one.kind), "|", ", ".join(marks),
                  f"| {cost:.8g} {same:.8g} {best:.8g}, over {over:.1e}, {times[-1]:.2f} s", flush=True)  # fmt: skip
    print(f"\n| {count} statements, {starts} starts | |\n|---|---|")
    for mark, number in tally.most_common():
        print(f"| {mark} | {number} |")
    print(f"| first plan, median and largest | {np.median(times):.2f} s, {max(times):.2f} s |")
    print("\n| with | statements | as good as the best |\n|---|---|---|")
    for kind, own in sorted(kinds.items()):
        total = sum(v for k, v in own.items() if k in Status.__members__ or k.startswith("infeasible"))
        print(f"| {kind} | {total} | {own['as good as the best']} |")


def loops() -> None:
    """Print closed loops beside Ipopt begun at its shifted plan."""

    def statement(plant: Any, x: list[float], N: int, **stated: Any) -> Statement:
        nx, nu = len(x), len(PLANTS[plant][1])
        usual = {"Q": np.eye(nx), "R": 0.1 * np.eye(nu)}
        return Statement(plant, N, np.array(x), np.ones(nx), np.ones(nu), 1.0, np.zeros((N + 1, 2)), 1.0,
                         **(usual | stated))  # fmt: skip

    discs = [(1.4, 0.9, 0.45, 0.0), (0.5, 0.25, 0.25, 0.0)]
    cases = {
        "vehicle between two discs": (statement(unicycle, [2.5, 1.5, 3.0], 20, obstacles=discs), 50),
        "economic reactor": (statement(tank, [0.4, -0.4], 30, economic=[-1.0, 0.5], bound=np.array([1.0, 0.3])), 50),
        "pendulum, soft limit on the rate": (statement(pendulum, [2.0, 0.0], 25, soft=(0.8, 1.0, 2.0)), 50),
    }  # fmt: skip
    print("| loop | cost, of Ipopt | statuses | largest violation | median, 99 %, first [ms] | Ipopt's |"
          " programs, median and 99 % | iterations of Ipopt |\n|---|---|---|---|---|---|---|---|")  # fmt: skip
    programs: list[int] = []

    def counted(*given: Any, **stated: Any) -> Any:
        """Next step; one that does not move only confirms."""
        step = next_step(*given, **stated)
        programs[-1] += step.size > 0
        return step

    loop_planner.next_step = paths.next_step = counted
    for name, (one, samples) in cases.items():
        reference = Reference(one)
        law, signals = law_of(one, 3)
        nx, found = len(one.x), []
        for ours in (True, False):
            law.reset()
            programs.clear()
            x, total, worst, times, statuses = one.x, 0.0, 0.0, [], Counter[str]()
            states, inputs = np.tile(x, (one.N + 1, 1)), np.zeros((one.N, len(reference.limit)))
            for _ in range(samples):
                programs.append(0)
                began = time.process_time()
                if ours:
                    u = law(x, **signals)
                    statuses[f"{law.last_plans[0].status.name} by {law.last_plans[0].solver}"] += 1
                else:
                    reference.low[:nx] = reference.high[:nx] = x
                    cost, v = reference.from_(states, inputs)
                    statuses["ended" if np.isfinite(cost) else "failed"] += 1
                    programs[-1] = reference.solver.stats()["iter_count"]
                    states = v[: nx * (one.N + 1)].reshape(-1, nx)
                    inputs = v[states.size : states.size + inputs.size].reshape(one.N, -1)
                    u = inputs[0]
                    states, inputs = np.vstack([states[1:], states[-1]]), np.vstack([inputs[1:], inputs[-1]])
                times.append(1e3 * (time.process_time() - began))
                total += float(one.stage(ca.DM(x), ca.DM(u), one.w[0], one.p, 0 * u))
                x = np.asarray(reference.step(x, u, one.w[0])).ravel()
                if one.soft is not None:
                    over = max(float(one.soft_value(x)), 0.0)
                    total += one.soft[1] * over + one.soft[2] * over**2
                worst = max(worst, *(float(value) for value in one.limits(x, u, 0)), -np.inf)
                worst = max(worst, np.max(np.abs(x) - one.bound) if one.bound is not None else -np.inf)
            told = ["{:.3g}, {:.3g}".format(*np.percentile(each[1:], [50, 99])) for each in (times, programs)]
            found.append((total, dict(statuses), worst, f"{told[0]}, {times[0]:.0f}", told[1]))
        (own, said, worst, mine, needed), (theirs, ended, _, *others) = found
        print(f"| {name} | {own:.6f}, {theirs:.6f} | {said} ({ended}) | {worst:.1e} | {mine} | {others[0]} | "
              f"{needed} | {others[1]} |", flush=True)  # fmt: skip


def kicks(first: int, count: int, decades: int) -> None:
    """Print loops of 8 samples, kicked before every other one by chance, beside Ipopt from the same shifted plan."""
    told: Counter[str] = Counter()
    own, theirs = [], []
    for seed in range(first, first + count):
        one, rng = random_statement(seed, decades), np.random.default_rng(seed)
        (law, signals), reference = law_of(one, 3), Reference(one)
        nx, x, before = len(one.x), one.x, None
        for _ in range(8):
            began = time.process_time()
            u = law(x * one.size_x, **signals) / one.size_u
            plan, took = law.last_plans[0], time.process_time() - began
            states, inputs = plan.states / one.size_x, plan.inputs / one.size_u
            if before is not None:
                own.append(1e3 * took)
                reference.low[:nx] = reference.high[:nx] = x
                began = time.process_time()
                least, _ = reference.from_(*(np.vstack([part[1:], part[-1:]]) for part in before))
                theirs.append(1e3 * (time.process_time() - began))
                cost, over = reference.worth(states, inputs)
                solved, room = plan.status is Status.SOLVED, 1e-6 * max(1.0, abs(least))
                told[f"{plan.status.name} by {plan.solver}"] += 1
                told["SOLVED that passes a limit"] += solved and over > 3e-6
                told["SOLVED and dearer"] += bool(solved and np.isfinite(least) and cost > least + room)
                told["not SOLVED where Ipopt is"] += bool(not solved and np.isfinite(least))
            before = states, inputs
            x = np.asarray(reference.step(x, u, one.w[0])).ravel()
            x = x + (rng.random() < 0.5) * 0.15 * rng.normal(size=nx) * np.asarray(PLANTS[one.plant][0])
    for mark, number in told.items():
        print(f"| {mark} | {number} |")
    for name, each in (("here", own), ("Ipopt", theirs)):
        print(f"| {name}, median, 99 %, mean | {np.median(each):.1f}, {np.percentile(each, 99):.0f}, "
              f"{np.mean(each):.1f} ms |")  # fmt: skip


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--starts", type=int, default=3)
    parser.add_argument("--decades", type=int, default=3)
    parser.add_argument("--loops", action="store_true")
    parser.add_argument("--kicks", action="store_true")
    asked = parser.parse_args()
    if asked.kicks:
        return kicks(asked.first, asked.count, asked.decades)
    if asked.loops:
        return loops()
    return first_plans(asked.first, asked.count, asked.starts, asked.decades)


if __name__ == "__main__":
    main()
