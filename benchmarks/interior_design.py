"""A quarter car whose best design lies inside the box, against the nested optimum of the exact LQR cost.

Spring, damper and mass of the wheel are designed; light wheels, and dampers and springs away from those of the
catalogue, cost money. The cost of LQR at a design is computed exactly from the means and covariances of the loop, with
`scipy.linalg.expm` and SciPy's Riccati solver alone, and minimised over the box by SciPy.

``python benchmarks/interior_design.py [SEED ...]`` prints a row for every seed: the design beside the oracle's in parts
of the box (required: 2 %), and its return, measured on 4000 runs, beside that of LQR at the oracle's design on the same
runs (required: 0.3 %).
"""

from __future__ import annotations

import sys

import casadi as ca
import numpy as np
import torch
from scipy.linalg import expm, solve_discrete_are
from scipy.optimize import minimize

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    LearnedPolicy,
    LinearFeedback,
    Plant,
    QuadraticObjective,
    codesign,
    discretise,
    simulate,
)
from ccdtools.co_design import expert_dataset
from learning import fit_actor_critic

SPRUNG, TYRE = 325.0, 232.5e3  # kg, N/m
DT, STEPS, ROAD = 0.01, 200, 0.3  # s, –, m/s
LOWER, UPPER = np.array([1e4, 500.0, 40.0]), np.array([4e4, 3000.0, 100.0])
CATALOGUE = np.array([2.4e4, 1500.0, 85.0])  # spring, damper and wheel that are cheapest
PRICE = np.array([120.0, 100.0, 100.0])  # of a design that lies a whole range away from them
Q = np.diag([1e4, 0.0, 400.0, 25.0])  # a tyre deflection of 10 mm, a travel of 50 mm and a body at 0.2 m/s count alike
R = np.array([[1 / 500.0**2]])
X0 = np.array([0.0, 0.0, 0.04, 0.0])
STARTS = ([1e4, 500.0, 40.0], [4e4, 3000.0, 100.0], [1e4, 3000.0, 100.0], [4e4, 500.0, 40.0], [2.5e4, 1000.0, 60.0])


def design_cost(p):
    """What a design costs, in units of the return: of CasADi columns and arrays alike."""
    away = [(p[i] - CATALOGUE[i]) / (UPPER[i] - LOWER[i]) for i in range(3)]
    return sum(price * part**2 for price, part in zip(PRICE, away))


def problem() -> CoDesignProblem:
    """The co-design problem."""
    x, u, w, p = ca.SX.sym("x", 4), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 3)
    lift = u - p[0] * x[2] - p[1] * (x[3] - x[1])
    dynamics = ca.vertcat(x[1] - w, (-TYRE * x[0] - lift) / p[2], x[3] - x[1], lift / SPRUNG)
    space = DesignSpace(["k_s", "c_s", "m_us"], LOWER, UPPER, ["N/m", "N·s/m", "kg"])
    return CoDesignProblem(
        discretise(Plant(x, u, w, p, dynamics, space, dt=DT)), ([-0.1, -6, -0.3, -3], [0.1, 6, 0.3, 3]), (-5e3, 5e3),
        QuadraticObjective(Q, R, design_cost=design_cost), FixedStart(X0, Gaussian([ROAD])), STEPS,
    )  # fmt: skip


def exact(p: np.ndarray) -> tuple[float, np.ndarray]:
    """Expected cost of an episode of LQR at a design, with the price of the design; and the gain."""
    k, c, m = p
    s = SPRUNG
    A = np.array([[0, 1, 0, 0], [-TYRE / m, -c / m, k / m, c / m], [0, -1, 0, 1], [0, c / s, -k / s, -c / s]])
    B = np.array([[0, -1 / m, 0, 1 / s]]).T
    E = np.array([[-1.0, 0, 0, 0]]).T
    M = expm(DT * np.block([[A, B, E], [np.zeros((2, 6))]]))
    Ad, Bd, Ed = M[:4, :4], M[:4, 4:5], M[:4, 5:]
    scale = np.diag([0.01, 1.0, 0.05, 0.2])  # states in comparable units: Riccati equations like that
    inverse = np.linalg.inv(scale)
    a, b = inverse @ Ad @ scale, 500 * inverse @ Bd
    P = solve_discrete_are(a, b, scale @ Q @ scale, 500**2 * R)
    K = 500 * np.linalg.solve(500**2 * R + b.T @ P @ b, b.T @ P @ a) @ inverse
    second = np.outer(X0, X0)
    cost = 0.0
    loop = Ad - Bd @ K
    for _ in range(STEPS):
        cost += np.trace(K.T @ R @ K @ second)
        second = loop @ second @ loop.T + ROAD**2 * Ed @ Ed.T
        cost += np.trace(Q @ second)
    return cost + float(design_cost(p)), K


def oracle() -> tuple[np.ndarray, float, np.ndarray]:
    """The best design, its exact cost and its LQR gain."""
    found = [
        minimize(lambda v: exact(LOWER + v * (UPPER - LOWER))[0], start, bounds=[(0, 1)] * 3, method="L-BFGS-B")
        for start in np.random.default_rng(0).random((8, 3))
    ]
    best = min(found, key=lambda one: one.fun)
    design = LOWER + best.x * (UPPER - LOWER)
    return design, float(best.fun), exact(design)[1]


def codesigned(seed: int) -> tuple[np.ndarray, LearnedPolicy, str]:
    """Design, policy and status that one seed finds from its own start."""
    own = problem()
    rng = np.random.default_rng(seed)
    data = expert_dataset(own, samples=1000, rng=rng)
    agent = fit_actor_critic(
        data.inputs, data.actions, data.values, action_bounds=own.input_bounds, input_bounds=own.observation_bounds,
        rng=rng,
    )  # fmt: skip
    result = codesign(own, agent=agent, design=STARTS[seed % len(STARTS)], rng=rng)
    return np.asarray(result.design), result.policy, result.status.name


def main(seeds: list[int]) -> None:
    """Print the table."""
    torch.set_num_threads(1)
    own = problem()
    best, cost, K = oracle()
    print(f"oracle: {own.design.describe(best)}, exact return {-cost:.4f}, price {float(design_cost(best)):.3f}")
    x0, w = own.scenarios.sample(4000, STEPS, np.random.default_rng(12345))
    reference = simulate(own.model, LinearFeedback(K), x0=x0, steps=STEPS, disturbance=w, design=best)
    there = reference.returns(own.objective)
    print(f"LQR there on 4000 runs: {there.mean():.4f}")
    print("| seed | design | off, parts of the box | return | minus the oracle's | status |\n|---|---|---|---|---|---|")
    for seed in seeds:
        design, policy, status = codesigned(seed)
        off = np.abs(own.design.to_unit(design) - own.design.to_unit(best))
        run = simulate(own.model, policy, x0=x0, steps=STEPS, disturbance=w, design=design, limit=own.limit)
        value = run.returns(own.objective)
        gain = (value.mean() - there.mean()) / abs(there.mean())
        print(f"| {seed} | {own.design.describe(design)} | {100 * off.max():.2f} % | {value.mean():.4f} | "
              f"{100 * gain:+.3f} % | {status} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main([int(s) for s in sys.argv[1:]] or [0, 1, 2, 3, 4])
