"""A mass whose actuator is the design, stated twice: with limits U(p) and X(p), and in parts of full force."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ccdtools import CoDesignProblem, CustomObjective, DesignSpace, FixedStart, Gaussian, Plant, discretise

SPACE = DesignSpace(["b"], [0.5], [3.0])
X0 = np.array([1.0, -0.5])
Q = np.diag([4.0, 0.5])
R = 0.05
STEPS = 40


def bounds(p):
    """The actuator pushes more than it pulls."""
    return -1.5 * p[0] ** 0.5, 2 * p[0] ** 0.5


def room(p):
    """A longer actuator leaves less room."""
    return ca.vertcat(-2 + 0.2 * p[0], -3), ca.vertcat(2.2 - 0.3 * p[0], 3)


def range_of(p):
    """Lower and upper bound of the input at a design, by NumPy."""
    return -1.5 * p[0] ** 0.5, 2 * p[0] ** 0.5


def room_of(p):
    """Lower and upper bounds of the states at a design, by NumPy."""
    return np.array([-2 + 0.2 * p[0], -3.0]), np.array([2.2 - 0.3 * p[0], 3.0])


def _plant(in_parts: bool) -> tuple[Plant, CustomObjective]:
    """The plant and its objective; of inputs in parts of the larger bound if asked."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")

    def force(u, p):
        return 2 * p[0] ** 0.5 * u if in_parts else u

    dynamics = ca.vertcat(x[1], (0.5 * x[0] - 0.2 * x[1] + force(u, p) + w) / (1 + 0.3 * p))

    def cost(x, u, p):
        return ca.bilin(ca.DM(Q), x) + R * force(u, p) ** 2

    objective = CustomObjective(cost, design_cost=lambda p: 3 * p[0])
    return Plant(x, u, w, p, dynamics, SPACE, dt=0.1), objective


def native_plant() -> Plant:
    """The plant of the problem with U(p)."""
    return _plant(in_parts=False)[0]


def native(X=([-3, -4], [3, 4]), **changes) -> CoDesignProblem:
    """The problem with U(p)."""
    plant, objective = _plant(in_parts=False)
    given = {"U": bounds, "scenarios": FixedStart(X0, Gaussian([0.5])), "steps": STEPS} | changes
    return CoDesignProblem(discretise(plant), X=X, objective=objective, **given)


def in_parts(X=([-3, -4], [3, 4])) -> CoDesignProblem:
    """The same problem, its plant stated in parts of the force that the actuator has."""
    plant, objective = _plant(in_parts=True)
    scenarios = FixedStart(X0, Gaussian([0.5]))
    return CoDesignProblem(discretise(plant), X=X, U=([-0.75], [1.0]), objective=objective, scenarios=scenarios,
                           steps=STEPS)  # fmt: skip


def full_force(p) -> float:
    """What one part is, at a design."""
    return 2 * p[0] ** 0.5
