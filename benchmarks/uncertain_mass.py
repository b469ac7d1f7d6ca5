"""Co-design on an uncertain mass against co-design for the mean mass, both judged on masses that neither has met.

    python benchmarks/uncertain_mass.py [seed]

The mass differs by up to a fifth either way: a disturbance that is drawn once per run, θ, and that no policy sees.
"""

from __future__ import annotations

import math
import os
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import casadi as ca
import numpy as np
import torch

from ccdtools import (
    CoDesignConfig,
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    Plant,
    QuadraticObjective,
    codesign,
    discretise,
    saturated_lqr,
    simulate,
)
from ccdtools.co_design import CoDesignResult, expert_dataset
from ccdtools.disturbances import Constant, Stacked, Uniform
from ccdtools.statistics import PairedDifference, paired_difference
from learning import CloningConfig, NetworkConfig, fit_actor_critic

PART = 0.2  # of the mass, either way
HELD_OUT = 10_000  # runs, each with a mass of its own: an arm falls seldom, and then it costs a hundred times as much


def tuned_absorber() -> CoDesignProblem:
    """A machine (100 kg, 1.2 Hz) shaken at 1 Hz, with an absorber of 20 kg ± 20 % and an actuator of 10 N between them.

    x = [machine, its speed, absorber, its speed, shaking force, its rate]; the design is the absorber's spring and
    damper. A weakly damped absorber of the right mass cancels the shaking force.
    """
    x, u, w, p = (ca.SX.sym(name, size) for name, size in zip("xuwp", (6, 1, 2, 2)))
    place, speed, other, other_speed, force, rate = ca.vertsplit(x)
    machine, absorber = 100.0, 20.0 * (1 + w[1])
    own, shaken = 2 * math.pi * 1.2, 2 * math.pi * 1.0
    link = p[0] * (other - place) + p[1] * (other_speed - speed) - u
    foundation = machine * (own**2 * place + 0.04 * own * speed)
    dynamics = ca.vertcat(
        speed, (link - foundation + force) / machine, other_speed, -link / absorber, rate,
        w[0] - shaken**2 * force - 0.04 * shaken * rate,
    )  # fmt: skip
    design = DesignSpace(["k", "c"], [300.0, 2.0], [1500.0, 60.0], ["N/m", "N·s/m"])
    half = np.array([0.5, 3.0, 2.0, 12.0, 1000.0, 6000.0])
    return _problem(
        Plant(x, u, w, p, dynamics, design, dt=0.05), X=(-half, half), U=(-10.0, 10.0), noise=1000.0,
        Q=np.diag([100.0, 0.1, 1e-3, 1e-3, 0.0, 0.0]), R=1e-5, x0=np.zeros(6), steps=200,
    )  # fmt: skip


def arm_with_load() -> CoDesignProblem:
    """An arm that holds a load of 1 kg ± 20 % upright with a torque of 1 N·m; its length is the design.

    x = [angle, rate]. The longer the arm, the calmer, until gravity is stronger than the torque.
    """
    x, u, w, p = (ca.SX.sym(name, size) for name, size in zip("xuwp", (2, 1, 2, 1)))
    load = 1.0 + w[1]
    rate = (load * 9.81 * p * ca.sin(x[0]) + u + w[0] - 0.2 * x[1]) / (load * p**2)
    plant = Plant(x, u, w, p, ca.vertcat(x[1], rate), DesignSpace(["l"], [0.2], [1.2], ["m"]), dt=0.05)
    return _problem(
        plant, X=([-1.0, -6.0], [1.0, 6.0]), U=(-1.0, 1.0), noise=0.3, Q=np.eye(2), R=1e-3, x0=[0.12, 0.0], steps=80
    )  # fmt: skip


PLANTS = {"arm, 1 parameter": (arm_with_load, [0.4]), "absorber, 2 parameters": (tuned_absorber, [900.0, 20.0])}


@dataclass(frozen=True)
class Measured:
    """Returns on held-out masses: (designed for the mean mass, on the uncertain one), and what the latter gains."""

    learned: tuple[float, float]
    lqr: tuple[float, float]
    gain: PairedDifference
    of_design: PairedDifference


def for_mean_mass(problem: CoDesignProblem) -> CoDesignProblem:
    """The same with the mean mass alone."""
    noise, _ = problem.scenarios.disturbance.terms  # type: ignore[attr-defined]
    return replace(problem, scenarios=replace(problem.scenarios, disturbance=Stacked((noise, Gaussian([0.0])))))


def found(problem: CoDesignProblem, design, config: CoDesignConfig, seed: int) -> CoDesignResult:
    """Expert data, a clone of it, and the co-design from it."""
    rng = np.random.default_rng(seed)
    data = expert_dataset(problem, samples=300, sets="lqr", rng=rng)
    agent = fit_actor_critic(
        data.inputs, data.actions, data.values, action_bounds=problem.input_bounds,
        input_bounds=problem.observation_bounds, rng=rng, network=NetworkConfig((24, 24)),
        config=CloningConfig(steps=1000, batch=256),
    )  # fmt: skip
    return codesign(problem, agent=agent, design=design, rng=rng, config=config)


def measured(problem: CoDesignProblem, mean: CoDesignResult, robust: CoDesignResult, seed: int) -> Measured:
    """Both on the same fresh masses and noise."""
    x0, w = problem.scenarios.sample(HELD_OUT, problem.steps, np.random.default_rng([seed, 987_654_321]))

    def returns(controller, design):
        """Of every run, one that is lost at what it had cost by then."""
        run = simulate(problem.model, controller, x0=x0, steps=problem.steps, disturbance=w, design=design,
                       limit=problem.limit)  # fmt: skip
        return run.returns(problem.objective)

    learned = [returns(result.policy, result.design) for result in (mean, robust)]
    lqr = [returns(saturated_lqr(problem, result.design), result.design) for result in (mean, robust)]
    return Measured(
        tuple(float(each.mean()) for each in learned), tuple(float(each.mean()) for each in lqr),
        paired_difference(learned[1], learned[0]), paired_difference(lqr[1], lqr[0]),
    )  # fmt: skip


def _problem(plant: Plant, *, X, U, noise: float, Q, R: float, x0, steps: int) -> CoDesignProblem:
    """The problem on the uncertain mass; the model is as accurate for every mass."""
    disturbance = Stacked((Gaussian([noise]), Constant(Uniform([-PART], [PART]))))
    W = ([-4 * noise, -PART], [4 * noise, PART])
    return CoDesignProblem(
        discretise(plant, X=X, U=U, W=W, accuracy=1e-4), X=X, U=U, objective=QuadraticObjective(Q, [[R]]),
        scenarios=FixedStart(x0, disturbance), steps=steps, limit_tolerance="off",
    )  # fmt: skip


def main(seed: int = 0) -> None:
    """Print the table."""
    torch.set_num_threads(1)
    config = CoDesignConfig(iterations=120, pathwise_runs=128)
    for name, (stated, first) in PLANTS.items():
        begun = time.perf_counter()
        problem = stated()
        mean, robust = (found(each, first, config, seed) for each in (for_mean_mass(problem), problem))
        seen = measured(problem, mean, robust, seed)
        print(f"{name}, {time.perf_counter() - begun:.0f} s, {HELD_OUT} held-out masses")
        for label, result, i in (("for the mean mass", mean, 0), ("on the uncertain mass", robust, 1)):
            place = problem.design.describe(result.design)
            predicted = result.history.model_return.max()
            print(f"  {label:<22} {place:<34} learned {seen.learned[i]:.4f} (predicted {predicted:.4f}), "
                  f"LQR {seen.lqr[i]:.4f}")  # fmt: skip
        for label, gain, base in (("learned", seen.gain, seen.learned[0]), ("LQR", seen.of_design, seen.lqr[0])):
            low, high = (100 * end / abs(base) for end in gain.ci95)
            print(f"  gain, {label:<8} {100 * gain.mean / abs(base):+.2f} %  [{low:+.2f}, {high:+.2f}] %", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
