"""Policies of measured outputs that imitate an expert, beside LQG on the same runs.

    python benchmarks/output_policies.py [--seeds 3] [--only suspension] [--ppo 300]

Every other state is measured, with noise of a fiftieth of its range. On linear plants with normal disturbances LQG (two
Riccati equations, and the mean and spread of the starts) is the optimum but for the limits; the policy imitates it from
the last 16 outputs and inputs. On the others LQG is that of the linearisation. The expert sees the state of a pendulum
held upright from afar (LQR) and of a mass that bounces off a wall (PPO), the policy does not; that of a quarter car
with a damper between two bounds is the law of its engineers, clipped LQR, behind a cubature Kalman filter. Linear
plants have MPC behind the filter of LQG, too. Gains are in pairs on 2000 fresh runs.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
import torch
from mass_and_wall import Case
from semi_active_damper import SPRING, clipped_lqr, problem as car

from ccdtools import (
    CoDesignProblem,
    CubatureKalmanFilter,
    DesignSpace,
    Gaussian,
    KalmanFilter,
    LearnedPolicy,
    Measurement,
    Plant,
    QuadraticObjective,
    RandomStarts,
    Scenario,
    compare,
    discretise,
    imitate,
    linear_mpc,
    load_study,
    saturated_lqr,
)
from ccdtools.co_design import EpisodeEnv
from ccdtools.controllers import History, Observed
from learning import train

LINEAR = ("dc_servo", "suspension", "mass_chain", "wind_turbine")
OTHERS = ("pendulum", "wall", "damper")


@dataclass(frozen=True)
class Measured:
    """A problem at a design, what is measured of it, its LQG and the expert."""

    problem: CoDesignProblem
    design: list[float]
    lqg: Any
    expert: Callable[[int], Any]  # of a seed
    noise: np.ndarray
    C: np.ndarray
    history: int

    def drawn(self, rng: np.random.Generator, runs: int = 64) -> Scenario:
        """Runs with a measurement."""
        x0, w = self.problem.scenarios.sample(runs, self.problem.steps, rng)
        output = Measurement(self.C, noise=self.noise)
        return Scenario(self.problem.model, x0, np.array(w), output=output, seed=int(rng.integers(2**31)))


def measured(problem: CoDesignProblem, design: list[float], history: int, expert: Any = None) -> Measured:
    """Every other state with noise, and the LQG of that."""
    A, B, E = problem.model.matrices(np.array(design))
    C = np.eye(len(A))[::2]
    noise = C @ np.ravel(problem.state_scale) / 50
    x0, w = map(np.array, problem.scenarios.sample(500, problem.steps, np.random.default_rng(0)))
    least = np.diag((1e-6 * np.ravel(problem.state_scale)) ** 2)
    W = E @ np.diag(w.reshape(-1, E.shape[1]).var(axis=0)) @ E.T + least
    start = {"steady": False, "x0": x0.mean(axis=0), "P0": np.cov(x0.T) + least}  # what is known of the starts
    lqr = saturated_lqr(problem, design)
    lqg = Observed(lqr, KalmanFilter(A, B, C, W, noise**2, **start))
    return Measured(problem, design, lqg, expert or (lambda seed: lqg), noise, C, history)


def pendulum() -> Measured:
    """Pendulum without small angles, held upright."""
    x, u, w, m = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("m")
    dynamics = ca.vertcat(x[1], 9.81 * ca.sin(x[0]) - 0.1 * x[1] + u / m + w)
    plant = Plant(x, u, w, m, dynamics, DesignSpace(["m"], [0.5], [2.0], ["kg"]), dt=0.05)
    box, U = ([-4, -10], [4, 10]), (-20, 20)
    problem = CoDesignProblem(
        discretise(plant, X=box, U=U), X=box, U=U, objective=QuadraticObjective(np.diag([1.0, 0.1]), [[0.01]]),
        scenarios=RandomStarts(Gaussian([0.6, 0.6]), Gaussian([1.0])), steps=60,
    )  # fmt: skip
    return measured(problem, [1.0], 12, lambda seed: saturated_lqr(problem, [1.0]))


def wall() -> Measured:
    """Mass and wall, whose expert is trained."""
    problem = Case().problem()

    def trained(seed: int) -> LearnedPolicy:
        """PPO on the state, 192 000 samples."""
        env = EpisodeEnv(problem, [1.0], rng=np.random.default_rng(seed))
        generator = torch.Generator().manual_seed(seed)
        found = train(env, env.agent(seed=seed), iterations=100, steps=problem.steps, generator=generator)
        return LearnedPolicy(found.agent, [1.0])

    return measured(problem, [1.0], 4, trained)


def damper() -> Measured:
    """Semi-active quarter car of which tyre deflection and travel are measured."""
    problem, p = car(), [SPRING]
    case = measured(problem, p, 12)
    E, scale = problem.model.matrices(np.array(p))[2], np.ravel(problem.state_scale)
    noise = {"W": 0.25**2 * E @ E.T + np.diag((1e-6 * scale) ** 2), "V": case.noise**2, "P0": (1e-3 * scale) ** 2}
    law = Observed(clipped_lqr(SPRING), CubatureKalmanFilter(problem.model, case.C, design=p, **noise))
    return replace(case, expert=lambda seed: law)


def imitated(case: Measured, expert: Any, rounds: int, rng: np.random.Generator) -> Any:
    """Policy that imitates an expert on the outputs."""
    limits = case.problem.input_bounds_at(case.design)
    return imitate(
        expert, case.drawn, objective=case.problem.objective, limits=limits, design=case.design, history=case.history,
        rounds=rounds, rng=rng, limit=case.problem.limit,
    ).controller  # fmt: skip


def by_ppo(case: Measured, updates: int, seed: int) -> History:
    """Policy that PPO learns on the outputs from scratch, without an expert; the last one."""
    sensor = Measurement(case.C, noise=case.noise)
    env = EpisodeEnv(case.problem, case.design, rng=np.random.default_rng(seed), output=sensor, history=case.history)
    generator = torch.Generator().manual_seed(seed)
    found = train(env, env.agent(seed=seed), iterations=updates, steps=case.problem.steps, generator=generator)
    return History(LearnedPolicy(found.agent, case.design), case.history)


def cases(name: str) -> Measured:
    """A case by its name."""
    if name in LINEAR:
        study = load_study(name)
        return measured(study.problem(), list(study.p0), 16)
    return {"pendulum": pendulum, "wall": wall, "damper": damper}[name]()


def main() -> None:
    """Print a row per case and seed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--only", choices=(*LINEAR, *OTHERS))
    parser.add_argument("--ppo", type=int, default=0, help="updates of PPO on the outputs, in the place of imitation")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # the jump of the wall, which is the point there
    for name in (*LINEAR, *OTHERS) if asked.only is None else (asked.only,):
        case, rounds = cases(name), 3 if name in LINEAR else 6
        for seed in range(asked.seeds):
            rng = np.random.default_rng([seed, 1])
            expert = case.expert(seed)
            start = time.process_time()
            policy = by_ppo(case, asked.ppo, seed) if asked.ppo else imitated(case, expert, rounds, rng)
            seconds = time.process_time() - start
            others = {"LQG": case.lqg, "policy": policy, "expert": expert}
            if name in LINEAR:
                others["MPC"] = Observed(linear_mpc(case.problem, case.design), case.lqg.estimator)
            table = compare(
                others,
                case.drawn(np.random.default_rng(10**6), 2000), design=case.design, objective=case.problem.objective,
                X=case.problem.X, limit=case.problem.limit, baseline="LQG",
            )  # fmt: skip
            base, found, own = (table[kind] for kind in ("LQG", "policy", "expert"))
            size = abs(base.summary.mean) / 100
            gain = found.paired_to_lqr
            ends = ", ".join(f"{end / size:+.2f}" for end in gain.ci95)
            mpc = f"MPC {table['MPC'].paired_to_lqr.mean / size:+.2f} %  " if "MPC" in others else ""
            print(
                f"{name:13s} seed {seed}  LQG {base.summary.mean:9.3f}  policy {found.summary.mean:9.3f}  "
                f"{gain.mean / size:+6.2f} % [{ends}]  {mpc}expert {own.summary.mean:9.3f}  lost {found.diverged:.1%} "
                f"({base.diverged:.1%})  "
                f"{1e6 * found.step_time:3.0f} µs (LQG {1e6 * base.step_time:.0f})  {seconds:.0f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
