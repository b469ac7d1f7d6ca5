"""Co-design with sensors in the problem."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from ccdtools import (
    CoDesignProblem,
    CustomObjective,
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
from ccdtools.co_design import kalman_filter

BOX = DesignSpace(["k", "c"], [0.5, 0.1], [3.0, 2.0])


def mass(box=BOX, model=None, **changes):
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
    return CoDesignProblem(discretise(plant) if model is None else model, **(stated | changes))


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


@pytest.mark.long
@pytest.mark.parametrize("mean", [0.0, 1.5])
def test_the_objective_is_the_mean_return_of_the_loop_with_its_filter(mean):
    problem = mass(steps=60, scenarios=FixedStart([1.0, 0.0], Gaussian([1.0], mean=[mean])))
    found = codesign(problem, method=Nested("lqg"), rng=np.random.default_rng(1))
    summary = found.closed_loop.summary
    assert abs(found.objective - summary.mean) < 2 * (summary.ci95[1] - summary.ci95[0])
    assert found.objective == pytest.approx(summary.mean, rel=0.03)


@pytest.mark.long
def test_lqg_acts_on_a_stated_mean_of_the_disturbance():
    narrow = DesignSpace(["k", "c"], [1.0, 1.0], [1.0001, 1.0])
    pushed, level = (mass(narrow, scenarios=FixedStart([1.0, 0.0], Gaussian([1.0], mean=[d]))) for d in (1.5, 0.0))
    own, other = (
        closed_loop_returns(
            pushed, codesign(of, method=Nested("lqg"), rng=np.random.default_rng(1)).controller, [1.0, 1.0],
            np.random.default_rng(2), runs=200,
        ).values for of in (pushed, level)
    )  # fmt: skip
    gain = own - other
    assert gain.mean() > 0.1 * abs(other.mean())
    assert gain.mean() > 5 * gain.std() / len(gain) ** 0.5


@pytest.mark.check
def test_a_long_episode_costs_what_the_trace_formula_says():
    def cost(steps):
        """What LQG costs over so many steps at the first design."""
        narrow = DesignSpace(["k", "c"], [1.0, 1.0], [1.0001, 1.0])
        fixed = mass(narrow, steps=steps, objective=QuadraticObjective(np.diag([1, 0.1]), [[0.1]]))
        return -codesign(fixed, method=Nested("lqg"), rng=np.random.default_rng(0)).objective

    problem = mass()
    assert cost(900) - cost(600) == pytest.approx(300 * in_the_long_run(problem, np.array([1.0, 1.0])), rel=3e-3)


@pytest.mark.check
def test_noise_of_the_sensor_changes_the_design_and_pays():
    problem = mass()
    lqg = codesign(problem, method=Nested("lqg"), rng=np.random.default_rng(0))
    lqr = codesign(problem, method="nested", rng=np.random.default_rng(0))
    assert lqg.status.settled
    assert lqg.closed_loop.summary.mean > lqr.closed_loop.summary.mean + 0.3
    assert lqg.design[1] > lqr.design[1] + 0.3


@pytest.mark.check
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


@pytest.mark.parametrize("x0", [[0.1, 0.3], [1 / 3, -0.7], [12.3456, 1e-9]])
def test_a_start_that_is_known_exactly_is_known_whatever_its_digits(x0):
    found = kalman_filter(mass(scenarios=FixedStart(x0, Gaussian([1.0]))), [1.0, 1.0])
    np.testing.assert_allclose(found.x0, x0, rtol=1e-12)
    assert np.abs(found.P0).max() < 1e-20


@pytest.mark.long
def test_a_terminal_cost_is_part_of_what_lqg_costs():
    def summed(terminal):
        """Objective and mean return with and without a cost of the last state."""
        stated = CustomObjective(lambda x, u, p: x[0] ** 2 + 0.1 * u**2 + 0.01 * p[0], terminal_cost=terminal)
        found = codesign(mass(steps=20, objective=stated), method=Nested("lqg"), rng=np.random.default_rng(0))
        return found.objective, found.closed_loop.summary.mean

    cost, measured = summed(lambda x, p: 300 * x[0] ** 2 + 100 * x[1] ** 2)
    assert cost == pytest.approx(measured, rel=0.05)
    assert cost < summed(None)[0] - 5


def drive(**changes):
    """A slide whose gear costs, and whose motor saturates."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    rate = [x[1], p * u - 0.2 * x[1] + w]
    plant = Plant(x, u, w, p, rate, DesignSpace(["gear"], [0.2], [5.0]), dt=0.1, outputs=[x[0]])
    weights = QuadraticObjective(np.diag([1, 0.1]), [[0.001]], design_cost=lambda p: 10 * p[0])
    stated = {
        "X": ([-50, -50], [50, 50]), "U": (-1, 1), "scenarios": FixedStart([2.3, 0.1], Gaussian([1.0])),
        "objective": weights, "limit_tolerance": "off", "measurement": Measurement(plant, noise=[0.1]),
    }  # fmt: skip
    return CoDesignProblem(discretise(plant), **(stated | changes))


@pytest.mark.long
def test_lqg_that_forgets_saturation_is_held_against_a_loop_that_does_not():
    found = codesign(drive(), method=Nested("lqg", starts=1), rng=np.random.default_rng(0))
    assert found.status.name == "WORSE_THAN_BASELINE"
    assert any("nested LQR, behind the filter" in one.name and one.gain.mean > 0.3 for one in found.baselines)


@pytest.mark.long
def test_a_direction_of_a_sensor_is_designed_though_nothing_else_depends_on_it():
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    seen = [ca.cos(p) * x[0] + ca.sin(p) * x[1]]
    plant = Plant(x, u, w, p, [x[1], u + w], DesignSpace(["turn"], [0.0], [1.5]), dt=0.1, outputs=seen)
    problem = mass(
        model=discretise(plant), measurement=Measurement(plant, noise=[1.0]), steps=60,
        objective=QuadraticObjective(np.diag([1, 0.1]), [[0.1]]),
    )  # fmt: skip
    stated = Measurement(lambda x, p: np.cos(p) * x[:, :1] + np.sin(p) * x[:, 1:], noise=[1.0])
    np.testing.assert_allclose(
        kalman_filter(replace(problem, measurement=stated), [0.7]).C, kalman_filter(problem, [0.7]).C, atol=1e-6
    )
    found = codesign(problem, method=Nested("lqg", starts=1), design=[1.3], rng=np.random.default_rng(0))
    others = [
        closed_loop_returns(problem, saturated_lqr(problem, p), p, np.random.default_rng(9)).summary.mean
        for p in (found.design, [0.0], [0.3], [0.9], [1.5])
    ]
    assert found.status.settled
    assert others[0] >= max(others[1:]) - 0.02 * abs(others[0])
    assert others[0] > min(others) + 1


def test_outputs_are_linearised_at_rest_in_the_units_of_the_problem():
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p", 2)
    cubic = Plant(x, u, ca.SX.sym("w"), p, [x[1], u - p[0] * x[0] - p[1] * x[1]], BOX, dt=0.1, outputs=[x[0] + u**3])
    assert abs(kalman_filter(mass(measurement=Measurement(cubic, noise=[0.1])), [1.0, 1.0]).D[0, 0]) < 1e-6
    tiny = {"X": ([-1e-9, -1e-9], [1e-9, 1e-9]), "U": (-1e-9, 1e-9), "scenarios": FixedStart([0, 0], Gaussian([1e-9]))}
    bent = Measurement(lambda x, u: np.sin(1e9 * x[:, :1] + 2e9 * u), noise=[0.1])
    found = kalman_filter(mass(measurement=bent, **tiny), [1.0, 1.0])
    np.testing.assert_allclose([*found.C[0], found.D[0, 0]], [1e9, 0, 2e9], rtol=1e-6)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"measurement": Measurement(np.eye(2))}, "without noise"),
        ({"measurement": Measurement(np.eye(2), noise=np.ones((60, 2)))}, "recorded"),
        ({"measurement": Measurement(np.eye(2), noise=[1.0, 0.0])}, "measurement.*small variance"),
        ({"measurement": Measurement(np.eye(2), noise=[1.0])}, "measurement.*channels"),
        ({"measurement": Measurement(np.eye(3), noise=[1, 1, 1])}, "output"),
        ({"measurement": np.eye(2)}, "Measurement"),
        ({"hidden": -1}, "hidden"),
        ({"hidden": 2}, "hidden"),
    ],
)
def test_a_measurement_that_does_not_fit_is_refused(changes, words):
    with pytest.raises(InputError, match=words):
        mass(**changes)


@pytest.mark.long
def test_lqg_needs_a_measurement():
    with pytest.raises(InputError, match="measurement"):
        codesign(mass(measurement=None), method=Nested("lqg"), rng=np.random.default_rng(0))
