"""Settled statuses beside an own simulator: from spoilt warm starts, and with binding limits, by every method.

``python benchmarks/settled_statuses.py [--spoilt N] [--limits N] [--methods NAME,NAME] [--seed S]`` runs N co-designs
of either kind on random plants and prints a row for each. The oracle shares no code with the package: plain NumPy
closes the loop of the controller that was handed out, of LQR of its design (SciPy's Riccati equation) and of LQR of 41
designs all over the box, on common random numbers.

Required: no settled status 1 % below LQR of the same design or the best of these LQR that keep the limits, none that
leaves the limits further than was asked for beyond chance, and none that loses a run.
"""

from __future__ import annotations

import argparse
import time
import warnings
from dataclasses import dataclass

import casadi as ca
import numpy as np
import torch
from scipy.linalg import solve_discrete_are

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
)
from ccdtools.co_design.method_names import named_methods
from learning import CloningConfig, NetworkConfig, fit_actor_critic

SPOILS = ("saturated", "dead zone", "lost", "zero")
LEARNED = ("pathwise", "ppo", "pathwise+ppo")
OTHERS = ("nested LQR", "sequential", "simultaneous", "simultaneous gain", "nested trajectory", "nested Riccati",
          "CMA-ES", "pathwise")  # fmt: skip
STEPS, RUNS, WORSE, GRID = 50, 2000, 0.01, 41
GRANTED = (0.03, 0.1)  # of the states, and half-widths
CONFIG = CoDesignConfig(iterations=120, evaluation_runs=300, pathwise_runs=96, runs=64)


@dataclass(frozen=True)
class Case:
    """x⁺ = A(p) x + B(p) u + E w with random entries, in units of its own; p in [0, 1] stiffens and strengthens."""

    seed: int
    tight: bool = False

    @property
    def numbers(self) -> np.ndarray:
        """Stiffness, damping, strength, price of the design, noise and length of a step."""
        low, high = np.array([[-1.0, 0.1, 0.5, 0.0, 0.3, 0.05], [4.0, 1.0, 2.0, 6.0, 0.8, 0.15]])
        return np.random.default_rng(self.seed).uniform(low, high)

    @property
    def units(self) -> np.ndarray:
        """Of the states and the input."""
        return 10.0 ** np.random.default_rng(self.seed + 1).uniform(-2, 2, 3)

    def matrices(self, p):
        """A, B and E at a design, as lists of lists."""
        k, d, b, _, _, dt = self.numbers
        s, v, f = self.units
        k = k + 3 * p
        A = [[1.0, dt * v / s], [-dt * k * s / v, 1 - dt * d]]
        return A, [[0.0], [dt * b * (0.5 + p) * f / v]], [[0.0], [dt / v]]

    @property
    def limits(self):
        """Half-widths of X and U."""
        s, v, f = self.units
        room = np.random.default_rng(self.seed + 2).uniform(1.1, 2.5)
        wide = np.array([room, room]) if self.tight else np.array([20.0, 20.0])
        return wide / [s, v], np.array([8.0 / f])

    @property
    def weights(self):
        """Q and R."""
        s, v, f = self.units
        return np.diag([4 * s**2, 0.5 * v**2]), np.array([[0.3 * f**2]])

    @property
    def start(self):
        """x0."""
        return np.array([1.0, -1.0]) / self.units[:2]

    def price(self, p):
        """Of a design, for an episode."""
        return self.numbers[3] * STEPS * 0.1 * (p + 0.2)

    def problem(self) -> CoDesignProblem:
        """The same, stated to the package."""
        x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
        A, B, E = (ca.vertcat(*(ca.horzcat(*row) for row in M)) for M in self.matrices(p))
        plant = Plant(x, u, w, p, A @ x + B @ u + E @ w, DesignSpace(["p"], [0.0], [1.0]), dt=0.1, continuous=False)
        X, U = self.limits
        return CoDesignProblem(
            discretise(plant), X=(-X, X), U=(-U, U), steps=STEPS,
            objective=QuadraticObjective(*self.weights, design_cost=lambda p: self.price(p[0])),
            scenarios=FixedStart(self.start, Gaussian([3 * self.numbers[4]])),
            limit_tolerance=GRANTED if self.tight else "mpc",
        )  # fmt: skip

    def gain(self, p: float) -> np.ndarray:
        """Of LQR."""
        A, B = (np.array(M, dtype=float) for M in self.matrices(p)[:2])
        P = solve_discrete_are(A, B, *self.weights)
        return np.linalg.solve(self.weights[1] + B.T @ P @ B, B.T @ P @ A)

    def lqr(self, p: float):
        """Saturated LQR."""
        K, U = self.gain(p), self.limits[1]
        return lambda x: np.clip(-x @ K.T, -U, U)

    def simulated(self, law, p: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns, fraction of the states outside and peak violation of each run."""
        rng = np.random.default_rng(12345 + self.seed)
        A, B, E = (np.array(M, dtype=float) for M in self.matrices(p))
        X, U = self.limits
        x = np.tile(self.start, (RUNS, 1))
        returns, outside, peak = np.full(RUNS, -float(self.price(p))), np.zeros(RUNS), np.zeros(RUNS)
        for _ in range(STEPS):
            u = np.asarray(law(x))
            assert (np.abs(u) <= U * (1 + 1e-6)).all()
            x = x @ A.T + u @ B.T + 3 * self.numbers[4] * rng.standard_normal((RUNS, 1)) @ E.T
            x = np.clip(x, -1e9 * X, 1e9 * X)
            Q, R = self.weights
            returns -= np.einsum("ni,ij,nj->n", x, Q, x) + np.einsum("ni,ij,nj->n", u, R, u)
            depth = np.maximum((np.abs(x) / X - 1).max(axis=1), 0.0)
            outside += (depth > 1e-9) / STEPS
            peak = np.maximum(peak, depth)
        return returns, outside, peak

    def kept(self, outside: np.ndarray, peak: np.ndarray) -> bool:
        """Whether limits are left no further than granted, beyond chance."""
        granted = GRANTED if self.tight else (np.inf, np.inf)
        return all(m.mean() - 2 * m.std() / np.sqrt(RUNS) <= most for m, most in zip((outside, peak), granted))


def clone(case: Case, problem: CoDesignProblem, spoil: str):
    """A policy that imitates LQR, and is then spoilt."""
    rng = np.random.default_rng(case.seed)
    lower, upper = problem.observation_bounds
    points = rng.uniform(lower, upper, (2000, 3))
    points[:, :2] *= 10 ** rng.uniform(-2, 0, (2000, 1))
    U = case.limits[1]
    u = np.array([np.clip(-case.gain(p) @ x, -U, U) for *x, p in points])
    agent = fit_actor_critic(
        points, u, -np.square(points[:, :2] * case.units[:2]).sum(axis=1), action_bounds=problem.input_bounds,
        input_bounds=(lower, upper), rng=rng, network=NetworkConfig((24, 24)),
        config=CloningConfig(steps=400, batch=256),
    )  # fmt: skip
    network = agent.mean_network
    own = [network.head.weight, network.head.bias, network.skip.weight]
    with torch.no_grad():
        for weight in own if spoil in ("zero", "lost", "dead zone") else []:
            weight.mul_({"zero": 0.0, "lost": -4.0, "dead zone": 1e-3}[spoil])
        if spoil == "saturated":
            network.head.bias.fill_(50.0)
    return agent


def wrong(case: Case, result) -> tuple[float, str]:
    """By how much a result is below the better LQR in per cent, and what its settled status hides."""
    p = float(result.design[0])
    returns, outside, peak = case.simulated(result.controller, p)
    size = abs(returns.mean() + float(case.price(p)))
    behind = [case.simulated(case.lqr(p), p)]
    behind += [case.simulated(case.lqr(q), q) for q in np.linspace(0, 1, GRID)]
    kept = [100 * (other - returns).mean() / size for other, *left in behind if case.kept(*left)]
    loss = max(kept, default=-np.inf)
    said = [f"{loss:.2f} % below LQR"] if loss > 100 * WORSE else []
    said += [] if case.kept(outside, peak) else [f"outside {outside.mean():.3f}, {peak.mean():.3f} half-widths"]
    return loss, "; ".join(said)


def study(kind: str, number: int, methods: tuple[str, ...], seed: int) -> int:
    """Run and print so many co-designs; how many settled statuses are wrong."""
    count = settled = 0
    for i in range(number):
        case = Case(seed + 10 * i, kind == "limits")
        problem = case.problem()
        name = methods[i % len(methods)]
        began = time.process_time()
        options = {"method": named_methods([name])[name]}
        if name in LEARNED:
            spoil = SPOILS[(i // len(methods) + i) % 4] if kind == "spoilt" else "none"
            options = {"method": name, "agent": clone(case, problem, spoil), "config": CONFIG}
            name = f"{name}, {spoil}"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = codesign(problem, rng=np.random.default_rng(case.seed), **options)
        loss, hidden = wrong(case, result)
        settled += result.status.settled
        bad = bool(hidden) and result.status.settled
        count += bad
        print(f"{kind:7} {case.seed:4} {name:24} p = {result.design[0]:.3f} {result.status.name:20} {loss:8.2f} % "
              f"{time.process_time() - began:6.1f} s {'WRONG: ' if bad else ''}{hidden}", flush=True)  # fmt: skip
    print(f"{kind}: {number} co-designs, {settled} settled, {count} of them wrong (required 0)")
    return count


def main() -> None:
    """Both kinds, as many as asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--spoilt", type=int, default=50)
    parser.add_argument("--limits", type=int, default=50)
    parser.add_argument("--methods", default="")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    own = tuple(asked.methods.split(",")) if asked.methods else ()
    count = study("spoilt", asked.spoilt, own or LEARNED, asked.seed) if asked.spoilt else 0
    count += study("limits", asked.limits, own or OTHERS, asked.seed) if asked.limits else 0
    raise SystemExit(count > 0)


if __name__ == "__main__":
    main()
