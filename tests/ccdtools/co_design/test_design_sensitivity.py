"""How cost and law of a problem's controllers change with its design: by differences of the controllers themselves."""

import actuated_plants
import casadi as ca
import numpy as np
import pytest
from differences import distance, slopes

from ccdtools import (
    CoDesignProblem,
    CustomObjective,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    OutputLimits,
    Plant,
    QuadraticObjective,
    design_sensitivity,
    discretise,
)
from ccdtools.plants import SampledModel
from ccdtools.plants.library import pendulum_on_cart
from mpc import LinearMPC, NotStabilisableError, SensitivityStatus, lqr
from mpc.optimal_control import NonlinearMPC


def steps_of(problem):
    """Steps of the differences, of the size of the box of designs."""
    return 1e-4 * (problem.design.upper - problem.design.lower)


def lqr_cost(problem, x):
    """Cost of LQR from x, of the design."""
    return lambda p: x @ lqr(*problem.model.matrices(p)[:2], **problem.weights(p).keywords())[1] @ x


def mpc_plan(problem, x, horizon):
    """Cost and inputs of linear MPC from x, of the design."""

    def plan(p):
        A, B, _ = problem.model.matrices(p)
        own = problem.weights(p).keywords()
        limits = {"X": problem.state_limits(p), "U": problem.input_limits(p)}
        found = LinearMPC(A, B, **own, horizon=horizon, **limits).solve(x)
        assert found.feasible
        return np.r_[found.cost, found.inputs.ravel()]

    return plan


def test_lqr_of_the_case_studies(study):
    problem = study.problem()
    p = problem.design.lower + 0.4 * (problem.design.upper - problem.design.lower)
    x = 0.3 * problem.state_scale
    found = design_sensitivity(problem, p, x)
    assert found.cost == pytest.approx(lqr_cost(problem, x)(p))
    assert distance(found.cost_by_design, slopes(lqr_cost(problem, x), p, steps_of(problem))) < 1e-6
    gains = slopes(lambda q: -lqr(*problem.model.matrices(q)[:2], **problem.weights(q).keywords())[0] @ x, p,
                   steps_of(problem))  # fmt: skip
    assert distance(found.input_by_design, gains) < 1e-6
    assert found.elasticities == pytest.approx(found.cost_by_design * p / found.cost)


def slow(p):
    """Bounds of the states: the design says how fast it may go, and which way faster."""
    return ca.vertcat(-2.5, -0.4 - 0.1 * p[0] ** 2), ca.vertcat(2.5, 0.6 + 0.2 * p[0])


@pytest.mark.parametrize(
    ("X", "x", "kind"), [(actuated_plants.room, [1.8, 0.3], "input"), (slow, [1.2, 0.0], "state"),
                         (slow, [-1.2, 0.1], "state")]
)  # fmt: skip
def test_mpc_whose_limits_move_with_the_design(X, x, kind):
    problem = actuated_plants.native(X=X, U=actuated_plants.bounds)
    x = np.array(x)
    p = np.array([0.9])
    found = design_sensitivity(problem, p, x, controller="mpc", horizon=15)
    assert found.status is SensitivityStatus.SMOOTH
    assert kind in {label.kind for label in found.detail.active}
    expected = slopes(mpc_plan(problem, x, 15), p, [1e-5])
    assert distance(found.cost_by_design, expected[0]) < 1e-5
    assert distance(found.detail.inputs_by_parameters.reshape(-1, 1), expected[1:]) < 1e-5
    assert distance(found.input_by_design, expected[1:2]) < 1e-5


def test_weights_that_depend_on_the_design():
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    plant = Plant(x, u, w, p, ca.vertcat(x[1], (-p[1] * x[0] + u + w) / p[0]), DesignSpace(["m", "k"], [1, 1], [3, 9]),
                  dt=0.1)  # fmt: skip
    objective = CustomObjective(lambda x, u, p: ((u - p[1] * x[0]) / p[0]) ** 2 + p[0] * ca.sumsqr(x) + 0.1 * u**2)
    problem = CoDesignProblem(
        discretise(plant), X=([-2, -4], [2, 4]), U=(-3, 3), objective=objective,
        scenarios=FixedStart([1.0, -0.5], Gaussian([0.1])),
    )  # fmt: skip
    design, x0 = np.array([1.7, 4.0]), np.array([1.0, -0.5])
    found = design_sensitivity(problem, design)
    assert found.x0 == pytest.approx(x0)
    assert distance(found.cost_by_design, slopes(lqr_cost(problem, x0), design, [1e-3, 1e-3])) < 1e-6
    planned = design_sensitivity(problem, design, controller="mpc", horizon=12)
    assert distance(planned.cost_by_design, slopes(mpc_plan(problem, x0, 12), design, [1e-4, 1e-4])[0]) < 1e-5


@pytest.mark.check
def test_on_a_linear_plant_nonlinear_mpc_changes_as_linear_mpc_does():
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    dynamics = ca.vertcat(x[1], (-2 * x[0] - p[1] * x[1] + u + w) / p[0])
    plant = Plant(x, u, w, p, dynamics, DesignSpace(["m", "d"], [0.5, 0.1], [2.0, 0.6]), dt=0.1)

    def problem(model):
        return CoDesignProblem(
            model, X=([-1, -0.8], [1, 0.8]), U=(-2, 2), objective=QuadraticObjective(np.diag([5.0, 1.0]), [[0.1]]),
            scenarios=FixedStart([0.5, 0.0], Gaussian([0.2])),
        )  # fmt: skip

    exact, sampled = problem(discretise(plant)), problem(SampledModel(plant, 0.1, "rk4", 32))
    p, x = [0.8, 0.3], [0.9, 0.2]
    linear = design_sensitivity(exact, p, x, controller="mpc")
    assert linear.detail.active
    for found in (
        design_sensitivity(exact, p, x, controller="nmpc"), design_sensitivity(sampled, p, x, controller="nmpc"),
        design_sensitivity(sampled, p, x, controller="mpc"),
    ):  # fmt: skip
        assert found.cost_by_design == pytest.approx(linear.cost_by_design, rel=1e-6)
        assert found.input_by_design == pytest.approx(linear.input_by_design, rel=1e-6, abs=1e-8)
        assert found.input_by_state == pytest.approx(linear.input_by_state, rel=1e-6)


@pytest.mark.check
def test_nonlinear_mpc_of_a_pendulum_on_a_cart():
    X, U = ([-2.0, -4.0, -1.2, -6.0], [2.0, 4.0, 1.2, 6.0]), (-10.0, 10.0)
    model = discretise(pendulum_on_cart(), X=X, U=U, W=(-0.6, 0.6))
    Q, R = np.diag([1.0, 0.1, 10.0, 0.1]), [[0.1]]
    start = np.array([0.0, 0.0, 0.5, 0.0])
    problem = CoDesignProblem(
        model, X=X, U=U, objective=QuadraticObjective(Q, R), scenarios=FixedStart(start, Gaussian([0.2]))
    )
    p = problem.design.lower + 0.5 * (problem.design.upper - problem.design.lower)
    found = design_sensitivity(problem, p, controller="nmpc")
    assert found.detail.active
    x, u, q = ca.MX.sym("x", 4), ca.MX.sym("u"), ca.MX.sym("p", problem.design.dim)
    step = ca.Function("step", [x, u, q], [model.step(x, u, ca.DM.zeros(model.nw), q)], ["x", "u", "p"], ["value"])

    def cost(design):
        controller = NonlinearMPC(step, 4, 1, Q=Q, R=R, horizon=20, X=X, U=U, p=design)
        return controller.solve(start, start=found.detail.plan).cost

    assert distance(found.cost_by_design, slopes(cost, p, 10 * steps_of(problem))) < 1e-5


def test_it_prints_what_matters():
    problem = actuated_plants.native(U=actuated_plants.bounds)
    text = repr(design_sensitivity(problem, [1.0]))
    assert text.startswith("DesignSensitivity(cost=")
    assert "by design: b: " in text


def test_bad_input_is_named():
    problem = actuated_plants.native(U=actuated_plants.bounds)
    with pytest.raises(InputError, match="controller: got 'pid'"):
        design_sensitivity(problem, [1.0], controller="pid")
    with pytest.raises(InputError, match="problem: got"):
        design_sensitivity("problem", [1.0])
    with pytest.raises(InputError, match="design"):
        design_sensitivity(problem, [100.0])
    with pytest.raises(InputError, match="x0"):
        design_sensitivity(problem, [1.0], [1.0, 2.0, 3.0])
    with pytest.raises(InputError, match="x0: got"):
        design_sensitivity(problem, [1.0], [1.0, np.nan])
    with pytest.raises(InputError, match="horizon"):
        design_sensitivity(problem, [1.0], controller="mpc", horizon=0)


def test_limits_of_outputs_are_refused_by_mpc():
    problem = actuated_plants.native(
        U=actuated_plants.bounds, output_limits=OutputLimits(lambda x, u, p: x[0] + x[1], -5, 5)
    )
    assert design_sensitivity(problem, [1.0]).cost > 0
    with pytest.raises(InputError, match="limits of outputs"):
        design_sensitivity(problem, [1.0], controller="mpc")


def test_designs_that_cannot_be_stabilised_are_named():
    x, u, w, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    plant = Plant(x, u, w, p, 0.5 * x + p * u + w, DesignSpace(["b"], [0.0], [1.0]), dt=0.1)
    problem = CoDesignProblem(
        discretise(plant), X=(-5, 5), U=(-1, 1), objective=QuadraticObjective([[1.0]], [[1.0]]),
        scenarios=FixedStart([1.0], Gaussian([0.1])),
    )  # fmt: skip
    with pytest.raises(NotStabilisableError, match="cannot be stabilised"):
        design_sensitivity(problem, [0.0])
