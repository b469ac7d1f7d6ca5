"""The mean of the worst case: its values, its slope, and the designs that it leads to, beside a minimax by SciPy."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from uncertain_plants import MASSES, STEPS, exact_costs, minimax, problem

from ccdtools import (
    CoDesignConfig,
    FixedStart,
    Gaussian,
    InputError,
    Mean,
    Scenario,
    WorstCase,
    codesign,
    compare,
    saturated_lqr,
)
from ccdtools.co_design import expert_dataset
from ccdtools.disturbances import Cases
from learning import CloningConfig, NetworkConfig, fit_actor_critic


def means_by_hand(returns, cases):
    """The mean of every case, run by run."""
    return np.stack([returns[..., k::cases].mean(axis=-1) for k in range(cases)], axis=-1)


# --- values -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e7])
@pytest.mark.parametrize("cases", [2, 3, 7])
def test_the_mean_of_the_values_is_the_least_mean_of_the_cases(cases, unit):
    returns = unit * (np.random.default_rng(cases).standard_normal((4, 40)) - 5)
    expected = means_by_hand(returns, cases)
    sharp = WorstCase(smoothing=0, cases=cases)
    for each in (returns, torch.tensor(returns)):
        np.testing.assert_allclose(sharp.values(each).mean(-1), expected.min(axis=-1), rtol=1e-12)
        np.testing.assert_allclose(sharp.means(each), expected, rtol=1e-12)


@pytest.mark.parametrize("smoothing", [1e-1, 1e-3, 1e-6])
def test_the_rounded_measure_exceeds_the_least_mean_by_no_more_than_it_says(smoothing):
    returns = np.random.default_rng(0).standard_normal((50, 60)) - 5
    means = means_by_hand(returns, 3)
    least = means.min(axis=-1)
    tau = smoothing * np.abs(least)
    direct = -tau * np.log(np.mean(np.exp(-(means - least[:, None]) / tau[:, None]), axis=-1)) + least
    rounded = WorstCase(smoothing=smoothing, cases=3).values(returns).mean(-1)
    np.testing.assert_allclose(rounded, direct, rtol=1e-10)
    assert (rounded >= least).all()
    assert (rounded <= least + tau * np.log(3) * (1 + 1e-9)).all()


@pytest.mark.parametrize("smoothing", [0.0, 0.003, 0.1])
def test_the_slope_is_that_of_differences(smoothing):
    risk = WorstCase(smoothing=smoothing, cases=3)
    r = np.random.default_rng(1).standard_normal(20) - 5  # of 20 runs, cases have 7, 7 and 6
    returns = torch.tensor(r, requires_grad=True)
    (slope,) = torch.autograd.grad(risk.values(returns).mean(), returns)
    h = 1e-6
    steps = h * np.eye(20)
    differences = (risk.values(r + steps).mean(-1) - risk.values(r - steps).mean(-1)) / (2 * h)
    np.testing.assert_allclose(slope, differences, atol=1e-8)


def test_alike_cases_share_the_slope_and_nothing_is_added():
    returns = torch.full((6,), -3.0, dtype=torch.float64, requires_grad=True)
    for smoothing in (0.0, 0.003):
        values = WorstCase(smoothing=smoothing, cases=3).values(returns)
        np.testing.assert_allclose(values.detach(), -3.0, rtol=1e-12)
        np.testing.assert_allclose(torch.autograd.grad(values.mean(), returns)[0], 1 / 6)
    np.testing.assert_array_equal(WorstCase(cases=3).values(np.zeros(6)), 0.0)


def test_the_spread_of_the_values_is_the_error_of_the_worst_mean():
    rng = np.random.default_rng(0)
    shift = np.tile([0.0, -1.0, 2.0], 400)
    values = WorstCase(smoothing=0, cases=3).values(shift + rng.standard_normal((300, 1200)))
    told = values.std(axis=-1, ddof=1).mean() / 1200**0.5
    assert told == pytest.approx(values.mean(axis=-1).std(), rel=0.15)


# --- cases --------------------------------------------------------------------------------------------------


def test_runs_take_the_cases_in_turn_and_parameters_are_held():
    w = Cases.of([[-0.2, 1.0], [0.0, 2.0], [0.3, 3.0]]).sample(7, 4, np.random.default_rng(0))
    np.testing.assert_array_equal(w[:, :, 0], np.repeat([[-0.2], [0], [0.3], [-0.2], [0], [0.3], [-0.2]], 4, axis=1))
    np.testing.assert_array_equal(w[3], np.tile([-0.2, 1.0], (4, 1)))


@pytest.mark.parametrize(
    ("make", "argument"),
    [
        (lambda: WorstCase(smoothing=-0.1), "smoothing"),
        (lambda: WorstCase(smoothing=2), "smoothing"),
        (lambda: WorstCase(cases=1), "cases"),
        (lambda: WorstCase().over(FixedStart([0.0], Gaussian([1.0]))), "risk"),
        (lambda: replace(problem(Mean()), risk=WorstCase(), scenarios=FixedStart([1, 0], Gaussian([1, 0.1]))), "risk"),
        (lambda: Cases(()), "terms"),
        (lambda: Cases.of([]), "values"),
        (lambda: Cases.of("a"), "values"),
    ],
)
def test_wrong_cases_are_refused(make, argument):
    with pytest.raises(InputError) as caught:
        make()
    assert caught.value.argument == argument


# --- designs ------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_following_the_measure_leads_to_the_minimax_of_scipy():
    """Design and gain by L-BFGS on exact costs, beside the epigraph form by SLSQP; two masses bind."""
    least, k, gain = minimax()
    costs = exact_costs(k, gain)
    assert np.sum(costs > least * (1 - 1e-4)) == 2
    risk = WorstCase(cases=3)
    z = np.array([3.0, 1.0, 2.0])
    for _ in range(5):
        z = minimize(lambda z: -risk.values(-exact_costs(z[0], z[1:])).mean(), z, method="L-BFGS-B",
                     bounds=[(0.2, 6), (-5, 8), (0, 10)]).x  # fmt: skip
    assert exact_costs(z[0], z[1:]).max() < least * (1 + 2e-3)
    mean = minimax(np.mean)
    assert exact_costs(mean[1], mean[2]).max() > least * 1.03  # what a design for the mean does


def test_a_comparison_shows_the_worst_case_beside_the_means():
    own = problem(WorstCase(smoothing=0))
    x0, w = own.scenarios.sample(60, STEPS, np.random.default_rng(0))
    law = saturated_lqr(own, [1.2])
    scenario = Scenario(own.model, x0, w)
    found = compare({"LQR": law}, scenario, design=[1.2], objective=own.objective, X=own.X, risk=own.risk)
    returns = scenario.run(law, design=[1.2]).returns(own.objective)
    [(name, value)] = found["LQR"].metrics.items()
    assert name == "return, worst of 3 cases"
    assert value == pytest.approx(means_by_hand(returns, 3).min(), rel=1e-9)
    with pytest.raises(InputError, match="risk"):
        compare({"LQR": law}, scenario, design=[1.2], objective=own.objective, X=own.X, risk="worst")


@pytest.mark.slow
def test_a_co_design_reaches_the_minimax_of_linear_feedback():
    own = problem(WorstCase())
    rng = np.random.default_rng(0)
    data = expert_dataset(own, samples=100, sets="lqr", rng=rng)
    agent = fit_actor_critic(
        data.inputs, data.actions, data.values, action_bounds=own.action_bounds, rng=rng,
        input_bounds=own.observation_bounds, network=NetworkConfig((16,)), config=CloningConfig(steps=300, batch=256),
    )  # fmt: skip
    config = CoDesignConfig(iterations=60, pathwise_runs=192, evaluation_runs=384, evaluate_every=10, starts=1)
    found = codesign(own, agent=agent, design=[3.0], rng=np.random.default_rng(0), config=config)
    least, k, _ = minimax()
    fresh = own.scenarios.sample(6000, STEPS, np.random.default_rng(99))
    returns = Scenario(own.model, *fresh).run(found.policy, design=found.design).returns(own.objective)
    assert -means_by_hand(returns, len(MASSES)).min() < 1.02 * least
    assert abs(found.design[0] - k) < 0.2


# --- every case counts --------------------------------------------------------------------------------------


def test_a_worst_case_that_does_not_know_its_cases_says_so_and_is_not_the_mean():
    with pytest.raises(InputError, match="does not know its cases"):
        WorstCase().values(np.arange(6.0))


def test_a_comparison_shows_the_least_mean_itself_and_nothing_of_too_few_runs():
    own = problem(WorstCase(smoothing=0.1))
    x0, w = own.scenarios.sample(60, STEPS, np.random.default_rng(0))
    law = saturated_lqr(own, [1.2])
    scenario = Scenario(own.model, x0, w)
    found = compare({"LQR": law, "MPC": law}, scenario, design=[1.2], objective=own.objective, X=own.X, risk=own.risk,
                    few={"MPC": 2})  # fmt: skip
    returns = scenario.run(law, design=[1.2]).returns(own.objective)
    [least], [few] = (found[name].metrics.values() for name in ("LQR", "MPC"))
    assert least == pytest.approx(means_by_hand(returns, 3).min(), rel=1e-9)
    assert np.isnan(few)
