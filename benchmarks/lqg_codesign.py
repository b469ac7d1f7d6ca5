"""LQG co-design beside two Riccati equations of SciPy and its differential evolution.

    python benchmarks/lqg_codesign.py [--only suspension] [--seed 0] [--learned estimate 12]

Every other state is measured, with noise of a fiftieth, a tenth and a half of its range; disturbances are white, with
the spread of the study's own; episodes have 500 samples; a price pulls the design away from the corner that LQR alone
would choose, by as much as the episode at the centre costs. The reference knows nothing of the package but the model's
matrices: tr(P W) + tr(Kᵀ (R + Bᵀ P B) K Σ) a step, searched globally. What is compared is that formula at both designs;
beside it what nested LQR, which takes the state as known, loses in the same loop.

With `--learned` policies of outputs are learned with the design, of the estimate or of so many last outputs and inputs,
beside nested LQG on the same fresh runs: with noise of a tenth of the range and 150 samples an episode, and on plants
that are not linear. The last two of these were not looked at while the method was made.
"""

from __future__ import annotations

import argparse
import time
import warnings
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import torch
from scipy.linalg import solve_discrete_are
from scipy.optimize import differential_evolution

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    Learned,
    Measurement,
    Nested,
    Plant,
    QuadraticObjective,
    RandomStarts,
    codesign,
    discretise,
    load_study,
)

PLANTS = (
    "dc_servo", "suspension", "mass_chain", "wind_turbine", "illustrative", "quarter_car", "half_car", "two_tanks",
)  # fmt: skip
STEPS = 500


def noisy(name: str, part: float, steps: int = STEPS) -> CoDesignProblem:
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
        free, objective=replace(nothing, design_cost=price, episode=steps), steps=steps,
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


def far_from_rest(dynamics: Any, output: Any, **changes: Any) -> CoDesignProblem:
    """Problem of two states and two free parameters that starts far from rest, whose design has a price."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    box = DesignSpace(["m", "l"], [0.5, 0.5], [2.0, 2.0])
    plant = Plant(x, u, w, p, [x[1], dynamics(x, u, w, p)], box, dt=0.05, outputs=[output(x, p)])
    limits = {"X": ([-4, -10], [4, 10]), "U": (-20, 20)} | changes
    price = lambda p: 8 * ((p[0] - 1) ** 2 + (p[1] - 1) ** 2)  # noqa: E731
    return CoDesignProblem(
        discretise(plant, X=limits["X"], U=limits["U"]), **limits, steps=60, limit_tolerance="off",
        objective=QuadraticObjective(np.diag([1.0, 0.1]), [[0.01]], design_cost=price),
        scenarios=RandomStarts(Gaussian([0.8, 0.8]), Gaussian([1.0])), measurement=Measurement(plant, noise=[0.08]),
    )  # fmt: skip


def swung(x: Any, u: Any, w: Any, p: Any) -> Any:
    """Acceleration of a pendulum held upright."""
    return 9.81 / p[1] * ca.sin(x[0]) - 0.1 * x[1] + u / (p[0] * p[1] ** 2) + w


def stiff(x: Any, u: Any, w: Any, p: Any) -> Any:
    """Acceleration of a mass on a spring that stiffens."""
    return (u - p[1] * (x[0] + x[0] ** 3)) / p[0] - 0.1 * x[1] + w


def pushed(x: Any, u: Any, w: Any, p: Any) -> Any:
    """Acceleration of a mass with drag."""
    return (u - p[1] * x[1] * (1 + x[1] ** 2 / 50)) / p[0] + w


FAR = {
    "pendulum": lambda: far_from_rest(swung, lambda x, p: x[0]),
    "stiff spring": lambda: far_from_rest(stiff, lambda x, p: x[0]),
    "bearing of a mass": lambda: far_from_rest(pushed, lambda x, p: ca.atan(2 * x[0] / p[1])),
    "two_tanks": lambda: noisy("two_tanks", 0.1, 150),
    "pendulum_on_cart": lambda: noisy("pendulum_on_cart", 0.02, 150),
}
LEARNED = (*PLANTS[:4], *FAR)


def learned_row(name: str, seed: int, seen: str) -> str:
    """Line of the table of policies that see the estimate, or so many outputs and inputs."""
    problem = FAR[name]() if name in FAR else noisy(name, 0.1, 150)
    lqg: Any = codesign(problem, method=Nested("lqg"), rng=np.random.default_rng(seed))
    began = time.process_time()
    method = Learned(history=None if seen == "estimate" else int(seen))
    found: Any = codesign(problem, method=method, rng=np.random.default_rng(seed))
    took = time.process_time() - began
    kept = ~(lqg.closed_loop.lost | found.closed_loop.lost)
    behind = (lqg.closed_loop.values - found.closed_loop.values)[kept]
    size = float(problem.made_by_control(lqg.closed_loop.values[kept].mean(), lqg.design)) / 100
    mean, error = behind.mean() / size, 1.96 * behind.std(ddof=1) / np.sqrt(len(behind)) / size
    lost = f"{found.closed_loop.lost_share:.1%}, {lqg.closed_loop.lost_share:.1%}"
    interval = f"{mean:+.2f} [{mean - error:.2f}, {mean + error:.2f}]"
    return f"| {name} | {seen} | {interval} | {lost} | {found.status.name} | {took:.0f} |"


def main() -> None:
    """Print a row per plant and noise."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=(*PLANTS, *FAR))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--learned", nargs="+", metavar="SEEN", help='"estimate", or a number of outputs and inputs')
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    if asked.learned:
        print("| plant | policy sees | nested LQG better by, % | runs lost by it, by LQG | status | s |")
        print("|---|---|---|---|---|---|")
        for name in asked.only or LEARNED:
            for seen in asked.learned:
                print(learned_row(name, asked.seed, seen), flush=True)
        return
    print("| plant | noise, of the range | above the best, % | nested LQR above it, % | status | evaluations | s |")
    print("|---|---|---|---|---|---|---|")
    for name in asked.only or PLANTS:
        for part in (0.02, 0.1, 0.5):
            print(row(name, part, asked.seed), flush=True)


if __name__ == "__main__":
    main()
