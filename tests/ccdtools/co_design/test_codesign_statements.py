"""What `codesign` says of statements that cannot be met in whole or in part: in the status, by name, or by an error."""

import json
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from constrained_plants import CASES
from small_plants import clone_of, mass
from test_methods_at_the_edge import unreached

import ccdtools as cc

TRAJECTORIES = [cc.Simultaneous(runs=2, starts=1), cc.Nested("trajectory", runs=2, starts=1),
                cc.Sequential("open_loop", starts=1)]  # fmt: skip


def codesigned(problem, method, seed=0, **given):
    """The result of a method."""
    return cc.codesign(problem, method=method, rng=np.random.default_rng(seed), **given)


def weak(illustrative):
    """An actuator that cannot stop the second state within its limit at any design."""
    return replace(
        illustrative.problem(), X=([-10, -2], [5, 0.05]), U=([-0.05], [0.05]), steps=20,
        scenarios=cc.FixedStart([-1, -0.5], cc.Gaussian([0.1, 0.4])),
    )  # fmt: skip


@pytest.mark.long
@pytest.mark.quick(1)
@pytest.mark.parametrize("method", TRAJECTORIES, ids=lambda method: method.name)
def test_limits_that_no_design_keeps_are_named_by_every_method_of_trajectories(method, illustrative):
    found = codesigned(weak(illustrative), method, design=[0.5])
    text = "\n".join(found.describe())
    assert found.status.name == "INFEASIBLE"
    assert "x2 ≤ 0.05" in text
    assert "u1 ≤ 0.05" in text
    assert np.isnan(found.objective)
    assert found.closed_loop is not None


@pytest.mark.long
@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_nested_trajectories_leave_a_first_design_that_cannot_keep_the_limits(unit):
    # from rest a constant force f moves a mass on a spring k to f / k and beyond: a soft spring cannot hold it in X
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    space = cc.DesignSpace(["k"], [1], [9])
    plant = cc.Plant(x, u, w, p, ca.vertcat(x[1], -p * x[0] - 2 * x[1] + u + w), space, dt=0.1)
    problem = cc.CoDesignProblem(
        cc.discretise(plant), X=([-0.5 * unit, -5 * unit], [0.5 * unit, 5 * unit]), U=([-0.1 * unit], [0.1 * unit]),
        objective=cc.QuadraticObjective(np.eye(2) / unit**2, [[1 / unit**2]], design_cost=lambda p: p), steps=60,
        scenarios=cc.FixedStart([0, 0], cc.Cases.of([2.0 * unit])),
    )  # fmt: skip
    nested, together = (
        codesigned(problem, method, design=[1.5])
        for method in (cc.Nested("trajectory", runs=1, starts=1), cc.Simultaneous(runs=1, starts=1))
    )
    # the resting place under all of the input, (2 − 0.1) / k = 0.5, is not passed by a damping of 2 / (2 √k) > 1/2
    assert together.design[0] >= 1.9 / 0.5 - 0.01
    assert nested.status.settled
    np.testing.assert_allclose(nested.design, together.design, rtol=1e-3)
    assert nested.objective == pytest.approx(together.objective, rel=1e-5)


@pytest.mark.check
def test_limits_are_named_as_the_plant_and_the_user_name_them():
    problem = replace(mass(), output_limits=cc.OutputLimits(lambda x, u, p: x[0], -0.2, 0.2, names=["travel [m]"]),
                      scenarios=cc.FixedStart([0.1, 3.0], cc.Gaussian([0.5])), U=([-0.1], [0.1]))  # fmt: skip
    for method in TRAJECTORIES[:2]:
        found = codesigned(problem, method)
        assert found.status.name == "INFEASIBLE"
        assert "travel [m] ≤ 0.2" in "\n".join(found.notes)


@pytest.mark.long
def test_a_design_that_is_infeasible_is_projected_before_it_is_measured(illustrative):
    case = CASES["two budgets"]
    problem = case.problem()
    stuck = replace(problem, X=([-0.2, -20], [20, 20]), U=([-0.01], [0.01]))
    found = codesigned(stuck, cc.Simultaneous(runs=1, starts=1), design=case.start)
    assert found.status.name == "INFEASIBLE"
    assert problem.design.violation(found.design) <= 1e-9


@pytest.mark.long
def test_a_program_that_is_stopped_says_so_and_goes_on_with_more_iterations():
    few, many = (codesigned(mass(), cc.Simultaneous(runs=2, starts=1, iterations=n)) for n in (2, 200))
    assert few.status.name == "BUDGET_SPENT"
    assert "Simultaneous.iterations" in few.status.advice
    assert any("Stopped" in note for note in few.notes)
    assert many.status.name != "BUDGET_SPENT"
    assert many.objective >= few.objective or np.isnan(few.objective)


def test_a_mistake_in_the_statement_is_not_taken_for_a_design_without_a_controller():
    x, u, w, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    plant = cc.Plant(x, u, w, p, -x + u + w, cc.DesignSpace(["b"], [0], [1]), dt=0.1)
    # convex at every design that is looked at when it is stated, but not about 0.37
    narrow = cc.CustomObjective(lambda x, u, p: (1 - 3 * ca.exp(-(((p - 0.37) / 1e-3) ** 2))) * x**2 + u**2)
    problem = cc.CoDesignProblem(
        cc.discretise(plant), X=([-5], [5]), U=([-5], [5]), objective=narrow, steps=10, limit_tolerance="off",
        scenarios=cc.FixedStart([1.0], cc.Gaussian([0.1])),
    )  # fmt: skip
    for method in (cc.Nested("lqr", starts=1), cc.Nested("riccati", starts=1), cc.Nested("mpc", starts=1, runs=2)):
        with pytest.raises(cc.InputError, match=r"stage_cost.*0\.37"):
            codesigned(problem, method, design=[0.37])


def test_a_search_of_a_plant_without_a_controller_names_the_design():
    pytest.importorskip("cma")
    with pytest.raises(cc.InputError, match=r"design: got b = .*stabilised"):
        codesigned(unreached(), cc.Search(of=lambda p: float(p[0]), evaluations=12))


@pytest.mark.long
@pytest.mark.parametrize(
    ("library", "evaluations"), [("cma", 1), ("cma", 7), ("cma", 50), ("bayesian", 1), ("bayesian", 9)]
)
def test_a_search_asks_as_often_as_it_may_and_first_at_its_start(library, evaluations):
    pytest.importorskip({"cma": "cma", "bayesian": "optuna"}[library])
    asked = []

    def measured(p):
        asked.append(p[0])
        return -((p[0] - 1.3) ** 2)

    found = codesigned(mass(), cc.Search(library, of=measured, evaluations=evaluations), design=[1.25])
    assert len(asked) == evaluations == found.evaluations
    assert asked[0] == pytest.approx(1.25)
    assert abs(found.design[0] - 1.3) <= 0.05 + 1e-9


@pytest.mark.long
@pytest.mark.parametrize("library", ["cma", "bayesian"])
def test_a_search_is_not_led_by_designs_without_a_value_however_large_costs_are(library):
    pytest.importorskip({"cma": "cma", "bayesian": "optuna"}[library])

    def measured(p):
        return np.nan if p[0] < 1.6 else -1e9 * (1 + (p[0] - 2.0) ** 2)

    found = codesigned(mass(), cc.Search(library, of=measured, evaluations=25), design=[0.3])
    assert found.design[0] == pytest.approx(2.0, abs=0.15)


def test_a_search_that_has_looked_at_random_whole_numbers_of_an_odd_range_goes_on():
    pytest.importorskip("optuna")
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    space = cc.DesignSpace(["k", "c"], [0.4, 0.1], [2.6, 2], integer=["k"])
    plant = cc.Plant(x, u, w, p, ca.vertcat(x[1], -p[0] * x[0] - p[1] * x[1] + u + w), space, dt=0.1)
    problem = replace(mass(), model=cc.discretise(plant), steps=10)
    asked = []

    def measured(p):  # which works from the fifteenth time on
        asked.append(p[0])
        return -((p[1] - 1) ** 2) if len(asked) > 14 else np.nan

    found = codesigned(problem, cc.Search("bayesian", of=measured, evaluations=18))
    assert len(asked) == found.evaluations == 18
    assert set(asked) == {1.0, 2.0}


@pytest.mark.check
def test_a_result_is_ready_for_json():
    lqr = codesigned(mass(), cc.Nested(runs=50))
    assert lqr.valleys
    plain = json.loads(json.dumps(lqr.as_dict(), allow_nan=False))
    np.testing.assert_allclose(plain["valleys"][0]["design"], lqr.valleys[0].design)
    assert plain["status"] == lqr.status.name


@pytest.mark.check
def test_what_is_learned_tells_its_return_in_closed_loop():
    problem = mass()
    config = cc.CoDesignConfig(iterations=4, runs=16, pathwise_runs=16, evaluation_runs=20, evaluate_every=2, starts=1)
    found = codesigned(problem, cc.Learned(agent=clone_of(problem), config=config))
    assert "in closed loop: " in "\n".join(found.describe())
    json.dumps(found.as_dict(), allow_nan=False)


@pytest.mark.check
def test_a_judge_of_a_method_is_what_the_closed_loop_is_measured_on():
    problem = mass()
    louder = replace(problem, scenarios=cc.FixedStart([2.0, -2.0], cc.Gaussian([0.5])))
    config = cc.CoDesignConfig(iterations=2, runs=16, pathwise_runs=16, evaluation_runs=20, evaluate_every=1, starts=1)
    agent = clone_of(problem)
    inside = codesigned(problem, cc.Learned(agent=agent, config=config, judge=louder))
    outside = codesigned(problem, "pathwise", agent=agent, config=config, judge=louder)
    np.testing.assert_array_equal(inside.closed_loop.values, outside.closed_loop.values)


def test_elasticities_of_nothing_are_nothing():
    still = cc.design_sensitivity(mass(), [1.0], [0.0, 0.0])
    np.testing.assert_array_equal(still.elasticities, [0.0])
    moving = cc.design_sensitivity(mass(), [1.0], [1.0, 0.0])
    up, down = (cc.design_sensitivity(mass(), [m], [1.0, 0.0]).cost for m in (1.001, 0.999))
    assert moving.elasticities[0] == pytest.approx((up - down) / 0.002 / moving.cost, rel=1e-4)


def test_a_design_whose_runs_are_all_lost_is_not_efficient_and_hides_no_other():
    one = codesigned(mass(), cc.Nested(runs=50, starts=1))
    found = cc.TradeOff(
        values=np.array([1.0, 2.0, 3.0]), results=(one,) * 3, designs=np.ones((3, 1)), priced=False,
        space=mass().design, design_costs=np.array([1.0, 2.0, 0.5]), control_returns=np.array([-10.0, -20.0, np.nan]),
        intervals=np.zeros((3, 2)),
    )  # fmt: skip
    np.testing.assert_array_equal(found.efficient, [True, False, False])


@pytest.mark.check
@pytest.mark.parametrize("terminal", [None, lambda x, p: p + 2 * x[0] ** 2])
def test_the_riccati_equation_counts_what_rest_costs(terminal):
    def stage(x, u, p):
        return 10 * x[0] ** 2 + x[1] ** 2 + 0.5 * u**2 + 0.7 * (p - 2.0) ** 2

    problem = replace(mass(), objective=cc.CustomObjective(stage, terminal_cost=terminal), steps=300)
    still, loop = (codesigned(problem, cc.Nested(inner, starts=1)) for inner in ("riccati", "lqr"))
    assert still.objective == pytest.approx(loop.objective, rel=0.02)
    np.testing.assert_allclose(still.design, loop.design, atol=0.05)


def test_the_riccati_equation_refuses_weights_that_are_not_those_of_the_cost():
    own = cc.CustomObjective(lambda x, u, p: x[0] ** 2 + u**2, Q=np.eye(2), R=[[3.0]])
    with pytest.raises(cc.InputError, match="weights Q and R"):
        codesigned(replace(mass(), objective=own), cc.Nested("riccati"))


@pytest.mark.long
@pytest.mark.parametrize("bounds", [(0.3, 7.9), (0.1, 6.3)])
def test_whole_numbers_of_odd_ranges_are_held_by_trajectories(bounds):
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    space = cc.DesignSpace(["k", "c"], [bounds[0], 0.1], [bounds[1], 2], integer=["k"])
    plant = cc.Plant(x, u, w, p, ca.vertcat(x[1], -p[0] * x[0] - p[1] * x[1] + u + w), space, dt=0.1)
    problem = replace(mass(), model=cc.discretise(plant), steps=10)
    for number in range(1, 7):
        found = codesigned(problem, cc.Nested("trajectory", runs=1, starts=1, evaluations=3), design=[number, 1.0])
        assert found.design[0] == number


@pytest.mark.long
@pytest.mark.parametrize("method", [cc.Nested(runs=32), cc.Nested("mpc", runs=4, horizon=5)], ids=lambda one: one.name)
def test_a_whole_number_at_a_bound_that_the_return_rises_across_holds_the_design(method):
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    space = cc.DesignSpace(["k", "turns"], [0.5, 1.3], [4.0, 4.9], integer=["turns"])
    plant = cc.Plant(x, u, w, p, ca.vertcat(x[1], -p[0] * x[0] - x[1] + (1 + 0.01 * p[1]) * u + w), space, dt=0.1)
    given = replace(mass(), model=cc.discretise(plant), steps=20)
    prices = {2: lambda n: 9 * n, 3: lambda n: 9 * (n - 3) ** 2, 4: lambda n: -9 * n}
    for number, price in prices.items():
        objective = cc.QuadraticObjective(
            np.eye(2), [[0.1]], design_cost=lambda p, price=price: 9 * (p[0] - 1.5) ** 2 + price(p[1])
        )
        found = codesigned(replace(given, objective=objective), method)
        assert found.design[1] == number
        held = number != 3
        assert found.status.name == ("AT_BOUND" if held else "CONVERGED")
        assert found.multipliers.get("turns", 0.0) == pytest.approx(9.0 if held else 0.0, abs=0.5)
