"""Nested co-design: exact slopes, and the designs that oracles find which share no code with it."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from constrained_plants import CASES
from small_plants import best_design, exact_return, mass, two_valleys

import ccdtools as cc

QUICK = cc.Nested(runs=200)
GAIN = cc.Nested("gain", runs=QUICK.runs, starts=QUICK.starts)


def spring_plant(unit=1.0):
    """A mass with a nonlinear spring: design stiffness and damping; `unit` scales length and force."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    pull = p[0] * x[0] + 0.3 * x[0] ** 3 / unit**2 + p[1] * x[1]
    space = cc.DesignSpace(["k", "c"], [0.5, 0.1], [4.0, 2.0])
    return cc.Plant(x, u, w, p, ca.vertcat(x[1], -pull + u + w), space, dt=0.1)


def spring_problem(unit=1.0, **changes):
    """Regulation of that mass, its input limits by design, its cost dearer with stiffness."""
    given = {
        "X": ([-3 * unit] * 2, [3 * unit] * 2), "U": lambda p: (-1.5 * unit * p[0], 1.5 * unit * p[0]), "steps": 40,
        "objective": cc.CustomObjective(
            lambda x, u, p: (x[0] ** 2 + 0.2 * p[0] * x[1] ** 2 + 0.1 * u**2 / p[1]) / unit**2 + 0.02 * p[0],
            design_cost=lambda p: p[0] ** 2 + 0.5 * p[1],
        ),
        "scenarios": cc.FixedStart([1.5 * unit, -1.0 * unit], cc.Gaussian([0.4 * unit])),
    }  # fmt: skip
    return cc.CoDesignProblem(cc.discretise(spring_plant(unit)), **(given | changes))


def slowed(unit):
    """Regulation of that mass at a speed that LQR by the weights exceeds."""
    start = cc.FixedStart([1.5 * unit, 0.0], cc.Gaussian([0.05 * unit]))
    X = ([-3 * unit, -0.7 * unit], [3 * unit, 0.7 * unit])
    return spring_problem(unit, X=X, scenarios=start, limit_tolerance=(0.01, 0.05))


@pytest.mark.check
def test_a_gain_found_with_the_plant_keeps_a_limit_that_lqr_by_the_weights_breaks():
    metres, millimetres, lqr = (
        cc.codesign(slowed(unit), method=cc.Nested(inner, runs=64, starts=1), rng=np.random.default_rng(0))
        for inner, unit in (("gain", 1.0), ("gain", 1000.0), ("lqr", 1.0))
    )
    assert metres.method == "nested gain"
    assert metres.limits.kept
    assert metres.closed_loop.summary.mean == pytest.approx(millimetres.closed_loop.summary.mean, rel=0.01)
    assert not lqr.limits.kept


@pytest.mark.long
@pytest.mark.quick(2)
@pytest.mark.parametrize("name", sorted(CASES))
@pytest.mark.parametrize("method", [cc.Nested("riccati"), QUICK, GAIN], ids=["riccati", "lqr", "gain"])
def test_constrained_designs_are_those_of_slsqp_on_the_exact_cost(name, method):
    case = CASES[name]
    _, cost = case.best()
    problem = case.problem()
    found = cc.codesign(problem, method=method, design=case.start, rng=np.random.default_rng(1))
    assert problem.design.feasible(found.design)
    assert problem.design.violation(found.design) <= 1e-9
    assert case.cost(found.design) <= 1.005 * cost
    assert found.status.name in ("CONVERGED", "AT_BOUND")
    assert found.slope < 1e-3


@pytest.mark.check
def test_a_multiplier_is_what_more_of_the_budget_brings():
    case = CASES["a mass budget"]
    found = cc.codesign(case.problem(), method="nested", design=case.start, rng=np.random.default_rng(1))
    (name,) = found.multipliers
    wider = replace(case, constraints=lambda p: [g - 0.01 for g in case.constraints(p)])
    more = cc.codesign(wider.problem(), method="nested", design=case.start, rng=np.random.default_rng(1))
    assert found.multipliers[name] == pytest.approx((more.objective - found.objective) / 0.01, rel=0.02)


@pytest.mark.check
@pytest.mark.parametrize("make", [mass, two_valleys])
@pytest.mark.parametrize("start", [0.02, 0.3, 0.97])
def test_the_best_valley_is_found_from_any_start(make, start):
    problem = make()
    _, value = best_design(problem)
    found = cc.codesign(problem, method=QUICK, design=problem.design.from_unit([start]), rng=np.random.default_rng(3))
    assert exact_return(problem, found.design) >= value - 0.005 * abs(value)
    assert found.closed_loop.summary.ci95[0] <= exact_return(problem, found.design) <= found.closed_loop.summary.ci95[1]


@pytest.mark.check
@pytest.mark.parametrize(("x0", "expected"), [((0, 0), (0.66, 0.71)), ((-2, -2), (2.35, 2.55)), ((-3.5, -2), (3, 3))])
def test_known_optima_of_the_illustrative_example(illustrative, x0, expected):
    problem = illustrative.problem()
    problem = replace(problem, scenarios=cc.FixedStart(x0, problem.scenarios.disturbance))
    found = cc.codesign(problem, method="nested", design=[1.7], rng=np.random.default_rng(0))
    assert expected[0] <= found.design[0] <= expected[1]
    assert found.status.settled


@pytest.mark.check
def test_known_optimum_of_the_suspension_and_what_holds_it(suspension):
    found = cc.codesign(suspension.problem(), method="nested", rng=np.random.default_rng(0))
    np.testing.assert_allclose(found.design, [1e4, 3000])
    assert found.active_bounds == {"k_s": "lower", "c_s": "upper"}
    assert set(found.multipliers) == {"k_s", "c_s"}
    assert found.status.name == "AT_BOUND"
    assert found.closed_loop.summary.mean == pytest.approx(-47.7, abs=1.0)


@pytest.mark.check
def test_linear_and_nonlinear_mpc_inside_find_the_same_design_of_a_linear_plant(illustrative):
    problem = replace(illustrative.problem(), steps=25)
    problem = replace(problem, scenarios=cc.FixedStart([-2, -2], problem.scenarios.disturbance))
    found = [
        cc.codesign(problem, method=cc.Nested(inner, runs=4, starts=1, horizon=8), design=[2.2],
                    rng=np.random.default_rng(0))
        for inner in ("mpc", "nmpc")
    ]  # fmt: skip
    np.testing.assert_allclose(found[0].design, found[1].design, rtol=0.03)
    assert found[0].objective == pytest.approx(found[1].objective, rel=2e-3)


@pytest.mark.check
def test_a_policy_trained_at_every_design_finds_what_lqr_finds():
    problem = mass()
    _, value = best_design(problem)
    method = cc.Nested("rl", runs=32, evaluations=5)
    found = cc.codesign(problem, method=method, design=[1.2], rng=np.random.default_rng(0))
    assert exact_return(problem, found.design) >= value - 0.01 * abs(value)
    assert isinstance(found.controller, cc.LearnedPolicy)
    np.testing.assert_allclose(found.controller.design, found.design)


@pytest.mark.check
def test_state_limits_are_kept_where_a_design_can_keep_them():
    # the softer the spring, the further the mass strays: the best design without limits leaves X, the tolerance is set
    free = spring_problem(limit_tolerance="off", U=([-8], [8]), X=([-1.6, -3], [1.6, 3]))
    asked = replace(free, limit_tolerance=(0.02, 0.1))
    loose, kept = (cc.codesign(one, method=QUICK, design=[2.0, 1.0], rng=np.random.default_rng(0))
                   for one in (free, asked))  # fmt: skip
    assert loose.limits is None
    assert kept.limits.kept
    assert kept.objective <= loose.objective + 1e-9


def test_a_learned_error_is_part_of_what_is_optimised(illustrative):
    problem = replace(illustrative.problem(), steps=30, limit_tolerance="off")
    with pytest.raises(cc.InputError, match="Riccati"):
        cc.codesign(replace(problem, risk=cc.CVaR(0.1)), method=cc.Nested("riccati"), rng=np.random.default_rng(0))


def test_lost_runs_are_told(illustrative):
    # LQR that never saturates prefers a weak actuator, with which the true loop cannot be recovered
    found = cc.codesign(illustrative.problem(), method=cc.Nested("riccati"), rng=np.random.default_rng(0))
    assert found.closed_loop.lost_share > 0.5
    assert found.status.name == "DIVERGING"
