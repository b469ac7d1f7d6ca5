"""From a log to a controller that keeps its limits, with the price; the filter and the sets that know W."""

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    Plant,
    QuadraticObjective,
    deploy,
    discretise,
    linear_mpc,
    saturated_lqr,
)
from ccdtools.co_design import admissible_inputs, closed_loop_returns, feasible_sets
from ccdtools.controllers import Filtered
from ccdtools.twin import DigitalTwin, disturbance_set, robust_mpc
from invariant_sets import Polytope
from mpc import InfeasibleError, Status

P = np.array([3.0])


@pytest.fixture(scope="module")
def problem(illustrative):
    return illustrative.problem()


@pytest.fixture(scope="module")
def log(illustrative, problem):
    real, rng = illustrative.real, np.random.default_rng(0)
    return deploy(real.plant, saturated_lqr(problem, P), P, real.disturbance.sample(60, 100, rng), x0=illustrative.x0)


@pytest.fixture(scope="module")
def found(problem, log):
    return robust_mpc(problem, P, log, rng=np.random.default_rng(1), level=0.95, runs=20)


def stepped(problem, W, law, x, rng, steps=60):
    """States of a loop on the linear model with errors at vertices of W, stepped here."""
    A, B, _ = problem.model.matrices(P)
    states = []
    for _ in range(steps):
        x = x @ A.T + law(x) @ B.T + W.vertices[rng.integers(len(W.vertices), size=len(x))]
        states.append(x)
    return np.array(states)


def test_the_controller_keeps_its_limits_under_errors_of_the_set(found, problem):
    rng = np.random.default_rng(2)
    starts = found.robust_set.set.sample(40, rng=rng)
    starts = np.array([x for x in starts if found.controller.solve(x).status is Status.SOLVED])
    assert len(starts) > 30
    low, high = problem.state_limits(P).bounding_box()
    states = stepped(problem, found.W, found.controller, starts, rng)
    assert (states >= low - 1e-8).all()
    assert (states <= high + 1e-8).all()


def test_the_price_is_the_difference_on_common_runs(found, problem):
    again = closed_loop_returns(problem, found.controller, P, np.random.default_rng(0), runs=20)
    assert len(again.values) == len(found.tightened.values) == len(found.nominal.values) == 20
    assert found.price.mean == pytest.approx(np.mean(found.nominal.values - found.tightened.values), abs=1e-9)
    assert "at a return of" in str(found)


def test_w_holds_what_the_linearisation_of_a_nonlinear_model_leaves_out():
    x, u, w = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w")
    k, space = ca.SX.sym("k"), DesignSpace(["k"], lower=[0.5], upper=[2.0], units=["N/m"])
    hardens = ca.vertcat(x[1], -k * x[0] - 20 * x[0] ** 3 - 0.4 * x[1] + u + w)
    plant = Plant(x, u, w, k, hardens, space, dt=0.05)
    X, U, gusts = ([-1, -1], [1, 1]), (-2, 2), Gaussian([0.02])
    objective = QuadraticObjective(np.diag([10.0, 1.0]), [[0.1]])
    own = CoDesignProblem(discretise(plant, X=X, U=U, W=(-0.1, 0.1)), X=X, U=U, objective=objective,
                          scenarios=FixedStart([0.2, 0.0], gusts), steps=20)  # fmt: skip
    rng = np.random.default_rng(0)
    starts = rng.uniform(-0.8, 0.8, (40, 2))
    logged = deploy(plant, saturated_lqr(own, [1.0]), [1.0], gusts.sample(40, 100, rng), x0=starts)
    robust = robust_mpc(own, [1.0], logged, rng=rng, level=0.95, runs=3)
    A, B, _ = own.model.matrices([1.0])
    errors = logged.states[:, 1:] - logged.states[:, :-1] @ A.T - logged.inputs @ B.T
    assert robust.W.contains(errors.reshape(-1, 2)).mean() > 0.92


def test_logs_of_several_designs_are_carried_to_the_newest(problem, illustrative, log):
    law, rng = saturated_lqr(problem, P), np.random.default_rng(5)
    draws = illustrative.real.disturbance.sample(30, 100, rng)
    elsewhere = deploy(illustrative.real.plant, law, [2.0], draws, x0=illustrative.x0)
    twin = DigitalTwin(problem.model).remembering(elsewhere).remembering(log)
    W = disturbance_set(twin.carried(), level=0.95)
    assert 0.9 < W.contains(twin.logs[1].e_next.reshape(-1, 2)).mean() < 0.99
    assert robust_mpc(problem, P, twin.carried(), rng=rng, level=0.95, runs=2).W.equals(W, tol=1e-9)


def test_the_robust_set_is_part_of_the_nominal_one_and_shrinks_with_the_level(found, problem):
    assert found.robust_set.set.is_subset(found.nominal_set.set, tol=1e-6)
    assert 0 < found.volume_left < 1
    wider = feasible_sets(problem, W=found.W.scale(1.2)).at(P)
    assert wider.is_subset(found.robust_set.set, tol=1e-6)


def test_w_as_a_function_of_the_design_is_asked_at_each(problem, found):
    sets = feasible_sets(problem, W=lambda p: found.W.scale(float(p[0]) / P[0]))
    assert sets.at(P).equals(found.robust_set.set)
    assert sets.at([1.5]).equals(feasible_sets(problem, W=found.W.scale(0.5)).at([1.5]))


@pytest.mark.parametrize("known", [True, False])
def test_the_filter_that_knows_w_keeps_any_law_within_x_and_the_other_does_not(known, found, problem):
    rng = np.random.default_rng(3)
    filtered = Filtered(lambda x: np.ones((len(x), 1)), admissible_inputs(problem, P, W=found.W if known else None))
    states = stepped(problem, found.W, filtered, found.robust_set.set.sample(50, rng=rng), rng)
    low, high = problem.state_limits(P).bounding_box()
    kept = bool(((states >= low - 1e-7) & (states <= high + 1e-7)).all())
    assert kept == known
    assert filtered.counts.changed > 0
    assert not known or filtered.counts.helpless == 0


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        ({"design": [2.0]}, InputError, "carried"),
        ({"level": 0.99999}, InputError, "at least"),
        ({"rng": 1}, InputError, "rng"),
        ({"problem": 1}, InputError, "problem"),
        ({"logs": []}, InputError, "logs"),
    ],
)
def test_wrong_calls_are_named(change, error, says, problem, log):
    given = {"problem": problem, "design": P, "logs": log, "rng": np.random.default_rng(0)} | change
    with pytest.raises(error, match=says):
        robust_mpc(given.pop("problem"), given.pop("design"), given.pop("logs"), **given)


def test_a_filter_for_errors_that_nothing_can_hold_is_refused(problem):
    with pytest.raises(InputError, match="no control invariant set"):
        admissible_inputs(problem, P, W=Polytope.from_bounds([-5, -5], [5, 5]))
    with pytest.raises(InfeasibleError, match="Shrink W"):
        linear_mpc(problem, P, W=Polytope.from_bounds([-5, -5], [5, 5]))


@pytest.mark.check
def test_a_small_sample_of_the_benchmark_finds_no_violation(capsys):
    from robust_mpc import main

    main(["dc_servo"], draws=500, leaves=20)
    row = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("| dc_servo | 0."))
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[4] == "0; 0"
    assert cells[7] == "0"
