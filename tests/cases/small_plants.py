"""Small plants whose optimal design is known without the co-design: the exact cost of LQR under Gaussian noise."""

from __future__ import annotations

import copy
from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import minimize

from ccdtools import CoDesignProblem, DesignSpace, FixedStart, Gaussian, Plant, QuadraticObjective, discretise
from invariant_sets import Polytope
from learning import CloningConfig, NetworkConfig, fit_actor_critic
from mpc import lqr

X0 = np.array([1.0, -1.0])
STD = np.array([0.5])
_clones: dict[Any, Any] = {}


def problem_of(plant: Plant, Q, R, *, steps: int = 60) -> CoDesignProblem:
    """A problem whose limits never bind."""
    return CoDesignProblem(
        discretise(plant), X=Polytope.from_bounds([-10, -10], [10, 10]), U=Polytope.from_bounds([-50], [50]),
        objective=QuadraticObjective(Q, R), scenarios=FixedStart(X0, Gaussian(STD)), steps=steps,
    )  # fmt: skip


def mass(heaviest: float = 3.0) -> CoDesignProblem:
    """A mass on a spring, the mass being the design; its optimum lies inside the box."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    dynamics = ca.vertcat(x[1], (-2 * x[0] - 0.3 * x[1] + (1 + 0.5 * p) * u + w) / p)
    plant = Plant(x, u, w, p, dynamics, DesignSpace(["m"], [0.2], [heaviest]), dt=0.1)
    return problem_of(plant, np.diag([10.0, 1.0]), [[0.5]])


def two_valleys() -> CoDesignProblem:
    """An actuator with two favourable places: the one at 0.8 is better, the one at 0.25 has the wider basin."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    gain = 1 + 2.5 * ca.exp(-(((p - 0.8) / 0.08) ** 2)) + 1.5 * ca.exp(-(((p - 0.25) / 0.15) ** 2))
    dynamics = ca.vertcat(x[1], -0.2 * x[0] - 0.1 * x[1] + gain * u + w)
    return problem_of(Plant(x, u, w, p, dynamics, DesignSpace(["p"], [0], [1]), dt=0.1), np.diag([5.0, 0.5]), [[1.0]])


def exact_return(problem: CoDesignProblem, design) -> float:
    """Expected return of LQR at a design, by its Lyapunov recursion."""
    A, B, E = problem.model.matrices(design)
    Q, R = problem.objective.Q, problem.objective.R
    K, _ = lqr(A, B, Q=Q, R=R)
    closed, noise = A - B @ K, E @ np.diag(STD**2) @ E.T
    cost, S = 0.0, np.zeros_like(Q)
    for _ in range(problem.steps):
        cost += np.trace((Q + S) @ noise)
        S = closed.T @ (Q + S) @ closed + K.T @ R @ K
    return -float(X0 @ S @ X0 + cost)


def best_design(problem: CoDesignProblem) -> tuple[np.ndarray, float]:
    """The design of the highest exact return, by L-BFGS-B from several starts, and that return."""
    space = problem.design
    starts = np.random.default_rng(0).random((12, space.dim))
    bounds = [(0, 1)] * space.dim

    def cost(v):
        return -exact_return(problem, space.from_unit(v))

    found = [minimize(cost, v0, method="L-BFGS-B", bounds=bounds) for v0 in starts]
    best = min(found, key=lambda one: one.fun)
    return space.from_unit(best.x), -best.fun


def gains(A, B, Q, R):
    """LQR (n, nu, nx) of many plants at once, by iterating the Riccati equation."""
    P, before = np.broadcast_to(Q, A.shape), np.zeros(A.shape)
    while not np.allclose(P, before, rtol=1e-12, atol=0):
        before, BP = P, B.swapaxes(1, 2) @ P
        K = np.linalg.solve(BP @ B + R, BP @ A)
        P = Q + A.swapaxes(1, 2) @ P @ (A - B @ K)
    return K


def clone_of(problem: CoDesignProblem, seed: int = 0):
    """A small agent that imitates LQR over states and designs, roughly; trained once for the same data."""
    rng = np.random.default_rng(seed)
    lower, upper = problem.observation_bounds
    points = rng.uniform(lower, upper, (2500, len(lower)))
    points[:, :2] *= 10 ** rng.uniform(-2, 0, (2500, 1))
    A, B, _ = problem.model.matrices(points[:, 2:])
    Q, R, bounds = problem.objective.Q, problem.objective.R, np.array(problem.input_bounds)
    data = tuple(array.tobytes() for array in (points, A, B, Q, R, bounds))
    if data not in _clones:
        u = np.clip(-np.einsum("nij,nj->ni", gains(A, B, Q, R), points[:, :2]), *bounds)
        _clones[data] = fit_actor_critic(
            points, u, -np.square(points[:, :2]).sum(axis=1), action_bounds=problem.input_bounds,
            input_bounds=problem.observation_bounds, rng=rng, network=NetworkConfig((24, 24)),
            config=CloningConfig(steps=600, batch=256),
        )  # fmt: skip
    return copy.deepcopy(_clones[data])
