"""MPC tightened for the errors of a log, attacked with random disturbances and with every sequence of vertices.

``python benchmarks/robust_mpc.py [STUDY ...]`` prints five tables. A log of saturated LQR on the study's real plant
gives W, at the highest of three levels at which a controller exists.

1. The linear model with errors of W alone, stepped here by x⁺ = Ax + Bu + w: random ones (half of the runs within W,
   half at its vertices, of these half pushed towards one limit), then every sequence of vertices over a few steps.
   Required: no state outside X and no input outside U, from any state that has a plan.
2. The real plant, fresh disturbances, from starts that have a plan: samples outside X. Required: 1 - level + 2 sigma.
3. The price: returns on common runs, on the model from the study's start and on the real plant from those of 2,
   the volume of X_fea, and how much of the robust one has a plan: the rest is all that another controller could add.
4. Each limit with a probability: the share of samples in which the limit left most often is left, the real plant driven
   from the starts of 2. Required: 1 - level + 2 sigma. Beside it the share at the worst step; and all from the edge of
   the states that have a plan, where the log has hardly been.
5. Its price: returns on the real plant from common starts, those of 2, and the states that have a plan.
"""

from __future__ import annotations

import itertools
import sys
from dataclasses import dataclass

import numpy as np

from ccdtools import deploy, load_study, saturated_lqr
from ccdtools.statistics import paired_difference
from ccdtools.studies import Study
from ccdtools.twin import RobustMPC, robust_mpc
from mpc import InfeasibleError, LinearMPC, Status

STUDIES = ("illustrative", "suspension", "dc_servo", "two_tanks", "pendulum_on_cart")
LEVELS = (0.99, 0.95, 0.9)
ERRORS = ("quantiles", "normal")
ROUNDING = 1e-6  # half-widths of X and U, beyond which a state or an input is outside
DRAWS, STEPS, LEAVES = 100_000, 50, 5_000


@dataclass(frozen=True)
class Case:
    """Study with its model at the first design, and the controllers of a log."""

    study: Study
    A: np.ndarray
    B: np.ndarray
    found: RobustMPC
    nominal: LinearMPC
    stochastic: dict[str, RobustMPC]

    @property
    def limits(self):
        """Centres and half-widths of X and U."""
        problem = self.study.problem()
        bounds = problem.state_limits(self.found_p).bounding_box(), problem.input_bounds_at(self.found_p)
        return [((high + low) / 2, (high - low) / 2) for low, high in bounds]

    @property
    def found_p(self):
        """Design of the log."""
        return np.asarray(self.study.p0, dtype=float)


def case(name: str, rng) -> Case:
    """Case of a study, at the highest level that has a controller."""
    study = load_study(name)
    problem, real, p = study.problem(), study.real, np.asarray(study.p0, dtype=float)
    drawn = real.disturbance.sample(real.runs, real.steps, rng)
    log = deploy(real.plant, saturated_lqr(problem, p), p, drawn, x0=real.x0)
    A, B, _ = problem.model.matrices(p)
    for level in LEVELS:
        try:
            found = robust_mpc(problem, p, log, rng=np.random.default_rng(1), level=level, runs=100)
        except InfeasibleError:
            continue
        c = found.controller
        nominal = LinearMPC(A, B, **problem.weights(p).keywords(), horizon=c.horizon, X=c.X, U=c.U)
        stochastic = {errors: robust_mpc(problem, p, log, rng=np.random.default_rng(1), level=level, runs=100,
                                         errors=errors) for errors in ERRORS}  # fmt: skip
        return Case(study, A, B, found, nominal, stochastic)
    raise SystemExit(f"{name}: no controller at level {LEVELS[-1]}")


def planned(found: RobustMPC, states) -> np.ndarray:
    """Whether states have a tightened plan."""
    return np.array([plan.status is Status.SOLVED for plan in found.controller.solve_many(states)])


def with_plan(found: RobustMPC, count: int, rng) -> tuple[np.ndarray, float]:
    """States that have a tightened plan, of the robust X_fea and near its vertices, and their share of the first."""
    robust = found.robust_set.set
    kept = robust.sample(count, rng=rng)
    corners = robust.vertices[rng.permutation(len(robust.vertices))[:count]]
    centre = robust.vertices.mean(axis=0)
    near = np.concatenate([centre + by * (corners - centre) for by in (0.99, 0.95, 0.9)])
    has = planned(found, kept)
    return np.concatenate([kept[has], near[planned(found, near)]]), float(has.mean())


def at_the_edge(found: RobustMPC, count: int, rng) -> np.ndarray:
    """Last states with a plan on the way from the middle of the terminal set out of X_fea."""
    inside = found.robust_set.set.chebyshev_ball()[0]
    away = found.nominal_set.set.sample(count, rng=rng) - inside
    low, high = np.zeros(len(away)), np.full(len(away), 2.0)
    for _ in range(12):
        middle = (low + high) / 2
        has = planned(found, inside + middle[:, None] * away)
        low, high = np.where(has, middle, low), np.where(has, high, middle)
    return inside + low[:, None] * away


def outside(values, limits) -> int:
    """Rows that are outside the limits."""
    centre, half = limits
    return int((np.abs(values - centre) > half * (1 + ROUNDING)).any(axis=-1).sum())


def attacked(own: Case, law, starts, draws: int, rng) -> tuple[int, int]:
    """States outside X and inputs outside U under random disturbances."""
    of_states, of_inputs = own.limits
    vertices = own.found.W.vertices
    runs = max(draws // STEPS, 1)
    x = starts[rng.integers(len(starts), size=runs)]
    towards = rng.standard_normal((runs, x.shape[1])) / of_states[1]
    worst = vertices[np.argmax(towards @ vertices.T, axis=1)]
    kind = rng.random(runs)
    counts = np.zeros(2, int)
    for _ in range(STEPS):
        u = law(x)
        anywhere = rng.dirichlet(np.ones(len(vertices)), runs) @ vertices
        corner = vertices[rng.integers(len(vertices), size=runs)]
        w = np.where((kind < 0.5)[:, None], anywhere, np.where((kind < 0.75)[:, None], corner, worst))
        x = x @ own.A.T + u @ own.B.T + w
        counts += outside(x, of_states), outside(u, of_inputs)
    return int(counts[0]), int(counts[1])


def every_sequence(own: Case, law, starts, leaves: int) -> tuple[int, int, int]:
    """Length and number of the vertex sequences from each start, and states outside X along them."""
    vertices = own.found.W.vertices
    length = max(int(np.log(leaves) / np.log(len(vertices))), 1)
    count = 0
    for start in starts:
        x = start[None]
        for _ in range(length):
            after = x @ own.A.T + law(x) @ own.B.T
            x = (after[:, None] + vertices[None]).reshape(-1, len(start))
            count += outside(x, own.limits[0])
    return length, len(vertices) ** length, count


def extreme(states) -> np.ndarray:
    """States that reach farthest along each axis."""
    chosen = {int(i) for i in itertools.chain(np.argmax(states, axis=0), np.argmin(states, axis=0))}
    return states[sorted(chosen)]


def on_real(own: Case, law, starts, rng) -> tuple[float, float, np.ndarray]:
    """Share of samples outside X on the real plant, its standard error over runs, and their returns."""
    real = own.study.real
    runs, steps = 100, min(real.steps, 100)
    drawn = (
        real.disturbance.sample(runs, steps, rng)
        if real.runs > 1
        else np.stack([real.disturbance.sample(1, steps, rng)[0] for _ in range(runs)])
    )
    x0 = starts[np.arange(runs) % len(starts)]
    log = deploy(real.plant, law, own.found_p, drawn, x0=x0)
    centre, half = own.limits[0]
    share = (np.abs(log.states[:, 1:] - centre) > half * (1 + ROUNDING)).any(axis=2).mean(axis=1)
    error = float(share.std(ddof=1) / np.sqrt(runs))
    return float(share.mean()), error, log.returns(own.study.objective)


def left_most(own: Case, law, starts, rng) -> tuple[float, float, float]:
    """Share of samples in which the limit left most often is left, its standard error, and that of the worst step."""
    real = own.study.real
    runs, steps = 400, 50
    drawn = np.concatenate([real.disturbance.sample(1, steps, rng) for _ in range(runs)])
    log = deploy(real.plant, law, own.found_p, drawn, x0=starts[np.arange(runs) % len(starts)])
    centre, half = own.limits[0]
    beyond = (log.states[:, 1:] - centre) / half
    left = np.concatenate([beyond > 1 + ROUNDING, beyond < -1 - ROUNDING], axis=2)
    shares = left.mean(axis=1)  # of each run and limit
    limit = int(shares.mean(axis=0).argmax())
    error = float(shares[:, limit].std(ddof=1) / np.sqrt(runs))
    return float(shares[:, limit].mean()), error, float(left.mean(axis=0).max())


def main(names, draws: int = DRAWS, leaves: int = LEAVES) -> None:
    """Print the tables."""
    rows: list[list[str]] = [[], [], [], [], []]
    for name in names:
        rng = np.random.default_rng(0)
        own = case(name, rng)
        found = own.found
        starts, share = with_plan(found, 200, rng)
        laws = {"nominal": own.nominal, "tightened": found.controller}
        seeds = rng.integers(2**31, size=2)
        random = {k: attacked(own, law, starts, draws, np.random.default_rng(seeds[0])) for k, law in laws.items()}
        trees = {k: every_sequence(own, law, extreme(starts), leaves) for k, law in laws.items()}
        length, number, _ = trees["tightened"]
        sequences = f"{len(extreme(starts))} · {number} of {length} steps"
        rows[0].append(
            f"| {name} | {found.level:g} | {draws} | {random['nominal'][0]}; {random['nominal'][1]} | "
            f"{random['tightened'][0]}; {random['tightened'][1]} | {sequences} | "
            f"{trees['nominal'][2]} | {trees['tightened'][2]} |"
        )
        real = {k: on_real(own, law, starts, np.random.default_rng(seeds[1])) for k, law in laws.items()}
        allowed = 1 - found.level + 2 * real["tightened"][1]
        rows[1].append(f"| {name} | {real['nominal'][0]:.3%} | {real['tightened'][0]:.3%} | {allowed:.3%} |")
        price, (low, high) = found.price.mean, found.price.ci95
        before = found.nominal.summary.mean
        elsewhere = paired_difference(real["nominal"][2], real["tightened"][2])
        few, many = elsewhere.ci95
        rows[2].append(
            f"| {name} | {before:.5g} | {price:.3g} [{low:.2g}, {high:.2g}] | {real['nominal'][2].mean():.5g} | "
            f"{elsewhere.mean:.3g} [{few:.2g}, {many:.2g}] | {found.volume_left:.1%} | {share:.1%} |"
        )
        allowed = 1 - found.level
        told = []
        for one in own.stochastic.values():
            edge = at_the_edge(one, 200, rng)
            for places, law in ((starts, one.controller), (edge, own.nominal), (edge, one.controller)):
                most, error, step = left_most(own, law, places, np.random.default_rng(seeds[1]))
                told.append(f"{most:.2%} ({step:.1%}; {allowed + 2 * error:.2%})")
        rows[3].append(f"| {name} | {found.level:g} | {' | '.join(told)} |")
        told = []
        for one in own.stochastic.values():
            returns = on_real(own, one.controller, starts, np.random.default_rng(seeds[1]))[2]
            price = paired_difference(real["nominal"][2], returns)
            told.append(f"{price.mean:.3g} [{price.ci95[0]:.2g}, {price.ci95[1]:.2g}]")
        sizes = [f"{planned(one, found.nominal_set.set.sample(400, rng=np.random.default_rng(3))).mean():.1%}"
                 for one in (found, *own.stochastic.values())]  # fmt: skip
        tube = f"{elsewhere.mean:.3g} [{few:.2g}, {many:.2g}]"
        rows[4].append(f"| {name} | {real['nominal'][2].mean():.5g} | {tube} | {' | '.join(told + sizes)} |")
        print(f"{name} done", file=sys.stderr, flush=True)
    heads = (
        "| study | level | random w | outside X; U: nominal | tightened | vertex sequences | nominal | tightened |",
        "| study | outside X on the real plant: nominal | tightened | allowed |",
        "| study | return, model | price | return, real plant | price | volume left of X_fea | of it with a plan |",
        "| study | level | left most (worst step; allowed): quantiles | edge: nominal | quantiles "
        "| normal | edge: nominal | normal |",
        "| study | return, real plant | price: tube | quantiles | normal | with a plan: tube | quantiles | normal |",
    )
    for head, lines in zip(heads, rows):
        print("\n".join([head, "|---" * (head.count("|") - 1) + "|", *lines, ""]))


if __name__ == "__main__":
    main(sys.argv[1:] or STUDIES)
