"""Plants whose design is constrained, with the exact cost of LQR by matrices of their own: no code of the co-design."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import expm, solve_discrete_are
from scipy.optimize import minimize

from ccdtools import CoDesignProblem, DesignSpace, FixedStart, Gaussian, Plant, QuadraticObjective, discretise
from learning import CloningConfig, NetworkConfig, fit_actor_critic

STEPS = 50
STD = 0.5
DT = 0.1


@dataclass(frozen=True)
class Case:
    """ẋ₁ = x₂, ẋ₂ = −k(p) x₁ − d(p) x₂ + b(p) u + e(p) w, with constraints as numbers and as expressions alike."""

    coefficients: Callable[[Any], tuple[Any, Any, Any, Any]]
    lower: list[float]
    upper: list[float]
    constraints: Callable[[Any], list[Any]]
    start: list[float]
    x0: tuple[float, float] = (1.0, -1.0)
    Q: tuple[float, float] = (8.0, 1.0)
    R: float = 0.4
    whole: list[int] = field(default_factory=list)

    def problem(self) -> CoDesignProblem:
        """The co-design problem; its limits never bind."""
        x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", len(self.lower))
        k, d, b, e = self.coefficients(p)
        names = [f"p{i}" for i in range(len(self.lower))]
        space = DesignSpace(names, self.lower, self.upper, constraints=self.constraints, integer=self.whole)
        plant = Plant(x, u, w, p, ca.vertcat(x[1], -k * x[0] - d * x[1] + b * u + e * w), space, dt=DT)
        return CoDesignProblem(
            discretise(plant), X=([-20, -20], [20, 20]), U=([-100], [100]), steps=STEPS,
            objective=QuadraticObjective(np.diag(self.Q), [[self.R]]), scenarios=FixedStart(self.x0, Gaussian([STD])),
        )  # fmt: skip

    def loop(self, p: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Closed loop, gain and noise covariance of LQR at a design, by the matrix exponential and the DARE."""
        k, d, b, e = (float(value) for value in self.coefficients(np.asarray(p, dtype=float)))
        M = np.zeros((4, 4))
        M[:2] = [[0, 1, 0, 0], [-k, -d, b, e]]
        D = expm(M * DT)
        A, B, E = D[:2, :2], D[:2, 2:3], D[:2, 3:]
        P = solve_discrete_are(A, B, np.diag(self.Q), [[self.R]])
        K = np.linalg.solve(self.R + B.T @ P @ B, B.T @ P @ A)
        return A - B @ K, K, STD**2 * E @ E.T

    def cost(self, p: Any) -> float:
        """Expected cost of LQR over an episode."""
        C, K, W = self.loop(p)
        X = np.outer(self.x0, self.x0)
        total = 0.0
        for _ in range(STEPS):
            total += self.R * float(np.trace(K @ X @ K.T))
            X = C @ X @ C.T + W
            total += float(np.trace(np.diag(self.Q) @ X))
        return total

    def best(self, starts: int = 6) -> tuple[np.ndarray, float]:
        """The best feasible design and its cost: SLSQP from several starts, for every combination of whole numbers."""
        low, high = np.array(self.lower), np.array(self.upper)
        ranges = [range(int(low[i]), int(high[i]) + 1) for i in self.whole]
        found = (low, np.inf)
        rng = np.random.default_rng(7)
        for numbers in product(*ranges):

            def design(v, numbers=numbers):
                p = low + v * (high - low)
                p[self.whole] = numbers
                return p

            rules = [{"type": "ineq", "fun": lambda v, d=design: -np.array(self.constraints(d(v)), dtype=float)}]
            for _ in range(starts):
                with np.errstate(all="ignore"):
                    v = minimize(lambda v, d=design: self.cost(d(v)), rng.random(len(low)), method="SLSQP",
                                 bounds=[(0, 1)] * len(low), constraints=rules, options={"ftol": 1e-9}).x  # fmt: skip
                p = design(np.clip(v, 0, 1))
                if max(self.constraints(p)) <= 1e-7 and self.cost(p) < found[1]:
                    found = (p, self.cost(p))
        return found

    def agent(self, problem: CoDesignProblem):
        """A small agent that imitates LQR over states and designs, roughly."""
        rng = np.random.default_rng(0)
        lower, upper = problem.observation_bounds
        points = rng.uniform(lower, upper, (1000, len(lower)))
        points[:, :2] *= 0.5 * 10 ** rng.uniform(-2, 0, (1000, 1))
        points[:, 2:] = np.clip(points[:, 2:], self.lower, self.upper)
        u = np.array([-self.loop(z[2:])[1] @ z[:2] for z in points])
        return fit_actor_critic(
            points, np.clip(u, *problem.input_bounds), -np.square(points[:, :2]).sum(axis=1), rng=rng,
            action_bounds=problem.input_bounds, input_bounds=problem.observation_bounds,
            network=NetworkConfig((16, 16)), config=CloningConfig(steps=300, batch=256),
        )  # fmt: skip


def _authority(p):
    return 1 / (1 + 0.2 * p[0]), 0.3, p[0] / (1 + 0.2 * p[0]), 1 / p[1]


def _in_units(p):
    return _authority([p[0] / 1e4, p[1] * 1e4])


def _bowl(p):
    return p[0], 0.3, (1 + p[1]) / (1 + 0.5 * p[1] ** 2), 1 + (p[0] - 1.5) ** 2


def _gear(p):
    return 1 / (1 + 0.1 * p[1] ** 2), 0.3, p[1] * (1 + 0.6 * p[0]) / (1 + 0.1 * p[1] ** 2), 1 / (1 + 0.8 * p[0])


CASES = {
    "a mass budget": Case(_authority, [0.5, 0.5], [4, 4], lambda p: [p[0] + p[1] - 3.5], [0.6, 0.6]),
    "a curved budget in other units": Case(
        _in_units, [0.5e4, 0.5e-4], [4e4, 4e-4], lambda p: [1e6 * ((p[0] / 1e4) ** 2 + 2 * (p[1] * 1e4) ** 2 - 9)],
        [0.6e4, 0.6e-4],
    ),
    "two budgets": Case(
        _authority, [0.5, 0.5], [4, 4], lambda p: [p[0] + p[1] - 3.5, p[0] - 0.4 * p[1]], [0.5, 1.4]
    ),
    "a budget that is not spent": Case(_bowl, [0.2, 0], [3, 3], lambda p: [p[0] + p[1] - 5.5], [2.6, 2.7]),
    "a forbidden disc": Case(
        _bowl, [0.2, 0], [3, 3], lambda p: [0.64 - (p[0] - 1.5) ** 2 - (p[1] - 0.9) ** 2], [2.9, 2.8]
    ),
    "a fixed entry": Case(
        lambda p: (p[2], 0.1 * p[1], p[0], 1 + 0.2 * p[1]), [0.5, 0.2, 2.0], [4, 5, 2.0],
        lambda p: [p[0] ** 2 * (1 + p[1]) - 12], [0.6, 4.9, 2.0],
    ),
    "teeth": Case(_gear, [0.3, 1], [4, 6], lambda p: [p[0] * p[1] - 4.0], [0.4, 6], whole=[1]),
}  # fmt: skip
