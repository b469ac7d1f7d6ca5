"""Co-design with sensors in the problem."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    Measurement,
    Nested,
    Plant,
    QuadraticObjective,
    closed_loop_returns,
    codesign,
    compare_methods,
    discretise,
    saturated_lqr,
    simulate,
)

BOX = DesignSpace(["k", "c"], [0.5, 0.1], [3.0, 2.0])


def mass(box=BOX, **changes):
    """A mass on a spring with damper, whose position is measured; stiffness and damping cost."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    plant = Plant(
        x, u, w, p, [x[1], -p[0] * x[0] - p[1] * x[1] + u + w], box, dt=0.1, outputs=[x[0]]
    )  # fmt: skip
    stated = {
        "X": ([-20, -20], [20, 20]), "U": (-50, 50), "scenarios": FixedStart([1.0, 0.0], Gaussian([1.0])),
        "objective": QuadraticObjective(
            np.diag([1, 0.1]), [[0.1]], design_cost=lambda p: 0.5 * p[0] ** 2 + p[1], episode=200
        ),
        "steps": 200, "limit_tolerance": "off", "measurement": Measurement(plant, noise=[0.1]),
    }  # fmt: skip
    return CoDesignProblem(discretise(plant), **(stated | changes))


def in_the_long_run(problem, p, noise=0.1):
    """Cost of a sample by the trace formula of two Riccati equations of SciPy."""
    A, B, E = problem.model.matrices(p)
    Q, R, _ = problem.weights(p)
    C = np.array([[1.0, 0.0]])
    P = solve_discrete_are(A, B, Q, R)
    N = solve_discrete_are(A.T, C.T, E @ E.T, np.array([[noise**2]]))
    H = R + B.T @ P @ B
    K = np.linalg.solve(H, B.T @ P @ A)
    after = N - N @ C.T @ C @ N / (C @ N @ C.T + noise**2)
    return float(np.trace(P @ E @ E.T) + np.trace(K.T @ H @ K @ after))


def test_the_objective_is_the_mean_return_of_the_loop_with_its_filter():
    problem = mass(steps=60)
    found = codesign(problem, method=Nested("lqg"), rng=np.random.default_rng(1))
    summary = found.closed_loop.summary
    assert abs(found.objective - summary.mean) < 2 * (summary.ci95[1] - summary.ci95[0])
    assert found.objective == pytest.approx(summary.mean, rel=0.03)


def test_a_long_episode_costs_what_the_trace_formula_says():
    def cost(steps):
        """What LQG costs over so many steps at the first design."""
        narrow = DesignSpace(["k", "c"], [1.0, 1.0], [1.0001, 1.0])
        fixed = mass(narrow, steps=steps, objective=QuadraticObjective(np.diag([1, 0.1]), [[0.1]]))
        return -codesign(fixed, method=Nested("lqg"), rng=np.random.default_rng(0)).objective

    problem = mass()
    assert cost(900) - cost(600) == pytest.approx(300 * in_the_long_run(problem, np.array([1.0, 1.0])), rel=3e-3)


def test_noise_of_the_sensor_changes_the_design_and_pays():
    problem = mass()
    lqg = codesign(problem, method=Nested("lqg"), rng=np.random.default_rng(0))
    lqr = codesign(problem, method="nested", rng=np.random.default_rng(0))
    assert lqg.status.settled
    assert lqg.closed_loop.summary.mean > lqr.closed_loop.summary.mean + 0.3
    assert lqg.design[1] > lqr.design[1] + 0.3


def test_every_method_is_measured_behind_the_filter_and_hands_it_out():
    table = compare_methods(mass(), ["sequential", "nested Riccati", "nested LQG"], progress=False)
    assert table.best.name == "nested LQG"
    found = codesign(mass(), method="sequential", rng=np.random.default_rng(0))
    problem = mass()
    run = simulate(
        problem.model, found.controller, x0=np.tile([1.0, 0.0], (400, 1)), steps=200, design=found.design,
        disturbance=Gaussian([1.0]), output=problem.measurement, rng=np.random.default_rng(3),
    )  # fmt: skip
    own = run.returns(problem.objective)
    low, high = found.closed_loop.summary.ci95
    assert own.mean() == pytest.approx((low + high) / 2, abs=2 * (high - low))


def test_the_filter_costs_what_the_state_would_not():
    problem = mass()
    p = np.array([1.0, 1.0])
    known = replace(problem, measurement=None)
    costs = [
        closed_loop_returns(one, saturated_lqr(one, p), p, np.random.default_rng(0)).summary.mean
        for one in (known, problem)
    ]
    assert costs[0] > costs[1] + 0.5


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"measurement": Measurement(np.eye(2))}, "without noise"),
        ({"measurement": Measurement(np.eye(3), noise=[1, 1, 1])}, "output"),
        ({"measurement": np.eye(2)}, "Measurement"),
    ],
)
def test_a_measurement_that_does_not_fit_is_refused(changes, words):
    with pytest.raises(InputError, match=words):
        mass(**changes)


def test_lqg_needs_a_measurement():
    with pytest.raises(InputError, match="measurement"):
        codesign(mass(measurement=None), method=Nested("lqg"), rng=np.random.default_rng(0))
