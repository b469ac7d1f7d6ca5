"""A servo whose speed limit binds, against MPC that knows the limit.

``python benchmarks/speed_limit.py [SEED ...]`` prints a row for every seed: the fraction of the states beyond the limit
(required: at most what was stated), and the return beside that of MPC at the same design, whose own limit is set so
that it lies beyond the real one as often (required: within 2 %). 1000 fresh runs, MPC 100 of them.
"""

from __future__ import annotations

import sys

import numpy as np
import torch

from ccdtools import (
    CoDesignProblem,
    FixedStart,
    Gaussian,
    QuadraticObjective,
    codesign,
    discretise,
    excursions,
    saturated_lqr,
    simulate,
)
from ccdtools.co_design import expert_dataset
from ccdtools.controllers.controllers import Controller
from ccdtools.plants.library import dc_servo
from ccdtools.trajectory import Trajectory
from invariant_sets import Polytope
from learning import fit_actor_critic
from mpc import LinearMPC

SPEED = 4.0  # rad/s
STATED = (0.01, 0.02)  # fraction of the states beyond it, and half-widths of the mean peak
STEPS, HORIZON, X0 = 100, 40, [1.0, 0.0]


def problem() -> CoDesignProblem:
    """The co-design problem: gear ratio and flywheel, from rest one radian away."""
    return CoDesignProblem(
        discretise(dc_servo()), Polytope.from_bounds([-2, -SPEED], [2, SPEED]), (-24.0, 24.0),
        QuadraticObjective(np.diag([100.0, 0.01]), [[0.01]]), FixedStart(X0, Gaussian([0.05])), STEPS,
        limit_tolerance=STATED,
    )  # fmt: skip


def driven(own: CoDesignProblem, law: Controller, design, runs: int) -> Trajectory:
    """Fresh runs, the same for every law."""
    x0, w = own.scenarios.sample(1000, STEPS, np.random.default_rng(2024))
    return simulate(own.model, law, x0=x0[:runs], steps=STEPS, disturbance=w[:runs], design=design, limit=own.limit)


def outside(own: CoDesignProblem, run: Trajectory) -> float:
    """Fraction of the states beyond the limits."""
    return float(excursions(run.states[:, 1:], own.X).fraction.mean())


def mpc_as_often(own: CoDesignProblem, design, fraction: float) -> tuple[Trajectory, float]:
    """Runs of MPC whose speed limit is moved until it is beyond the real one as often."""
    A, B, _ = own.model.matrices(design)
    weights = own.weights(design).keywords()
    low, high = 0.8 * SPEED, 1.2 * SPEED
    for _ in range(8):
        speed = (low + high) / 2
        mpc = LinearMPC(A, B, **weights, horizon=HORIZON, X=([-2, -speed], [2, speed]), U=own.U)
        run = driven(own, mpc, design, 100)
        low, high = (speed, high) if outside(own, run) <= fraction else (low, speed)
    return run, outside(own, run)


def main(seeds: list[int]) -> None:
    """Print the table."""
    torch.set_num_threads(1)
    own = problem()
    print("| seed | design | status | beyond the limit | saturated LQR | MPC | return, 100 runs | MPC's | difference |")
    print("|---|---|---|---|---|---|---|---|---|")
    for seed in seeds:
        rng = np.random.default_rng(seed)
        data = expert_dataset(own, samples=600, rng=rng)
        agent = fit_actor_critic(
            data.inputs, data.actions, data.values, action_bounds=own.input_bounds,
            input_bounds=own.observation_bounds, rng=rng,
        )  # fmt: skip
        found = codesign(own, agent=agent, design=own.design.from_unit(rng.random(own.design.dim)), rng=rng)
        design = found.design
        learned = driven(own, found.policy, design, 1000)
        fraction = outside(own, learned)
        mpc, often = mpc_as_often(own, design, fraction)
        value, other = learned.returns(own.objective)[:100].mean(), mpc.returns(own.objective).mean()
        lqr = outside(own, driven(own, saturated_lqr(own, design), design, 1000))
        off = (value - other) / abs(other)
        print(f"| {seed} | {own.design.describe(design)} | {found.status.name} | {fraction:.2%} | {lqr:.2%} | "
              f"{often:.2%} | {value:.4g} | {other:.4g} | {off:+.2%} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main([int(s) for s in sys.argv[1:]] or [0, 1, 2])
