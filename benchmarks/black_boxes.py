"""Designs of ten plants that are hidden behind a simulator, beside their optimum.

    python benchmarks/black_boxes.py [--only suspension] [--methods search nested] [--scores SEEDS]

The package is given nothing but the step of each plant, a `BlackBox`, with the limits, the cost and the scenarios of
its study. The reference simulates the open plant with the gain of SciPy's Riccati equation, clipped to the limits of
the inputs, on runs of its own, and searches the box by SciPy's differential evolution. What is compared is that return,
at the design found and at the best one. `--scores` compares gradients of a distribution of designs instead, by its
score function, with CMA-ES on the same function, from random starts.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
from scipy.linalg import solve_discrete_are
from scipy.optimize import differential_evolution

from ccdtools import CoDesignProblem, Search, codesign, load_study
from ccdtools.plants import BlackBox

PLANTS = (
    "dc_servo", "suspension", "mass_chain", "wind_turbine", "illustrative", "quarter_car", "half_car", "two_tanks",
    "pendulum_on_cart", "quarter_car_nonlinear",
)  # fmt: skip
RUNS = 24


def hidden(problem: CoDesignProblem) -> CoDesignProblem:
    """The same problem, of whose plant only a step is known."""
    model, steps = problem.model, {}

    def advance(x, u, w, p):
        """States (n, nx) one sample later."""
        if p.tobytes() not in steps:
            steps.clear()
            steps[p.tobytes()] = model.stepper(p, batch=len(x))
        return steps[p.tobytes()](x, u, w)

    box = BlackBox(advance, nx=model.nx, nu=model.nu, nw=model.nw, dt=model.dt, design=problem.design, batched=True)
    return replace(problem, model=box)


def returned(problem: CoDesignProblem, p: np.ndarray, x0: np.ndarray, w: np.ndarray) -> float:
    """Mean return of clipped LQR at a design, by a loop of our own."""
    A, B, _ = problem.model.matrices(p)
    cost = problem.weights(p)
    S = np.zeros_like(B) if cost.S is None else cost.S
    P = solve_discrete_are(A, B, cost.Q, cost.R, s=S)
    K = np.linalg.solve(cost.R + B.T @ P @ B, B.T @ P @ A + S.T)
    low, high = problem.input_bounds_at(p)
    step = problem.model.stepper(p, batch=len(x0))
    x, total = x0, np.zeros(len(x0))
    for k in range(w.shape[1]):
        u = np.clip(-x @ K.T, low, high)
        after = step(x, u, w[:, k])
        total += np.asarray(problem.objective.rewards(after, u, x, p))
        x = after
    final = problem.objective.final_rewards(x, p)
    total = total if final is None else total + np.asarray(final)
    value = float(total.mean()) - float(problem.cost_of_design(p))
    return value if np.isfinite(value) else -np.inf


def by_scores(cost, start: np.ndarray, rng: np.random.Generator, evaluations: int = 300, pairs: int = 6) -> np.ndarray:
    """Mean of a normal distribution over the box, by score-function gradients of its mean and spread.

    Antithetic pairs, on common random numbers, with ranks in the place of costs and the rates of natural evolution
    strategies (Wierstra et al., JMLR 2014, separable).
    """
    mean, spread = start.copy(), np.full(len(start), 0.25)
    rate = (3 + np.log(len(start))) / (5 * np.sqrt(len(start)))
    for _ in range(evaluations // (2 * pairs)):
        half = rng.standard_normal((pairs, len(start)))
        drawn = np.concatenate([half, -half])
        costs = [cost(np.clip(mean + spread * z, 0, 1)) for z in drawn]
        rank = np.empty(len(drawn))
        rank[np.argsort(costs)] = np.arange(len(drawn))
        use = np.maximum(0, np.log(len(drawn) / 2 + 1) - np.log(rank + 1))
        use = use / use.sum() - 1 / len(drawn)
        mean = np.clip(mean + spread * (use @ drawn), 0, 1)
        spread = spread * np.exp(rate / 2 * (use @ (drawn**2 - 1)))
    return mean


def scores_beside_search(name: str, seed: int) -> None:
    """Print a row: how far both end below the best of both and of differential evolution."""
    problem = replace(load_study(name).problem(), limit_tolerance="off")
    box, rng = problem.design, np.random.default_rng([seed, 5])
    x0, w = problem.scenarios.sample(RUNS, problem.steps, np.random.default_rng(7))
    start = box.to_unit(box.latin_hypercube(1, rng)[0])

    def at(v):
        """Cost of a point of the unit box."""
        p = box.settled(box.allowed.rounded(np.asarray(v)))
        return -returned(problem, p, x0, w) if box.feasible(p[None])[0] else np.inf

    best = differential_evolution(at, [(0.0, 1.0)] * box.dim, seed=0, popsize=8, maxiter=20, polish=False).fun
    found = codesign(
        problem, method=Search(of=lambda p: returned(problem, p, x0, w)), design=box.from_unit(start), rng=rng
    )
    ends = at(by_scores(at, start, rng)), at(box.to_unit(found.design))
    scores, search = (100 * (end - best) / abs(best) for end in ends)
    print(f"| {name} | {seed} | {scores:.3f} | {search:.3f} |", flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=PLANTS)
    parser.add_argument("--methods", nargs="*", default=["search", "nested"])
    parser.add_argument("--scores", type=int, default=0, help="random starts")
    given = parser.parse_args()
    if given.scores:
        print("| plant | start | score gradients, % below the best | CMA-ES |\n|---|---|---|---|")
        for name in given.only:
            for seed in range(given.scores):
                scores_beside_search(name, seed)
        return
    print("| plant | method | below the best, % | status | evaluations | time, s |\n|---|---|---|---|---|---|")
    for name in given.only:
        problem = replace(load_study(name).problem(), limit_tolerance="off")
        box = problem.design
        x0, w = problem.scenarios.sample(RUNS, problem.steps, np.random.default_rng(7))

        def cost(v, problem=problem, x0=x0, w=w):
            """Cost of a point of the unit box."""
            p = problem.design.settled(problem.design.allowed.rounded(np.asarray(v)))
            return -returned(problem, p, x0, w) if problem.design.feasible(p[None])[0] else np.inf

        found = differential_evolution(cost, [(0.0, 1.0)] * box.dim, seed=0, popsize=8, maxiter=20, polish=False)
        for method in given.methods:
            began = time.perf_counter()
            result = codesign(hidden(problem), method=method, rng=np.random.default_rng(0))
            seconds = time.perf_counter() - began
            own = returned(problem, result.design, x0, w)
            short = 100 * (-found.fun - own) / abs(found.fun)
            print(f"| {name} | {method} | {short:.3f} | {result.status.name.lower().replace('_', ' ')} "
                  f"| {result.evaluations} | {seconds:.0f} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
