"""Simultaneous, sequential and black-box co-design beside nested co-design of the same problem."""

import pickle
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from constrained_plants import CASES
from scipy.optimize import minimize
from small_plants import best_design, exact_return, mass, two_valleys
from test_nested import spring_problem

import ccdtools as cc


def codesigned(problem, method, seed=0, **given):
    """The result of a method."""
    return cc.codesign(problem, method=method, rng=np.random.default_rng(seed), **given)


@pytest.mark.long
@pytest.mark.parametrize("name", ["a mass budget", "two budgets"])
def test_trajectory_and_design_in_one_program_are_the_nested_ones(name):
    case = CASES[name]
    together, nested = (
        codesigned(case.problem(), method, design=case.start)
        for method in (cc.Simultaneous(runs=1, starts=1), cc.Nested("trajectory", runs=1, starts=1))
    )
    assert together.objective == pytest.approx(nested.objective, rel=1e-6)
    np.testing.assert_allclose(together.design, nested.design, rtol=2e-3)
    assert together.multipliers.keys() == nested.multipliers.keys()
    for name, value in together.multipliers.items():
        assert value == pytest.approx(nested.multipliers[name], rel=1e-2)


@pytest.mark.check
def test_inputs_that_know_the_disturbance_are_better_than_any_controller():
    problem = mass()
    ahead, loop = (codesigned(problem, method) for method in (cc.Simultaneous(runs=16), "nested"))
    assert ahead.objective > loop.closed_loop.summary.mean
    assert ahead.closed_loop.summary.mean <= loop.closed_loop.summary.mean + 0.002 * abs(loop.objective)


@pytest.mark.check
@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_a_gain_found_with_the_design_is_as_good_as_nested_lqr(unit):
    problem = spring_problem(unit, U=([-2 * unit], [2 * unit]), limit_tolerance="off")
    gain, nested = (codesigned(problem, method) for method in (cc.Simultaneous("gain", runs=4, starts=1), "nested"))
    assert isinstance(gain.controller, cc.LinearFeedback)
    worst = nested.closed_loop.summary.mean
    assert gain.closed_loop.summary.mean >= worst - 0.02 * abs(worst)


@pytest.mark.check
def test_the_plant_first_is_no_better_than_both_together():
    problem = mass()
    first, together = (codesigned(problem, method) for method in ("sequential", "nested"))
    _, value = best_design(problem)
    assert exact_return(problem, first.design) < exact_return(problem, together.design)
    assert exact_return(problem, together.design) == pytest.approx(value, rel=0.005)
    assert first.method == "sequential"
    assert isinstance(first.controller, cc.LinearFeedback)


@pytest.mark.check
@pytest.mark.parametrize("library", ["cma", "bayesian"])
def test_a_search_without_slopes_finds_the_better_valley(library):
    pytest.importorskip({"cma": "cma", "bayesian": "optuna"}[library])
    problem = two_valleys()
    _, value = best_design(problem)
    method = cc.Search(library, runs=64, evaluations=40 if library == "bayesian" else 300)
    found = codesigned(problem, method, design=[0.1])
    assert exact_return(problem, found.design) >= value - 0.005 * abs(value)


@pytest.mark.check
@pytest.mark.parametrize("name", ["a mass budget", *[name for name, case in CASES.items() if case.whole][:1]])
def test_a_search_keeps_constraints_and_whole_numbers(name):
    pytest.importorskip("cma")
    case = CASES[name]
    _, cost = case.best()
    found = codesigned(case.problem(), cc.Search(runs=64, evaluations=200), design=case.start)
    assert case.problem().design.feasible(found.design)
    assert case.cost(found.design) <= 1.01 * cost


@pytest.mark.check
@pytest.mark.quick(4)
@pytest.mark.parametrize("library", ["cma", "bayesian"])
@pytest.mark.parametrize("seed", range(3))
def test_a_search_finds_the_best_whole_number_among_many(library, seed):
    pytest.importorskip({"cma": "cma", "bayesian": "optuna"}[library])
    own = mass()
    space = cc.DesignSpace(["m"], [0.4], [40.6], integer=["m"])
    counted = replace(own, model=replace(own.model, design=space))
    best = max(range(1, 41), key=lambda m: -abs(m - 23.3) - 2 * np.cos(m))  # one number after the other
    method = cc.Search(library, of=lambda p: -abs(p[0] - 23.3) - 2 * np.cos(p[0]), evaluations=60)
    found = codesigned(counted, method, seed=seed, design=[2.0])
    assert found.design[0] == best


@pytest.mark.quick(1)
@pytest.mark.parametrize("library", ["cma", "bayesian"])
@pytest.mark.parametrize("worst", [1e2, 1e9])
def test_how_bad_the_first_design_is_does_not_matter(library, worst):
    # a loop that loses its runs costs 1e9 beside 1: nothing of the search may be measured by that
    pytest.importorskip({"cma": "cma", "bayesian": "optuna"}[library])

    def measured(p):
        return -worst if p[0] < 0.9 else -1 - (p[0] - 1.6) ** 2

    for seed in range(2):
        found = codesigned(mass(), cc.Search(library, of=measured, evaluations=60), seed=seed, design=[0.6])
        assert found.objective >= -1.002


@pytest.mark.check
@pytest.mark.parametrize("seed", range(3))
def test_cliffs_of_lost_runs_do_not_hide_the_valley_from_a_bayesian_search(seed):
    pytest.importorskip("optuna")
    x, u, w, p = (ca.SX.sym(name, size) for name, size in (("x", 1), ("u", 1), ("w", 1), ("p", 2)))
    space = cc.DesignSpace(["l", "M"], [0.3, 0.3], [1.2, 1.5])
    plant = cc.Plant(x, u, w, p, -p[0] * x + u / p[1] + w, space, dt=0.1)
    wide = replace(mass(), model=cc.discretise(plant), X=([-9], [9]), objective=cc.QuadraticObjective([[1.0]], [[1.0]]),
                   scenarios=cc.FixedStart([1.0], cc.Gaussian([0.1])))  # fmt: skip

    def cost(p):
        lost = 9e5 * max(0.0, p[0] * p[1] - 0.75)
        return 20 / p[0] + 8 / p[1] + 70 * p[1] ** 1.5 + 72 * p[0] ** 1.2 + lost

    least = minimize(cost, [0.4, 0.4], method="Nelder-Mead", bounds=[(0.3, 1.2), (0.3, 1.5)]).fun
    found = codesigned(wide, cc.Search("bayesian", of=lambda p: -cost(p)), seed=seed, design=[1.0, 1.2])
    assert -found.objective <= 1.001 * least


def test_any_function_of_a_design_can_be_searched():
    pytest.importorskip("cma")
    problem = mass()
    found = codesigned(problem, cc.Search(of=lambda p: -((p[0] - 1.3) ** 2), evaluations=80))
    assert found.design[0] == pytest.approx(1.3, abs=0.01)
    assert found.objective == pytest.approx(0, abs=1e-3)


@pytest.mark.long
def test_methods_with_the_same_seed_meet_the_same_scenarios():
    problem = mass()
    first, second = (codesigned(problem, method, seed=7, design=[1.0]) for method in ("nested", cc.Nested("riccati")))
    together = np.corrcoef(first.closed_loop.values, second.closed_loop.values)[0, 1]
    assert together > 0.99


def test_trajectories_refuse_what_they_cannot_honour(illustrative):
    problem = illustrative.problem()
    for changed, named in ((replace(problem, risk=cc.CVaR(0.1)), "risk"), (replace(problem, warm_up=10), "warm-up")):
        with pytest.raises(cc.InputError, match=named):
            codesigned(changed, "simultaneous")


@pytest.mark.long
def test_limits_that_no_inputs_keep_are_told(illustrative):
    problem = illustrative.problem()
    weak = replace(problem, X=([-10, -2], [5, 0.05]), U=([-0.05], [0.05]), steps=20)
    found = codesigned(replace(weak, scenarios=cc.FixedStart([-1, -0.5], cc.Gaussian([0.1, 0.4]))),
                       cc.Simultaneous(runs=2, starts=1), design=[0.5])  # fmt: skip
    assert found.status.name == "INFEASIBLE"
    assert "limit" in found.status.advice


@pytest.mark.check
def test_a_result_is_pickled_and_told():
    found = codesigned(mass(), "nested")
    again = pickle.loads(pickle.dumps(found))
    np.testing.assert_array_equal(again.design, found.design)
    np.testing.assert_array_equal(again.closed_loop.values, found.closed_loop.values)
    text = "\n".join(found.describe())
    assert "nested LQR: converged" in text
    assert "in closed loop" in text
    assert found.seconds > 0
    assert found.evaluations == len(found.history.iteration) or found.evaluations > 0


@pytest.mark.long
def test_a_body_that_is_free_to_drift_is_not_designed_by_what_it_does_alone():
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    cart = cc.Plant(x, u, w, p, ca.vertcat(x[1], (u + w) / p), cc.DesignSpace(["m"], [0.5], [3]), dt=0.1)
    problem = replace(mass(), model=cc.discretise(cart))
    assert "known ahead" in codesigned(problem, "sequential").criterion


@pytest.mark.long
def test_an_unstable_plant_is_not_designed_by_what_it_does_alone(illustrative):
    problem = replace(illustrative.problem(), steps=8)  # too short for a run to be lost
    assert "known ahead" in codesigned(problem, "sequential").criterion
    assert "passive" in codesigned(mass(), "sequential").criterion


def test_a_search_of_one_parameter_knows_that_it_has_converged():
    pytest.importorskip("cma")
    found = codesigned(mass(), cc.Search(of=lambda p: -((p[0] - 1.3) ** 2)))
    assert found.status.name == "CONVERGED"
    assert found.design[0] == pytest.approx(1.3, abs=1e-3)


@pytest.mark.parametrize("method", [cc.Simultaneous(runs=1, starts=1), cc.Nested("trajectory", runs=1, starts=1)])
def test_an_actuator_is_as_large_as_what_it_saves_where_its_limit_is_the_design(method):
    x, u, w, p = (ca.SX.sym(name) for name in "xuwp")
    plant = cc.Plant(x, u, w, p, x + u + w, cc.DesignSpace(["reach"], [0.1], [1.0]), dt=1.0, continuous=False)
    problem = cc.CoDesignProblem(
        cc.discretise(plant), X=(-5.0, 5.0), U=lambda p: (-p, p), scenarios=cc.FixedStart([1.0], cc.Gaussian([0.0])),
        objective=cc.QuadraticObjective([[1.0]], [[1e-6]], design_cost=lambda p: 0.8 * p[0]), steps=1,
        limit_tolerance="off",
    )  # fmt: skip
    found = codesigned(problem, method, design=[0.5])
    assert found.design == pytest.approx([1 - 0.8 / 2], abs=1e-5)  # least (1 - p)² + 0.8 p
    assert found.objective == pytest.approx(-(0.4**2 + 0.8 * 0.6), rel=1e-5)
