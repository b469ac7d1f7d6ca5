"""Statements that methods of co-design can hardly treat: told in words, or treated all the same."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from constrained_plants import CASES
from small_plants import mass

import ccdtools as cc


def unreached(weight: float = 1.0) -> cc.CoDesignProblem:
    """A state that runs away and that no input reaches, whatever the design."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    plant = cc.Plant(x, u, w, p, ca.vertcat(0.5 * x[0] + w, -x[1] + p * u), cc.DesignSpace(["b"], [1], [2]), dt=0.1)
    return cc.CoDesignProblem(
        cc.discretise(plant), X=([-10, -10], [10, 10]), U=([-5], [5]), steps=20,
        objective=cc.QuadraticObjective(np.diag([5.0, weight]), [[0.5]]),
        scenarios=cc.FixedStart([1.0, -1.0], cc.Gaussian([0.3])),
    )  # fmt: skip


@pytest.mark.parametrize(
    "method",
    [cc.Sequential("open_loop", starts=1), cc.Simultaneous(runs=1, starts=1),
     cc.Nested("trajectory", runs=1, starts=1), cc.Nested("lqr"), cc.Nested("gain"), cc.Nested("riccati")],
)  # fmt: skip
def test_a_design_that_cannot_be_stabilised_is_named(method):
    with pytest.raises(cc.InputError, match=r"design: got b = [12]") as caught:
        cc.codesign(unreached(), method=method, rng=np.random.default_rng(0))
    assert "stabilised" in str(caught.value)


def test_an_optimum_without_a_controller_has_no_slope():
    with pytest.raises(cc.InputError, match=r"b = 1\.5.*stabilised"):
        cc.optimum_sensitivity(unreached, 2.0, design=[1.5], runs=10)


@pytest.mark.long
def test_the_riccati_equation_needs_no_disturbance():
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p")
    dynamics = ca.vertcat(x[1], -2 * x[0] - 0.3 * x[1] + (1 + 0.5 * p) * u / p)
    plant = cc.Plant(x, u, ca.SX.sym("w", 0), p, dynamics, cc.DesignSpace(["m"], [0.2], [3.0]), dt=0.1)
    undriven = cc.FixedStart([1.0, -1.0], cc.Gaussian([]))
    problem = replace(mass(), model=cc.discretise(plant), scenarios=undriven, steps=300)
    still, loop = (
        cc.codesign(problem, method=cc.Nested(inner, starts=1), rng=np.random.default_rng(0))
        for inner in ("riccati", "lqr")
    )
    assert still.objective == pytest.approx(loop.objective, rel=1e-6)
    np.testing.assert_allclose(still.design, loop.design, rtol=1e-3)


def test_the_riccati_equation_refuses_a_warm_up():
    with pytest.raises(cc.InputError, match="warm-up"):
        cc.codesign(replace(mass(), warm_up=10), method=cc.Nested("riccati"), rng=np.random.default_rng(0))


@pytest.mark.parametrize("value", [None, "much", [1.0, 2.0]])
def test_a_function_that_gives_no_number_is_refused(value):
    pytest.importorskip("cma")
    with pytest.raises(cc.InputError, match="one number"):
        cc.codesign(mass(), method=cc.Search(of=lambda p: value), rng=np.random.default_rng(0))


def test_one_number_in_an_array_is_a_number():
    pytest.importorskip("cma")
    search = cc.Search(of=lambda p: -np.square(p - 1.3), evaluations=60)
    assert cc.codesign(mass(), method=search, rng=np.random.default_rng(0)).design[0] == pytest.approx(1.3, abs=0.05)


@pytest.mark.parametrize("make", [lambda: cc.Nested("rl", agent=5), lambda: cc.Learned(agent=5),
                                  lambda: cc.compare_methods(mass(), ["sequential"], agent=5)])  # fmt: skip
def test_what_is_no_agent_is_refused_before_anything_runs(make):
    with pytest.raises(cc.InputError, match="agent: got 5"):
        make()


@pytest.mark.long
def test_limits_that_the_best_design_keeps_cost_no_more_evaluations():
    problem = replace(mass(), X=([-1.3, -1.7], [1.3, 1.7]), limit_tolerance=(0.05, 0.05))
    free = cc.codesign(replace(problem, limit_tolerance="off"), method=cc.Nested(runs=200, starts=1),
                       rng=np.random.default_rng(0))  # fmt: skip
    watched = cc.codesign(problem, method=cc.Nested(runs=200, starts=1), rng=np.random.default_rng(0))
    outside = watched.limits.achieved
    near = replace(problem, limit_tolerance=(1.02 * outside.fraction + 1e-4, 1.02 * outside.depth))  # within a tenth
    close = cc.codesign(near, method=cc.Nested(runs=200, starts=1), rng=np.random.default_rng(0))
    assert outside.depth > 0.002
    assert close.limits.kept
    np.testing.assert_array_equal(close.design, free.design)
    assert close.evaluations == free.evaluations == len(close.history.iteration)


@pytest.mark.long
def test_a_trade_off_over_nothing_is_refused_and_one_over_the_length_of_episodes_is_not():
    problem = next(iter(CASES.values())).problem()
    with pytest.raises(cc.InputError, match="values: got none"):
        cc.trade_off(lambda value: problem, [])
    lengths = [20, 400]
    found = cc.trade_off(lambda n: replace(mass(), steps=int(n)), lengths, method=cc.Nested(runs=50, starts=1))
    assert np.isfinite(found.intervals).all()
    assert len({len(result.closed_loop.values) for result in found.results}) == 2


@pytest.mark.parametrize("method", [cc.Nested("riccati", starts=1), cc.Simultaneous(runs=1, starts=1)])
def test_whole_numbers_that_were_never_compared_are_not_called_settled(method):
    name = next(name for name, case in CASES.items() if case.whole)
    found = cc.codesign(CASES[name].problem(), method=method, design=CASES[name].start, rng=np.random.default_rng(0))
    assert not found.status.settled
