"""Gradient of a policy on plants that jump, bend or are smooth, beside differences of a simulation of their own.

    python benchmarks/policy_gradients.py [--only wall] [--seed 0] [--runs 20000]

A policy imitates a linear law. The package takes slopes of its return along four changes of the last layer, through the
model, on all runs; beside them stand central differences on the same runs, the plant simulated in NumPy. What differs
is told in standard errors of both together, the largest of the four slopes, and as a part of the gradient's length.
Then follows what `codesign` says of such a policy, from its check on 512 runs of their own.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import torch

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    Gaussian,
    LearnedPolicy,
    Plant,
    QuadraticObjective,
    RandomStarts,
    discretise,
)
from ccdtools.co_design.budgets import SETTLING_RUNS
from ccdtools.co_design.differentiable_model import latent_law, scenario_tensors
from ccdtools.co_design.policy_check import Retuned, gradient_of_policy
from ccdtools.co_design.tolerances import BLIND_SHARE
from learning import fit_actor_critic

DT, STEPS, FORCE = 0.05, 60, 6.0


class Numpy:
    """What a plant is written with: NumPy's functions."""

    where, sin, clip, sign, tanh = np.where, np.sin, np.clip, np.sign, np.tanh


class Symbols:
    """CasADi's functions of the same names."""

    where, sin, sign, tanh = ca.if_else, ca.sin, ca.sign, ca.tanh

    @staticmethod
    def clip(value: Any, low: float, high: float) -> Any:
        return ca.fmin(ca.fmax(value, low), high)


def moved(x: Any, pull: Any) -> list[Any]:
    """Position and speed of a mass of 1 kg one sample later."""
    return [x[0] + DT * x[1], x[1] + DT * pull]


def wall(f: Any, x: Any, u: Any, w: Any) -> list[Any]:
    """A mass that bounces off a wall: its speed jumps."""
    q, v = moved(x, u + w)
    hit = q < -0.3
    return [f.where(hit, -0.6 - q, q), f.where(hit, -0.8 * v, v)]


def stops(f: Any, x: Any, u: Any, w: Any) -> list[Any]:
    """A sprung mass between stops with a damper of their own: the force jumps at contact."""
    beyond = x[0] - f.clip(x[0], -0.4, 0.4)
    contact = f.where(beyond == 0, 0.0, 1.0)
    return moved(x, u + w - 2 * x[0] - 150 * beyond - 4 * contact * x[1])


def friction(f: Any, x: Any, u: Any, w: Any) -> list[Any]:
    """A mass with dry friction: its force jumps with the direction."""
    return moved(x, u + w - 1.0 * f.sign(x[1]))


def backlash(f: Any, x: Any, u: Any, w: Any) -> list[Any]:
    """Motor and load with a gap between them, damped in contact: the torque jumps."""
    twist = x[0] - x[2]
    pressed = twist - f.clip(twist, -0.1, 0.1)
    torque = 40 * pressed + f.where(pressed == 0, 0.0, 1.0) * 1.5 * (x[1] - x[3])
    motor, load = moved(x[:2], u - torque), moved(x[2:], torque + w)
    return [*motor, *load]


def relay(f: Any, x: Any, u: Any, w: Any) -> list[Any]:
    """A mass pushed one way or the other, by the sign of the input."""
    return moved(x, 3 * f.sign(u) + w)


def steep(f: Any, x: Any, u: Any, w: Any) -> list[Any]:
    """The relay written as something steep, which is smooth to a computer."""
    return moved(x, 3 * f.tanh(u / 1e-3) + w)


def saturated(f: Any, x: Any, u: Any, w: Any) -> list[Any]:
    """A mass whose actuator ends at a third of the input's range: a bend, no jump."""
    return moved(x, f.clip(u, -2, 2) + w)


def mass(f: Any, x: Any, u: Any, w: Any) -> list[Any]:
    """A mass on a damper."""
    return moved(x, u + w - 0.5 * x[1])


def pendulum(f: Any, x: Any, u: Any, w: Any) -> list[Any]:
    """A pendulum held upright."""
    return moved(x, 9.81 * f.sin(x[0]) / 2 + u + w)


@dataclass(frozen=True)
class Case:
    """Plant, its size, the law that its policy imitates, and the middle of its starts."""

    plant: Callable[..., list[Any]]
    K: tuple[float, ...] = (2.0, 1.5)
    start: tuple[float, ...] = (1.5, -1.0)

    def problem(self) -> CoDesignProblem:
        """Problem of the library, whose design only weighs the disturbance."""
        n = len(self.K)
        x, u, w, p = ca.SX.sym("x", n), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("m")
        after = self.plant(Symbols, ca.vertsplit(x), u, p * w)
        plant = Plant(x, u, w, p, after, DesignSpace(["m"], [0.5], [2.0]), dt=DT, continuous=False)
        box, U = 5.0 + np.abs(self.start), (-FORCE, FORCE)
        model = discretise(plant, X=(-box, box), U=U)
        starts = RandomStarts(Gaussian(np.full(n, 0.3), mean=self.start), Gaussian([1.0]))
        return CoDesignProblem(
            model, X=(-box, box), U=U, objective=QuadraticObjective(np.diag(np.tile([1.0, 0.1], n // 2)), [[0.05]]),
            scenarios=starts, steps=STEPS, limit_tolerance="off",
        )  # fmt: skip

    def policy(self, problem: CoDesignProblem, seed: int) -> LearnedPolicy:
        """Policy at p = 1 that imitates the linear law on states of the box."""
        rng = np.random.default_rng(seed)
        x = rng.uniform(-1, 1, (4096, len(self.K))) * (1 + np.abs(self.start))
        u = np.clip(-x @ np.array(self.K), -FORCE, FORCE)[:, None]
        agent = fit_actor_critic(
            np.hstack([x, np.ones((len(x), 1))]), u, np.zeros(len(x)), rng=rng,
            action_bounds=problem.input_bounds, input_bounds=problem.observation_bounds,
        )  # fmt: skip
        return LearnedPolicy(agent, [1.0])

    def returns(self, latent: Any, tuned: Callable[[Any, Any], Any], x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Returns of runs by NumPy, the latent action changed before it is clipped."""
        total = np.zeros(len(x))
        for k in range(w.shape[1]):
            with torch.no_grad():
                action = latent(torch.from_numpy(x)).numpy()
            u = FORCE * np.clip(tuned(action, x), -1, 1)[:, 0]
            x = np.stack(self.plant(Numpy, x.T, u, w[:, k, 0]), axis=1)
            total -= (x[:, ::2] ** 2).sum(1) + 0.1 * (x[:, 1::2] ** 2).sum(1) + 0.05 * u**2
        return total


CASES = {
    "wall": Case(wall, (1.0, 0.5), (1.5, -2.5)),
    "bump stops": Case(stops),
    "dry friction": Case(friction),
    "backlash": Case(backlash, (3.0, 2.0, 1.0, 1.0), (0.5, 0.0, 0.5, 0.0)),
    "relay": Case(relay),
    "relay, as a steep tanh": Case(steep),
    "saturation inside": Case(saturated),
    "mass, smooth": Case(mass),
    "pendulum, smooth": Case(pendulum, (8.0, 3.0), (0.5, 0.0)),
}


def row(name: str, seed: int, runs: int) -> str:
    """Line of the table."""
    case = CASES[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the jumps, which are the point here
        problem = case.problem()
    policy = case.policy(problem, seed)
    rng = np.random.default_rng(100 + seed)
    began = time.process_time()
    said = gradient_of_policy(problem, policy, scenario_tensors(problem, 2 * SETTLING_RUNS, rng))
    took = time.process_time() - began
    jumps = bool(getattr(problem.model, "jump", ""))
    words = [*["jumps"] * jumps, *[f"blind in {said.blind:.0%}"] * (said.blind > BLIND_SHARE)]
    words += ["differs"] * (not said.trusted)
    scenarios = tuple(part.double() for part in scenario_tensors(problem, runs, rng))
    retuned = Retuned(problem, policy, scenarios)
    n = int(np.prod(retuned.shape))
    directions = np.linalg.qr(np.random.default_rng(0).standard_normal((n, min(4, n))))[0]
    through = []
    for x, w in zip(*(part.split(4000) for part in scenarios)):
        r = torch.zeros((len(x), *retuned.shape), dtype=torch.float64, requires_grad=True)
        total = retuned.on((x, w)).values(r)
        through.append(torch.autograd.grad(total.sum(), r)[0].flatten(1).numpy() @ directions)
    pathwise = np.concatenate(through)
    unit, law = (part.numpy() for part in (retuned._unit, retuned._law))
    latent = latent_law(policy.agent.double(), torch.tensor(policy.design, dtype=torch.float64))
    x0, w = (part.numpy() for part in scenarios)

    def at(r: np.ndarray) -> np.ndarray:
        """Returns of the policy changed by r (1, 2 + nx)."""
        gain, offset, feedback = np.exp(r[0, 0]), r[0, 1] * unit[0], (r[0, 2:] * law[0])[:, None]
        return case.returns(latent, lambda action, x: gain * action + offset + x @ feedback, x0, w)

    step = 1e-2
    ends = [(at(step * d.reshape(1, -1)), at(-step * d.reshape(1, -1))) for d in directions.T]
    differences = np.stack([(a - b) / (2 * step) for a, b in ends], axis=1)
    away = pathwise.mean(0) - differences.mean(0)
    errors = np.sqrt((pathwise.var(0) + differences.var(0)) / runs)
    apart = float(np.max(np.abs(away) / np.maximum(errors, 1e-12)))
    part = 100 * np.linalg.norm(away) / np.linalg.norm(differences.mean(0))
    good = "" if apart <= 3 or words else "  NOT SAID"
    return f"| {name} | {apart:.1f} | {part:.1f} % | {', '.join(words) or 'trusted'} | {took:.0f} |{good}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=tuple(CASES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", type=int, default=20_000)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    print("| plant | apart, in standard errors | of the gradient's length | what the check says | s |")
    print("|---|---|---|---|---|")
    for name in asked.only or CASES:
        print(row(name, asked.seed, asked.runs), flush=True)


if __name__ == "__main__":
    main()
