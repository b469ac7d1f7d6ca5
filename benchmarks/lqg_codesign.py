"""LQG co-design beside two Riccati equations of SciPy and its differential evolution.

    python benchmarks/lqg_codesign.py [--only suspension] [--seed 0]

Every other state is measured, with noise of a fiftieth, a tenth and a half of its range; disturbances are white, with
the spread of the study's own; episodes have 500 samples; a price pulls the design away from the corner that LQR alone
would choose, by as much as the episode at the centre costs. The reference knows nothing of the package but the model's
matrices: tr(P W) + tr(Kᵀ (R + Bᵀ P B) K Σ) a step, searched globally. What is compared is that formula at both designs;
beside it what nested LQR, which takes the state as known, loses in the same loop.
"""

from __future__ import annotations

import argparse
import time
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.linalg import solve_discrete_are
from scipy.optimize import differential_evolution

from ccdtools import CoDesignProblem, FixedStart, Gaussian, Measurement, Nested, codesign, load_study

PLANTS = (
    "dc_servo", "suspension", "mass_chain", "wind_turbine", "illustrative", "quarter_car", "half_car", "two_tanks",
)  # fmt: skip
STEPS = 500


def noisy(name: str, part: float) -> CoDesignProblem:
    """Problem of a study whose every other state is measured."""
    problem = load_study(name).problem()
    w = problem.scenarios.sample(200, problem.steps, np.random.default_rng(0))[1]
    C = np.eye(problem.model.nx)[::2]
    box = problem.design
    nothing = replace(problem.objective, design_cost=None)
    free = replace(problem, objective=nothing, limit_tolerance="off", warm_up=0)
    corner = codesign(free, method=Nested("riccati", starts=1), rng=np.random.default_rng(0))
    away = 0.8 - 0.6 * np.round(box.to_unit(corner.design))
    target, size = box.from_unit(away), abs(corner.objective)
    width = np.where(box.free, box.upper - box.lower, 1.0)

    def price(p: Any) -> Any:
        """Price of the distance from a point near the other corner."""
        return size * sum((p[i] - target[i]) ** 2 / width[i] ** 2 for i in range(box.dim))

    spread = w.reshape(-1, w.shape[2]).std(axis=0)
    return replace(
        free, objective=replace(nothing, design_cost=price, episode=STEPS), steps=STEPS,
        scenarios=FixedStart(np.zeros(problem.model.nx), Gaussian(spread)),
        measurement=Measurement(C, noise=part * C @ np.ravel(problem.state_scale)),
    )  # fmt: skip


def by_traces(problem: CoDesignProblem, p: np.ndarray, part: float) -> float:
    """Cost of an episode in the long run, by two Riccati equations of SciPy."""
    A, B, E = problem.model.matrices(p)
    weights = problem.weights(p)
    S = np.zeros(B.shape) if weights.S is None else weights.S
    C = np.eye(len(A))[::2]
    V = np.diag((part * C @ np.ravel(problem.state_scale)) ** 2)
    W = E @ problem.moments[2] @ E.T
    try:
        P = solve_discrete_are(A, B, weights.Q, weights.R, s=S)
        N = solve_discrete_are(A.T, C.T, W, V)
    except (np.linalg.LinAlgError, ValueError):
        return np.inf
    H = weights.R + B.T @ P @ B
    K = np.linalg.solve(H, B.T @ P @ A + S.T)
    after = N - N @ C.T @ np.linalg.solve(C @ N @ C.T + V, C @ N)
    steps = STEPS * (np.trace(P @ W) + np.trace(K.T @ H @ K @ after))
    return float(steps + problem.objective.cost_of_design(p, STEPS))


def row(name: str, part: float, seed: int) -> str:
    """Line of the table."""
    problem = noisy(name, part)
    began = time.process_time()
    ours: Any = codesign(problem, method=Nested("lqg"), rng=np.random.default_rng(seed))
    took = time.process_time() - began
    lqr: Any = codesign(problem, method=Nested("riccati"), rng=np.random.default_rng(seed))
    box = problem.design

    def cost(v: np.ndarray) -> float:
        """Cost at a point of the unit box."""
        p = box.from_unit(v)
        return by_traces(problem, p, part) if box.violation(p[None])[0] <= 1e-9 else 1e30

    best = differential_evolution(cost, [(0.0, 1.0)] * box.dim, seed=seed, tol=1e-8, popsize=12, maxiter=150)
    excess, known = (100 * (by_traces(problem, one.design, part) / best.fun - 1) for one in (ours, lqr))
    return f"| {name} | {part:g} | {excess:.4f} | {known:.2f} | {ours.status.value} | {ours.evaluations} | {took:.1f} |"


def main() -> None:
    """Print a row per plant and noise."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=PLANTS)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    print("| plant | noise, of the range | above the best, % | nested LQR above it, % | status | evaluations | s |")
    print("|---|---|---|---|---|---|---|")
    for name in PLANTS if asked.only is None else (asked.only,):
        for part in (0.02, 0.1, 0.5):
            print(row(name, part, asked.seed), flush=True)


if __name__ == "__main__":
    main()
