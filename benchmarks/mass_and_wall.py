"""A mass that bounces off a wall: what the gradient through the model finds, where it is blind, beside the optimum.

    python benchmarks/mass_and_wall.py [--seeds 5] [--case 0] [--methods pathwise ppo]

The mass flies towards a wall behind its target and may use it as a brake. At the bounce the speed jumps, which no
derivative through the model sees. The optimum is that of dynamic programming over position, speed and time, on a grid
of its own (bilinear values, five quadrature points of the disturbance), measured in closed loop like everything else:
4000 runs, the same for all. Beside it stands the usual network that is fitted to its law: what a smooth
policy can do of it. Nothing was developed on the fourth case.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import time
import warnings
from dataclasses import dataclass

import casadi as ca
import numpy as np
import torch
from scipy.ndimage import map_coordinates

from ccdtools import (
    CoDesignConfig,
    CoDesignProblem,
    DesignSpace,
    Gaussian,
    LearnedPolicy,
    Plant,
    QuadraticObjective,
    RandomStarts,
    closed_loop_returns,
    codesign,
    discretise,
    saturated_lqr,
)  # fmt: skip
from ccdtools.co_design.differentiable_model import scenario_tensors
from ccdtools.disturbances import Uniform
from learning import CloningConfig, fit_actor_critic

DT, STEPS, RUNS, SCENARIOS, DESIGN = 0.1, 60, 4000, 7, [1.0]


@dataclass(frozen=True)
class Case:
    """Place of the wall, restitution, largest force, its weight, standard deviation of the disturbance, and starts."""

    wall: float = -0.5
    restitution: float = 0.8
    force: float = 3.0
    weight: float = 0.5
    push: float = 0.3
    lower: tuple[float, float] = (1.5, -4.0)
    upper: tuple[float, float] = (3.0, -2.0)

    def problem(self) -> CoDesignProblem:
        """Problem of the library, its design frozen by the methods."""
        x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("m")
        pull = u / p + w
        q, v = x[0] + DT * x[1] + DT**2 / 2 * pull, x[1] + DT * pull
        hit = q < self.wall
        after = ca.vertcat(ca.if_else(hit, 2 * self.wall - q, q), ca.if_else(hit, -self.restitution * v, v))
        space = DesignSpace(["m"], [0.5], [2.0], ["kg"])
        box, U = ([-5, -8], [5, 8]), (-self.force, self.force)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the jump, which is the point here
            model = discretise(Plant(x, u, w, p, after, space, dt=DT, continuous=False), X=box, U=U)
        objective = QuadraticObjective(np.diag([1.0, 0.1]), [[self.weight]])
        starts = RandomStarts(Uniform(self.lower, self.upper), Gaussian([self.push]))
        return CoDesignProblem(model, X=box, U=U, objective=objective, scenarios=starts, steps=STEPS)


class Optimum:
    """Dynamic programming on a grid of positions and speeds, backwards in time."""

    def __init__(self, case: Case, points: int = 241, forces: int = 61) -> None:
        self.case = case
        self.axes = np.linspace(case.wall, 6, points), np.linspace(-9, 9, points)
        q, v = np.meshgrid(*self.axes, indexing="ij")
        nodes, weights = np.polynomial.hermite_e.hermegauss(5)
        cost, self.laws = np.zeros_like(q), []
        for _ in range(STEPS):
            best, law = np.full_like(q, np.inf), np.zeros_like(q)
            for u in np.linspace(-case.force, case.force, forces):
                total = np.full_like(q, case.weight * u**2)
                for node, weight in zip(nodes, weights / weights.sum()):
                    after = self.moved(q, v, u + case.push * node)
                    total += weight * (after[0] ** 2 + 0.1 * after[1] ** 2 + self.read(cost, *after))
                law, best = np.where(total < best, u, law), np.minimum(total, best)
            cost = best
            self.laws.insert(0, law)

    def moved(self, q, v, pull):
        """Position and speed after a sample."""
        q, v = q + DT * v + DT**2 / 2 * pull, v + DT * pull
        hit = q < self.case.wall
        return np.where(hit, 2 * self.case.wall - q, q), np.where(hit, -self.case.restitution * v, v)

    def read(self, values, q, v):
        """Values between the points of the grid."""
        places = [(x - axis[0]) / (axis[1] - axis[0]) for x, axis in zip((q, v), self.axes)]
        return map_coordinates(values, places, order=1, mode="nearest")

    def returns(self) -> np.ndarray:
        """Returns in closed loop, on the scenarios that every controller meets."""
        case = self.case
        x0, pushes = scenario_tensors(case.problem(), RUNS, np.random.default_rng(SCENARIOS))
        (q, v), total = x0.double().numpy().T, np.zeros(RUNS)
        for k, law in enumerate(self.laws):
            u = self.read(law, q, v)
            q, v = self.moved(q, v, u + pushes[:, k, 0].double().numpy())
            total -= q**2 + 0.1 * v**2 + case.weight * u**2
        return total

    def imitated(self, steps: int = 10_000) -> LearnedPolicy:
        """Policy of the usual network that is fitted to the law of the first sample, on the states of 1000 runs."""
        case = self.case
        x0, pushes = scenario_tensors(case.problem(), 1000, np.random.default_rng(SCENARIOS + 1))
        (q, v), seen, inputs = x0.double().numpy().T, [], []
        for k in range(STEPS):
            u = self.read(self.laws[0], q, v)
            seen.append(np.stack([q, v, np.full_like(q, DESIGN[0])], axis=1))
            inputs.append(u[:, None])
            q, v = self.moved(q, v, u + pushes[:, k, 0].double().numpy())
        actor = fit_actor_critic(
            np.concatenate(seen), np.concatenate(inputs), np.zeros(1000 * STEPS),
            action_bounds=([-case.force], [case.force]), rng=np.random.default_rng(0),
            config=CloningConfig(steps=steps),
        )  # fmt: skip
        return LearnedPolicy(actor, DESIGN)


CASES = (
    Case(),
    Case(wall=-0.2, restitution=0.6, force=6.0, weight=0.1, push=0.6),
    Case(wall=-1.0, restitution=0.9, force=2.0, weight=0.3, push=0.2, lower=(0.5, -5.0), upper=(2.0, -3.0)),
    Case(wall=-0.4, restitution=0.5, force=4.0, weight=0.05, push=0.4, lower=(1.0, -6.0), upper=(2.5, -3.0)),
)


def main() -> None:
    """Print a row per case, method and seed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--methods", nargs="+", default=["pathwise", "ppo"])
    parser.add_argument("--case", type=int, choices=range(len(CASES)))
    asked = parser.parse_args()
    torch.set_num_threads(1)
    for number, case in enumerate(CASES):
        if asked.case not in (None, number):
            continue
        problem, programme = case.problem(), Optimum(case)
        optimum = programme.returns()
        best = float(optimum.mean())

        def mean(controller, problem=problem) -> float:
            found = closed_loop_returns(problem, controller, DESIGN, rng=np.random.default_rng(SCENARIOS), runs=RUNS)
            return float(found.values.mean())

        print(f"{case}\ndynamic programming {best:.3f} ± {2 * optimum.std() / RUNS**0.5:.3f}")
        print(f"saturated LQR {mean(saturated_lqr(problem, DESIGN)):.3f}", flush=True)
        copied = mean(programme.imitated())
        print(
            f"a network fitted to the optimum {copied:.3f}, {100 * (best - copied) / abs(best):.2f} % below", flush=True
        )
        for method in asked.methods:
            for seed in range(asked.seeds):
                start = time.process_time()
                config = CoDesignConfig(design_rate=0.0)
                rng = np.random.default_rng(seed)
                found = codesign(problem, method=method, rng=rng, config=config, design=DESIGN)
                value = mean(LearnedPolicy(found.agent, DESIGN))
                print(
                    f"{method:8s} seed {seed}  {value:8.3f}  {100 * (best - value) / abs(best):+5.2f} % below  "
                    f"{found.status.name:18s} handed out by {found.method}  {time.process_time() - start:4.0f} s",
                    flush=True,
                )


if __name__ == "__main__":
    main()
