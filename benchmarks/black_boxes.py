"""Designs of ten plants that are hidden behind a simulator, beside their optimum.

    python benchmarks/black_boxes.py [--only suspension] [--methods search nested]

The package is given nothing but the step of each plant, a `BlackBox`, with the limits, the cost and the scenarios of
its study. The reference simulates the open plant with the gain of SciPy's Riccati equation, clipped to the limits of
the inputs, on runs of its own, and searches the box by SciPy's differential evolution. What is compared is that return,
at the design found and at the best one.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
from scipy.linalg import solve_discrete_are
from scipy.optimize import differential_evolution

from ccdtools import CoDesignProblem, codesign, load_study
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


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=PLANTS)
    parser.add_argument("--methods", nargs="*", default=["search", "nested"])
    given = parser.parse_args()
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
