"""A gain designed with the plant under limits, beside CMA-ES on the gain and the design together.

    python benchmarks/gain_codesign.py [--only servo] [--seed 0] [--methods gain lqr]

The limits are 95 to 40 per cent of what saturated LQR of the middle design reaches in the mean of its peaks; a price
pulls the design to the middle of its box. A hundredth of the samples may be outside, and the peaks by a twentieth of
the limit in the mean.

The reference shares nothing with the package but the step of the plant and the numbers of the problem: it simulates
u = −K x, clipped, on 256 runs of its own and moves gain and design by CMA-ES (the package cma), from the gains of
SciPy's Riccati equation at three designs and once more from the best. Both are judged on the same 2000 fresh runs, by
the same simulation. The last two plants were not looked at while the method was made.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cma
import numpy as np
import torch
from scipy.linalg import solve_discrete_are

from ccdtools import (
    CoDesignProblem,
    FixedStart,
    Gaussian,
    Nested,
    OutputLimits,
    QuadraticObjective,
    Simultaneous,
    codesign,
    discretise,
    load_study,
)
from ccdtools.plants.library import mass_chain

FRACTION, DEPTH = 0.01, 0.05
FRESH, RUNS, EVALUATIONS = 2000, 256, 700


@dataclass(frozen=True)
class Case:
    """Problem without limits, and by how much those of some states are below what LQR reaches."""

    stated: Callable[[], CoDesignProblem]
    share: dict[int, float]  # limit of a state, in what LQR reaches
    outputs: Callable[[Any, Any, Any], list[Any]] | None = None  # of NumPy arrays and of CasADi columns
    output_share: float = 1.0

    def problem(self) -> CoDesignProblem:
        """Problem with limits and a price of the design."""
        loose = replace(self.stated(), limit_tolerance="off", warm_up=0)
        box = loose.design
        middle = box.project(box.centre)
        K = riccati_gain(loose, middle)
        x0, w = loose.scenarios.sample(RUNS, loose.steps, np.random.default_rng(5))
        free = Loop(loose, x0, w, self.outputs)
        states, _, outputs, cost, _ = free.run(K, middle)
        scale = np.array(loose.state_scale)
        for i, share in self.share.items():
            scale[i] = max(share * np.abs(states[1:, :, i]).max(0).mean(), 1.05 * np.abs(x0[:, i]).max())
        width = np.where(box.free, box.upper - box.lower, 1.0)
        size = cost.mean() / 2

        def price(p: Any) -> Any:
            """Price of the distance from the middle."""
            return size * sum((p[i] - middle[i]) ** 2 / width[i] ** 2 for i in range(box.dim))

        limits = None
        if self.outputs is not None:
            reach = self.output_share * np.abs(outputs).max(0).mean(0)
            limits = OutputLimits(self.outputs, -reach, reach)
        objective = QuadraticObjective(loose.objective.Q, loose.objective.R, design_cost=price)
        return replace(loose, X=(-scale, scale), objective=objective, limit_tolerance=(FRACTION, DEPTH),
                       output_limits=limits)  # fmt: skip


class Loop:
    """Simulation of clipped linear feedback on given runs, by NumPy."""

    def __init__(self, problem: CoDesignProblem, x0: np.ndarray, w: np.ndarray, outputs: Any = None) -> None:
        self.problem, self.x0, self.w, self.outputs = problem, x0, w, outputs
        self.scale = np.array(problem.state_scale)
        limits = problem.output_limits
        self.reach = None if limits is None else np.array(limits.upper)
        self.Q, self.R, self.bounds = problem.objective.Q, problem.objective.R, problem.input_bounds

    def run(self, K: np.ndarray, p: np.ndarray):
        """States (T + 1, n, nx), inputs (T, n, nu), outputs (T, n, ny), costs (n,), and which runs are lost."""
        step = self.problem.model.stepper(p, batch=len(self.x0))
        x, states, inputs, outputs = self.x0, [self.x0], [], []
        with np.errstate(all="ignore"):
            for k in range(self.w.shape[1]):
                u = np.clip(-x @ K.T, *self.bounds)
                inputs.append(u)
                if self.outputs is not None:
                    outputs.append(np.stack(self.outputs(x.T, u.T, p), axis=1))
                x = np.clip(np.nan_to_num(step(x, u, self.w[:, k])), -1e6 * self.scale, 1e6 * self.scale)
                states.append(x)
        X, U = np.array(states), np.array(inputs)
        cost = np.einsum("tni,ij,tnj->n", X[1:], self.Q, X[1:]) + np.einsum("tni,ij,tnj->n", U, self.R, U)
        design = self.problem.objective.design_cost
        cost = cost + (0.0 if design is None else float(self.problem.cost_of_design(p)))
        return X, U, np.array(outputs), cost, (np.abs(X) > 30 * self.scale).any(axis=(0, 2))

    def measured(self, K: np.ndarray, p: np.ndarray):
        """Costs, fractions of samples outside the limits and largest violations of the runs, (n,) each; lost runs."""
        X, _, Y, cost, lost = self.run(K, p)
        depth = (np.abs(X[1:]) / self.scale - 1).max(-1)
        if self.reach is not None:
            depth = np.maximum(depth, (np.abs(Y) / self.reach - 1).max(-1))
        depth = depth.clip(0)
        return cost, (depth > 0).mean(0), depth.max(0), lost


def riccati_gain(problem: CoDesignProblem, p: np.ndarray) -> np.ndarray:
    """Gain of LQR by SciPy."""
    A, B, _ = problem.model.matrices(p)
    R = problem.objective.R
    P = solve_discrete_are(A, B, problem.objective.Q, R)
    return np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)


def reference(problem: CoDesignProblem, outputs: Any, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Best gain and design by CMA-ES that keep the limits on runs of its own."""
    rng = np.random.default_rng(1000 + seed)
    loop = Loop(problem, *problem.scenarios.sample(RUNS, problem.steps, rng), outputs)
    box, shape = problem.design, (problem.model.nu, problem.model.nx)
    best: list[Any] = [(np.inf, np.inf), None, None]

    def unpacked(z: np.ndarray, unit: np.ndarray):
        return z[box.dim :].reshape(shape) * unit, box.from_unit(z[: box.dim])

    def looked(z: np.ndarray, unit: np.ndarray) -> float:
        """Cost with an exact penalty."""
        K, p = unpacked(z, unit)
        if box.violation(p[None])[0] > 1e-9:
            return 1e30
        cost, outside, peak, lost = loop.measured(K, p)
        if lost.any():
            return 1e12 * (1 + lost.mean() + np.log1p(np.abs(K / unit).sum()))
        over = max(outside.mean() / FRACTION - 1, 0) + max(peak.mean() / DEPTH - 1, 0)
        if (over, cost.mean()) < best[0]:
            best[:] = (over, cost.mean()), K, p
        return float(cost.mean() * (1 + over) + cost.mean() * min(over, 0.05))

    starts = [box.project(box.centre), *box.latin_hypercube(2, rng)]
    for number, p in enumerate([*starts, None]):
        if p is None and best[1] is None:
            break
        K = riccati_gain(problem, p) if p is not None else best[1]
        p = best[2] if p is None else p
        typical = problem.input_bounds[1][:, None] / np.array(problem.state_scale)
        unit = np.maximum(np.abs(K), 0.1 * typical)
        first = np.r_[box.to_unit(p).clip(0.02, 0.98), (K / unit).ravel()]
        far = [np.r_[np.full(box.dim, edge), np.full(K.size, 1e6 * (2 * edge - 1))] for edge in (0.0, 1.0)]
        options = {"bounds": far, "seed": seed + 10 * number + 1, "verbose": -9, "maxfevals": EVALUATIONS}
        cma.fmin(looked, first, 0.25 if number < len(starts) else 0.05, options, args=(unit,))
    return best[1], best[2]


def study(name: str, **changes: Any) -> CoDesignProblem:
    """Problem of a study, changed."""
    return replace(load_study(name).problem(), **changes)


def servo() -> CoDesignProblem:
    """A servo turned by one radian."""
    return study("dc_servo", scenarios=FixedStart([-1.0, 0.0], Gaussian([0.03])))


def chain() -> CoDesignProblem:
    """Two masses between walls, the first one driven."""
    model = discretise(mass_chain(2))
    X, objective = np.array([0.5, 0.5, 2.0, 2.0]), QuadraticObjective(np.diag([100.0, 100, 4, 4]), [[0.01]])
    scenarios = FixedStart([0.2, 0.3, 0, 0], Gaussian([1.0]))
    return CoDesignProblem(model, X=(-X, X), U=(-5, 5), objective=objective, scenarios=scenarios, steps=100)


def pole() -> CoDesignProblem:
    """A pole on a cart, not linear, begun 0.2 rad from upright."""
    return study("pendulum_on_cart", scenarios=FixedStart([0.0, 0, 0.2, 0], Gaussian([0.2])))


def tanks() -> CoDesignProblem:
    """Two tanks, not linear, both too low at first."""
    return study("two_tanks", scenarios=FixedStart([-1.0, -4.0], Gaussian([1.0, 1.0])))


def body_acceleration(x: Any, u: Any, p: Any) -> list[Any]:
    """Acceleration of the body of the library's quarter car, in parts of its largest at full force [-]."""
    return [(p[0] * x[2] + p[1] * (x[3] - x[1]) - u[0]) / 1e3]


def ride() -> CoDesignProblem:
    """A quarter car on white road."""
    return study("suspension", scenarios=FixedStart(np.zeros(4), Gaussian([0.3])))


CASES = {
    "servo": Case(servo, {1: 0.7}),
    "suspension": Case(ride, {2: 0.9}),
    "chain": Case(chain, {2: 0.45, 3: 0.4}),
    "pole": Case(pole, {0: 0.7}),
    "tanks": Case(tanks, {0: 0.7}),
    "ride, an output": Case(ride, {}, body_acceleration, 0.7),
    "turbine": Case(lambda: study("wind_turbine"), {0: 0.8, 1: 0.95}),
}
METHODS: dict[str, Callable[[], Any]] = {
    "simultaneous": lambda: Simultaneous("gain"),
    "gain": lambda: Nested("gain"),
    "lqr": Nested,
}


def row(name: str, seed: int, methods: list[str]) -> None:
    """Print lines of the table."""
    case = CASES[name]
    problem = case.problem()
    began = time.process_time()
    K, p = reference(problem, case.outputs, seed)
    took = time.process_time() - began
    rng = np.random.default_rng(77 + seed)
    judge = Loop(problem, *problem.scenarios.sample(FRESH, problem.steps, rng), case.outputs)

    def told(outside: np.ndarray, peak: np.ndarray) -> str:
        return f"{outside.mean() / FRACTION:.2f}, {peak.mean() / DEPTH:.2f}"

    theirs, *broken, lost = judge.measured(K, p)
    at = ", ".join(f"{v:.2f}" for v in problem.design.to_unit(p))
    print(f"| {name} | CMA-ES | {theirs.mean():.5g} | {told(*broken)} | {lost.mean():.1%} | {at} | {took:.0f} |",
          flush=True)  # fmt: skip
    for which in methods:
        began = time.process_time()
        found = codesign(problem, method=METHODS[which](), rng=np.random.default_rng(seed))
        took = time.process_time() - began
        own, *broken, lost = judge.measured(np.asarray(found.controller.K), found.design)
        beside = 100 * (own - theirs) / theirs.mean()
        error = 1.96 * beside.std() / len(beside) ** 0.5
        at = ", ".join(f"{v:.2f}" for v in problem.design.to_unit(found.design))
        print(f"| {name} | {which} | {beside.mean():+.2f} ± {error:.2f} % | {told(*broken)} | {lost.mean():.1%} | {at} "
              f"| {took:.0f} | {found.status.name}", flush=True)  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=tuple(CASES))
    parser.add_argument("--methods", nargs="+", choices=tuple(METHODS), default=["gain", "simultaneous"])
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    print("| plant | method | above CMA-ES | samples outside, peaks, in the tolerance | lost | design in its box | s |")
    print("|---|---|---|---|---|---|---|")
    for name in asked.only or CASES:
        row(name, asked.seed, asked.methods)


if __name__ == "__main__":
    main()
