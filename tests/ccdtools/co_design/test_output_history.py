"""Policies of measured outputs, learned with the design."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    CoDesignConfig,
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    Learned,
    Measurement,
    Nested,
    Plant,
    QuadraticObjective,
    RandomStarts,
    Scenario,
    WorstCase,
    codesign,
    discretise,
    saturated_lqr,
)
from ccdtools.co_design import closed_loop_returns, filter_problem, history_problem, kalman_filter, previewed_problem
from ccdtools.controllers import History, Observed
from ccdtools.disturbances import Cases
from ccdtools.estimation import CubatureKalmanFilter
from ccdtools.plants import BlackBox

M = 6


def stated(outputs, measurement=None, *, stiff=False, **changes):
    """A mass on a spring, linear or stiffening, whose given outputs are measured."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    force = p[0] * x[0] + p[1] * x[1] + (0.5 * x[0] ** 3 if stiff else 0)
    plant = Plant(
        x, u, w, p, [x[1], -force + u + w], DesignSpace(["k", "c"], [0.5, 0.1], [3.0, 2.0]), dt=0.1,
        outputs=outputs(x, u, p, force),
    )  # fmt: skip
    own = {
        "X": ([-20, -20], [20, 20]), "U": (-3, 3), "scenarios": FixedStart([1.0, 0.0], Gaussian([1.0])),
        "objective": QuadraticObjective(np.diag([1, 0.1]), [[0.1]], design_cost=lambda p: 0.2 * p[0] ** 2 + p[1]),
        "steps": 80, "limit_tolerance": "off",
        "measurement": Measurement(plant, noise=[0.1]) if measurement is None else measurement,
    }  # fmt: skip
    model = discretise(plant, X=own["X"], U=own["U"], method="rk4") if stiff else discretise(plant)
    return CoDesignProblem(model, **(own | changes))


def simulated(problem):
    """The same problem behind a simulator."""
    model = problem.model
    box = BlackBox(lambda x, u, w, p: model.stepper(p, batch=len(x))(x, u, w), nx=2, nu=1, nw=1, dt=0.1,
                   design=problem.design, batched=True)  # fmt: skip
    return replace(problem, model=box)


def of_kind(kind, stiff):
    """The problem with one of several sensors, or with another kind of model."""
    problem = stated((lambda x, u, p, f: [u - f]) if kind == "of design" else (lambda x, u, p, f: [x[0]]), stiff=stiff)
    if kind == "simulator":
        return simulated(problem)
    if kind == "function":
        return replace(problem, measurement=Measurement(lambda x, u, p: x[:, :1] * p[0] - u, noise=[0.1]))
    if kind == "collocation":
        model = discretise(problem.model.plant, X=problem.X, U=problem.U, method="collocation", sampling_guard="ignore")
        return replace(problem, model=model)
    return problem


KINDS = pytest.mark.parametrize(
    ("kind", "stiff"),
    [("state", False), ("state", True), ("of design", False), ("of design", True), ("simulator", False),
     ("function", True), ("collocation", True)],
)  # fmt: skip


@pytest.mark.long
@KINDS
def test_the_states_are_the_plant_and_what_its_sensor_and_its_input_were(kind, stiff, rng):
    problem = of_kind(kind, stiff)
    longer = history_problem(problem, M)
    p, x = np.array([1.3, 0.4]), rng.standard_normal((4, 2))
    h = problem.measurement.at(2, 1, p).of
    step, own = longer.model.stepper(p, batch=4), problem.model.stepper(p, batch=4)
    z = np.hstack([x, np.zeros((4, 2 * M))])
    seen, applied = [np.zeros((4, 1))] * M, [np.zeros((4, 1))] * M
    for _ in range(9):
        u, w, v = rng.standard_normal((3, 4, 1))
        x = own(x, u, w)
        seen, applied = [h(x, u) + v, *seen[:-1]], [u, *applied[:-1]]
        z = np.asarray(step(z, u, np.hstack([w, v])))
        np.testing.assert_allclose(z, np.hstack([x, *seen, *applied]), rtol=1e-12, atol=1e-12)


@pytest.mark.long
@KINDS
def test_the_states_are_the_plant_and_what_its_filter_believes(kind, stiff, rng):
    problem = replace(of_kind(kind, stiff), scenarios=FixedStart([1.0, 0.0], Gaussian([1.0], mean=[0.5])))
    longer = filter_problem(problem)
    p = np.array([1.3, 0.4])
    h = problem.measurement.at(2, 1, p).of
    known = kalman_filter(problem, p)
    if kind != "simulator":
        told = problem.mean_disturbance, problem.moments[2]
        noise = {"W": np.zeros(2), "V": known.V, "P0": np.diag([0.2, 0.1]), "disturbance": told}
        known = CubatureKalmanFilter(problem.model, problem.measurement, design=p, **noise)
    step, own = longer.model.stepper(p, batch=4), problem.model.stepper(p, batch=4)
    x = rng.standard_normal((4, 2))
    belief = known.update(known.start(4), rng.standard_normal((4, 1)), np.zeros((4, 1)))

    def row():
        """States of the longer model."""
        triangle = np.broadcast_to(belief.covariance, (4, 2, 2))[:, [0, 0, 1], [0, 1, 1]]
        return np.hstack([x, np.ones((4, 1)), triangle, belief.mean])

    z = row()
    for _ in range(6):
        u, w, v = 0.3 * rng.standard_normal((3, 4, 1))
        x = own(x, u, w)
        belief = known.update(known.predict(belief, u), h(x, u) + v, u)
        z = np.asarray(step(z, u, np.hstack([w, v])))
        np.testing.assert_allclose(z, row(), rtol=1e-6, atol=1e-9)
    at_first = longer.scenarios.sample(4, 3, rng)[0]  # of a start that is known
    np.testing.assert_allclose(at_first, np.tile([1, 0, 1, 0, 0, 0, 1, 0], (4, 1)), atol=1e-12)


class Undisturbed:
    """Random starts and nothing else."""

    def sample(self, runs, steps, rng):
        """Initial states and disturbances."""
        return rng.standard_normal((runs, 2)), np.zeros((runs, steps, 0))


def test_without_disturbances_the_estimate_comes_near_the_state():
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p", 2)
    box = DesignSpace(["k", "c"], [0.5, 0.1], [3.0, 2.0])
    plant = Plant(x, u, None, p, [x[1], -p[0] * x[0] - p[1] * x[1] + u], box, dt=0.1, outputs=[x[0]])
    limits = {"X": lambda p: ([-20 - p[0], -20], [20 + p[0], 20]), "U": lambda p: (-3 - p[1], 3 + p[1])}
    sensor = Measurement(plant, noise=[0.1])
    problem = replace(
        stated(lambda x, u, p, f: [x[0]]),
        model=discretise(plant),
        scenarios=Undisturbed(),
        measurement=sensor,
        **limits,
    )
    longer = filter_problem(problem)
    z, w = longer.scenarios.sample(200, 80, np.random.default_rng(0))
    step = longer.model.stepper(problem.design.lower, batch=200)
    errors = []
    for k in range(80):
        z = np.asarray(step(z, np.zeros((200, 1)), w[:, k]))
        errors.append(np.sqrt(np.mean((z[:, -2:] - z[:, :2]) ** 2)))
    assert errors[-1] < 0.05 < errors[0]
    low, high = longer.X.bounds(np.array([2.0, 1.0]))
    np.testing.assert_allclose([low[:2], high[:2]], [[-22, -20], [22, 20]])


@pytest.mark.long
def test_a_law_of_the_estimate_returns_as_much_as_behind_its_filter():
    problem = stated(lambda x, u, p, f: [u - f], stiff=True, scenarios=RandomStarts(Gaussian([1, 1]), Gaussian([1.0])))
    p = problem.design.centre
    law = saturated_lqr(problem, p)
    known = kalman_filter(problem, p)
    noise = {"W": known.W, "V": known.V, "P0": known.P0, "x0": known.x0}
    deployed = Observed(law, CubatureKalmanFilter(problem.model, problem.measurement, design=p, **noise))
    behind, of_estimate = (
        closed_loop_returns(one, controller, p, np.random.default_rng(0), runs=200).summary
        for one, controller in ((problem, deployed), (filter_problem(problem), lambda z: law(z[:, -2:])))
    )
    assert of_estimate.mean == pytest.approx(behind.mean, abs=behind.ci95[1] - behind.ci95[0])


@pytest.mark.check
def test_a_policy_begins_at_lqg_and_is_handed_out_behind_its_filter():
    problem = stated(lambda x, u, p, f: [x[0]], stiff=True, steps=40)
    config = CoDesignConfig(iterations=2, starts=1, pathwise_runs=16, evaluation_runs=64)
    found = codesign(problem, method=Learned(config=config), rng=np.random.default_rng(0))
    assert isinstance(found.controller, Observed)
    assert isinstance(found.controller.estimator, CubatureKalmanFilter)
    assert found.controller.needs == {"output", "last_input"}
    assert found.policy.nx == 2
    mine, lqg = (
        closed_loop_returns(problem, controller, found.design, np.random.default_rng(0)).summary.mean
        for controller in (found.controller, saturated_lqr(problem, found.design))
    )
    assert mine > lqg - 0.02 * abs(lqg)


@pytest.mark.check
@pytest.mark.parametrize("history", [M, None, 0])
def test_a_policy_of_outputs_and_design_learn_together_and_are_measured_behind_the_sensor(history):
    problem = stated(lambda x, u, p, f: [x[0]])
    config = CoDesignConfig(iterations=40, starts=1, pathwise_runs=128, evaluation_runs=256)
    found = codesign(problem, method=Learned(history=history, config=config), rng=np.random.default_rng(0))
    assert isinstance(found.controller, History if history else Observed)
    assert found.controller.needs == {"output", "last_input"}
    lqg = codesign(problem, method=Nested("lqg"), rng=np.random.default_rng(0))
    mine, its = found.closed_loop.summary, lqg.closed_loop.summary
    assert mine.mean > its.mean - 0.02 * abs(its.mean)
    x0, w = problem.scenarios.sample(400, 80, np.random.default_rng(5))
    run = Scenario(problem.model, x0, w, output=problem.measurement, seed=1).run(found.controller, design=found.design)
    own = run.returns(problem.objective)
    spread = 3 * own.std() / 20
    assert own.mean() == pytest.approx(mine.mean, abs=spread + mine.ci95[1] - mine.ci95[0])


@pytest.mark.check
@pytest.mark.parametrize(("by", "history"), [("pathwise", 2), ("ppo", 2), ("pathwise", None)])
def test_a_policy_of_outputs_is_learned_on_a_simulator_as_on_its_plant(by, history):
    open_plant = stated(lambda x, u, p, f: [x[0]])
    config = CoDesignConfig(iterations=3, starts=1, pathwise_runs=16, evaluation_runs=64)
    own, found = (
        codesign(problem, method=Learned(by=by, history=history, config=config), rng=np.random.default_rng(0))
        for problem in (open_plant, simulated(open_plant))
    )
    np.testing.assert_allclose(found.design, own.design, rtol=1e-3)
    assert found.closed_loop.summary.mean == pytest.approx(own.closed_loop.summary.mean, rel=1e-3)


@pytest.mark.check
@pytest.mark.usefixtures("brief")
@pytest.mark.parametrize("history", [M, None])
def test_the_design_follows_the_gradient_through_outputs_that_depend_on_it(history):
    problem = stated(lambda x, u, p, f: [u - f])
    config = CoDesignConfig(iterations=10, starts=1, pathwise_runs=128, evaluation_runs=256)
    found = Learned(history=history, config=config).run(problem, problem.design.centre, np.random.default_rng(0))
    assert found.gradients.trusted


@pytest.mark.parametrize(
    ("measurement", "words"),
    [
        (Measurement(lambda x: x[:, :1] + 1, noise=[0.1]), "not 0 at rest"),
        (Measurement(np.eye(2)[:1], noise=None), "without noise"),
    ],
)
def test_sensors_that_no_history_can_be_made_of_are_refused(measurement, words):
    with pytest.raises(InputError, match=words):
        history_problem(stated(lambda x, u, p, f: [x[0]], measurement), M)


@pytest.mark.check
@pytest.mark.usefixtures("brief")
def test_the_first_policy_of_outputs_is_the_same_in_any_unit():
    def own(unit):
        """Return of the first policy, with lengths in this unit."""
        x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
        force = p[0] * x[0] / unit + p[1] * x[1] / unit
        box = DesignSpace(["k", "c"], [0.5, 0.1], [3.0, 2.0])
        plant = Plant(x, u, w, p, [x[1], unit * (u + w - force)], box, dt=0.1, outputs=[x[0]])
        room = np.array([20.0, 20.0]) * unit
        problem = CoDesignProblem(
            discretise(plant), X=(-room, room), U=(-3, 3), steps=20, limit_tolerance="off",
            objective=QuadraticObjective(np.diag([1, 0.1]) / unit**2, [[0.1]]),
            scenarios=FixedStart([unit, 0.3 * unit], Gaussian([1.0])),
            measurement=Measurement(plant, noise=[0.1 * unit]),
        )  # fmt: skip
        config = CoDesignConfig(
            iterations=1, starts=1, pathwise_runs=8, evaluation_runs=64, design_rate=0, policy_rate=0
        )
        method = Learned(history=2, config=config)
        return codesign(problem, method=method, rng=np.random.default_rng(0)).closed_loop.summary.mean

    assert own(1e-9) == pytest.approx(own(1.0), rel=1e-3)


def test_what_no_history_can_be_learned_from_is_told():
    problem = stated(lambda x, u, p, f: [x[0]])
    given = {"rng": np.random.default_rng(0)}
    for one, judge in ((problem, problem), (replace(problem, measurement=None), problem)):
        with pytest.raises(InputError, match="judge"):
            codesign(one, method=Learned(judge=judge), **given)
    with pytest.raises(InputError, match="outputs and inputs"):
        codesign(history_problem(problem, 2), method=Learned(), **given)
    with pytest.raises(InputError, match="not 0 at rest"):
        history_problem(stated(lambda x, u, p, f: [x[0] + p[0]]), 2)
    for of_nothing in (history_problem, lambda problem, _: filter_problem(problem)):
        with pytest.raises(InputError, match="problem: got 3"):
            of_nothing(3, 2)
        with pytest.raises(InputError, match="measurement"):
            of_nothing(replace(problem, measurement=None), 2)
    with pytest.raises(InputError, match="measurement"):
        previewed_problem(problem, 3)


@pytest.mark.check
def test_a_policy_of_the_state_is_trained_at_every_design_where_the_state_is_measured():
    problem = stated(lambda x, u, p, f: [x[0]], steps=10)
    found = codesign(problem, method=Nested("rl", evaluations=1, runs=8), rng=np.random.default_rng(0))
    assert found.controller.needs == {"output", "last_input"}


def test_a_history_asks_for_a_measurement_and_a_length():
    problem = stated(lambda x, u, p, f: [x[0]])
    with pytest.raises(InputError, match="length"):
        history_problem(problem, 0)
    with pytest.raises(InputError, match="measurement"):
        history_problem(history_problem(problem, 2), 2)


def test_a_worst_case_keeps_its_cases_where_policies_see_outputs():
    cases = FixedStart([1.0, 0.0], Cases.of([-0.2, 0.2]))
    problem = stated(lambda x, u, p, f: [x[0]], scenarios=cases, risk=WorstCase())
    longer = history_problem(problem, 2)
    w = longer.scenarios.sample(6, 80, np.random.default_rng(0))[1]
    assert longer.risk.cases == 2
    np.testing.assert_allclose(w[:, :, 0], np.tile([[-0.2], [0.2]], (3, 80)), atol=1e-12)
