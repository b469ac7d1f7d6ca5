"""Swing-ups, where LQR brings nothing to rest: nonlinear MPC, a policy that imitates it, and learned co-designs.

    python benchmarks/swing_up.py [pendulum] [cart] [--by pathwise ppo]

A pendulum with Gymnasium's numbers (torque 2 N·m, cost of its Pendulum-v1) whose length is designed, and the library's
pole on a cart; both hang nearly straight down at first. At two designs of the box: the return of nonlinear MPC that
looks ahead over an episode, at most 100 steps; of the policy that `Learned` begins with, which imitates it; and the
time of a step of both. Then `codesign` with its defaults from the first design. One thread.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from typing import Any

import casadi as ca
import numpy as np
import torch

from ccdtools import (
    CoDesignProblem,
    CustomObjective,
    DesignSpace,
    FixedStart,
    Gaussian,
    LearnedPolicy,
    Plant,
    closed_loop_returns,
    codesign,
    discretise,
    saturated_lqr,
)
from ccdtools.co_design.imitation import EXPERTS, best_expert, planned_start
from ccdtools.plants.library import pendulum_on_cart

RUNS, ONLINE = 200, 8  # runs of laws, and of MPC


def wrapped(angle: Any) -> Any:
    """Angle from upright, within ± π."""
    return ca.atan2(ca.sin(angle), ca.cos(angle))


def pendulum() -> CoDesignProblem:
    """Rod of 1 kg and 0.8 to 1.25 m."""
    x, u, w, length = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("l")
    rate = ca.vertcat(x[1], 15 / length * ca.sin(x[0]) + 3 / length**2 * u + w)
    plant = Plant(x, u, w, length, rate, DesignSpace(["l"], [0.8], [1.25], ["m"]), dt=0.05)

    def cost(x: Any, u: Any, p: Any) -> Any:
        """Cost of Pendulum-v1."""
        return wrapped(x[0]) ** 2 + 0.1 * x[1] ** 2 + 0.001 * u[0] ** 2

    X, U = ([-12, -8], [12, 8]), (-2, 2)
    return CoDesignProblem(
        discretise(plant, X=X, U=U, W=(-0.2, 0.2), compiled=True), X=X, U=U, steps=200, limit_tolerance="off",
        objective=CustomObjective(cost, Q=np.diag([1, 0.1]), R=[[0.001]]),
        scenarios=FixedStart([3.0, 0.0], Gaussian([0.05])),
    )  # fmt: skip


def cart() -> CoDesignProblem:
    """Pole on a cart, 40 ms a sample, 10 N."""

    def cost(x: Any, u: Any, p: Any) -> Any:
        """Place, angle and force."""
        return x[0] ** 2 + 0.1 * x[1] ** 2 + 5 * wrapped(x[2]) ** 2 + 0.1 * x[3] ** 2 + 0.01 * u[0] ** 2

    X, U = ([-3, -8, -8, -20], [3, 8, 8, 20]), (-10, 10)
    return CoDesignProblem(
        discretise(pendulum_on_cart(dt=0.04), X=X, U=U, accuracy=1e-3, compiled=True), X=X, U=U, steps=120,
        limit_tolerance="off", objective=CustomObjective(cost, Q=np.diag([1, 0.1, 5, 0.1]), R=[[0.01]]),
        scenarios=FixedStart([0, 0, 3.0, 0], Gaussian([0.02])),
    )  # fmt: skip


CASES: dict[str, tuple[Callable[[], CoDesignProblem], list[list[float]]]] = {
    "pendulum": (pendulum, [[1.0], [0.85]]), "cart": (cart, [[0.5, 0.5], [1.0, 1.0]]),
}  # fmt: skip


def rows(problem: CoDesignProblem, designs: list[list[float]]) -> Iterator[str]:
    """Returns at each design."""
    for p in designs:
        began = time.process_time()
        agent = planned_start(problem, np.array(p), np.random.default_rng(0)).agent
        seconds = time.process_time() - began
        mpc: Any = EXPERTS[best_expert(problem, np.array(p), np.random.default_rng(1))](problem, p)
        policy = LearnedPolicy(agent, p)
        found = {}
        for name, law, runs in (("LQR", saturated_lqr(problem, p), RUNS), ("MPC", mpc, ONLINE), ("", policy, RUNS)):
            begun = time.process_time()
            found[name] = closed_loop_returns(problem, law, p, np.random.default_rng(5), runs=runs)
            if name == "MPC":
                step = (time.process_time() - begun) / (ONLINE * problem.steps)
        few = found[""].values[:ONLINE].mean() / found["MPC"].values.mean() - 1
        x = np.zeros(problem.model.nx)
        begun = time.process_time()
        for _ in range(1000):
            policy(x)
        own = (time.process_time() - begun) / 1000
        yield (
            f"| {problem.design.describe(np.array(p))} | {found['LQR'].summary.mean:.4g} | "
            f"{found['MPC'].summary.mean:.4g} | {found[''].summary.mean:.4g} | {-100 * few:+.2f} % | "
            f"{1e3 * step:.2f} ms, {1e6 * own:.0f} µs | {seconds:.0f} s |"
        )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=[*CASES])
    parser.add_argument("--by", nargs="*", default=["pathwise", "ppo"])
    parser.add_argument("--seeds", type=int, default=1)
    given = parser.parse_args()
    torch.set_num_threads(1)
    for name in given.cases:
        make, designs = CASES[name]
        problem = make()
        print(
            f"\n{name}: | design | LQR | MPC | imitation | beside MPC, same runs | a step | imitated in |", flush=True
        )
        for row in rows(problem, designs):
            print(row, flush=True)
        for method in given.by:
            for seed in range(given.seeds):
                begun = time.process_time()
                result = codesign(problem, method=method, design=designs[0], rng=np.random.default_rng(seed))
                print(f"{method}, seed {seed}: {time.process_time() - begun:.0f} s", *result.describe(), sep="\n  ")


if __name__ == "__main__":
    main()
