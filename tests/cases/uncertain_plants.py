"""A lightly damped mass that may be one of a few, whose spring is the design: exact costs of linear feedback."""

from __future__ import annotations

import casadi as ca
import numpy as np
from scipy.linalg import expm
from scipy.optimize import minimize

from ccdtools import CoDesignProblem, CustomObjective, DesignSpace, FixedStart, Gaussian, Plant, discretise
from ccdtools.disturbances import Cases, Stacked

DT = 0.1
MASSES = (0.6, 1.0, 2.2)  # 1 + θ
X0 = np.array([1.0, 0.0])
STD = 1.5
STEPS = 60
Q = np.diag([3.0, 0.3])
R = 0.3
PRICE = 2.0


def problem(risk, masses=MASSES, unit=1.0) -> CoDesignProblem:
    """The problem, its costs in another unit."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w", 2), ca.SX.sym("p")
    plant = Plant(
        x, u, w, p, ca.vertcat(x[1], (-p * x[0] - 0.1 * x[1] + u + w[0]) / (1 + w[1])),
        DesignSpace(["k"], [0.2], [6.0]), dt=DT,
    )  # fmt: skip
    bounds = ([-4, -8], [4, 8]), ([-30], [30]), ([-2, -0.5], [2, 1.5])
    model = discretise(plant, X=bounds[0], U=bounds[1], W=bounds[2], accuracy=1e-4)
    objective = CustomObjective(
        lambda x, u, p: unit * (ca.bilin(ca.DM(Q), x) + R * u**2), design_cost=lambda p: unit * PRICE * p[0]
    )
    disturbance = Stacked((Gaussian([STD]), Cases.of(np.array(masses) - 1)))
    return CoDesignProblem(
        model, X=bounds[0], U=bounds[1], objective=objective, scenarios=FixedStart(X0, disturbance), steps=STEPS,
        risk=risk, limit_tolerance="off",
    )  # fmt: skip


def exact_costs(k, gain, masses=MASSES):
    """Expected cost of u = −gain x for every mass, the spring's own with it."""
    costs = []
    for mass in masses:
        block = np.zeros((4, 4))
        block[:2, :2] = [[0, 1], [-k / mass, -0.1 / mass]]
        block[1, 2:] = 1 / mass
        held = expm(DT * block)
        A, B, E = held[:2, :2], held[:2, 2:3], held[:2, 3:]
        closed = A - B @ np.atleast_2d(gain)
        stage = Q + R * np.outer(gain, gain)
        P, noise = np.zeros((2, 2)), 0.0
        for _ in range(STEPS):
            noise += STD**2 * (E.T @ P @ E).item()
            P = stage + closed.T @ P @ closed
        costs.append(X0 @ P @ X0 + noise + PRICE * k)
    return np.array(costs)


def minimax(measure=np.max):
    """The design and gain of the least worst cost, and that cost, by SciPy from several starts."""
    found = []
    for start in ([1.0, 0.5, 1.0], [3.0, 1.0, 2.0], [5.0, 0.2, 1.5]):
        bounds = [(0.2, 6.0), (-5, 8), (0, 10), (None, None)]
        if measure is np.max:
            each = {"type": "ineq", "fun": lambda z: z[3] - exact_costs(z[0], z[1:3])}
            first = [*start, exact_costs(start[0], np.array(start[1:])).max()]
            one = minimize(lambda z: z[3], first, bounds=bounds, constraints=each, method="SLSQP")
        else:
            one = minimize(lambda z: measure(exact_costs(z[0], z[1:3])), start, bounds=bounds[:3])
        found.append((float(measure(exact_costs(one.x[0], one.x[1:3]))), one.x[0], one.x[1:3]))
    return min(found, key=lambda one: one[0])
