"""Simultaneous and nested co-design of the suspension."""

from __future__ import annotations

import time
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.optimize import minimize

from active_suspension.roads import Road
from active_suspension.statement import problem
from ccdtools import Plant
from mpc.optimal_control import NonlinearProgram, Radau, Solution, build, solve


@dataclass(frozen=True, eq=False)
class Found:
    """What a strategy ends with.

    Attributes
    ----------
    p : (7,) array
    solution : Solution
        The trajectories at p.
    solves : int
        Of optimal control problems.
    seconds : float
        Of processor time.
    said : str
        By the search.
    """

    p: np.ndarray
    solution: Solution
    solves: int
    seconds: float
    said: str


def simultaneous(plant: Plant, road: Road, start, mesh) -> Found:
    """Trajectories of both load cases and the design in one nonlinear program."""
    began = time.process_time()
    solution = solve(_program(plant, road, start, mesh, rules=True), max_iterations=500)
    return Found(solution.p, solution, 1, time.process_time() - began, solution.status.name)


def _program(plant: Plant, road: Road, start, mesh, *, rules: bool) -> NonlinearProgram:
    """The program of both load cases."""
    return build(problem(plant, road, start, rules=rules), Radau(3), meshes=mesh)


class Inner:
    """Optimal trajectories at a design, and how their cost changes with it: nothing is built anew for another one."""

    def __init__(self, plant: Plant, road: Road, start, mesh) -> None:
        self.program = _program(plant, road, start, mesh, rules=False)
        self.solves = 0
        self._last: Solution | None = None
        self._best: Solution | None = None

    def at(self, p) -> Solution:
        """The trajectories at a design, from those of the one before."""
        if self._last is not None and np.array_equal(self._last.p, p):
            return self._last
        self.solves += 1
        solution = solve(self.program, p=p, start=self._best)
        if not solution.solved_on_mesh:
            solution = solve(self.program, p=p)
        self._last = solution
        if solution.solved_on_mesh:
            self._best = solution
        return solution


def nested(plant: Plant, road: Road, start, mesh, *, tolerance: float = 1e-7, most: int = 200) -> Found:
    """SQP over the design, with exact gradients of the optimal cost; trajectories at each design by an inner solve."""
    began = time.process_time()
    space = plant.design
    width = space.upper - space.lower
    first = space.project(start)
    inner = Inner(plant, road, first, mesh)
    v = ca.SX.sym("v", space.dim)
    g = space.constraints(ca.DM(space.lower) + v * ca.DM(width))
    slopes = ca.Function("slopes", [v], [ca.densify(ca.jacobian(g, v))])
    rules = ca.Function("rules", [v], [g])

    def design(u: np.ndarray) -> np.ndarray:
        return np.clip(space.lower + u * width, space.lower, space.upper)

    def cost(u: np.ndarray) -> float:
        """The optimal cost; infinite where the car cannot stand, or no trajectory is found: the search steps back."""
        at_rest = np.asarray(rules(u)).ravel()[[name.endswith("at rest") for name in space.constraint_names]]
        solution = inner.at(design(u)) if (at_rest <= 0).all() else None
        return solution.cost if solution is not None and solution.solved_on_mesh else np.inf

    found = minimize(
        cost, np.clip((first - space.lower) / width, 0, 1),
        jac=lambda u: inner.at(design(u)).p_gradient * width, bounds=[(0, 1)] * space.dim, method="SLSQP",
        constraints={
            "type": "ineq", "fun": lambda u: -np.asarray(rules(u)).ravel(), "jac": lambda u: -np.asarray(slopes(u)),
        },
        options={"ftol": tolerance, "maxiter": most},
    )  # fmt: skip
    p = design(found.x)
    return Found(p, inner.at(p), inner.solves, time.process_time() - began, found.message)
