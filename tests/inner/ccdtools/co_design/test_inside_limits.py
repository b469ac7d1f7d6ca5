"""What test_limits.py claims, seen from inside."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch

import ccdtools as cc
from ccdtools.co_design.differentiable_model import Episode, scenario_tensors
from ccdtools.co_design.limits import LimitsOutcome, Pair, StateLimitPenalty, Tolerance, mpc_episodes, tolerance_by_mpc
from invariant_sets import Polytope

QUICK = {"iterations": 8, "pathwise_runs": 16, "evaluation_runs": 64, "evaluate_every": 2}


def rail(limit=0.5, **changes):
    """A mass on a rail with light friction: its speed is limited, and the start is far enough to reach the limit."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    space = cc.DesignSpace(["m"], [0.5], [3.0], units=["kg"])
    plant = cc.Plant(x, u, w, p, ca.vertcat(x[1], (u - 0.1 * x[1]) / p + w), space, dt=0.1)
    stated = cc.CoDesignProblem(
        cc.discretise(plant), X=Polytope.from_bounds([-2, -limit], [2, limit]), U=Polytope.from_bounds([-1], [1]),
        objective=cc.QuadraticObjective(np.diag([1, 0.1]), [[0.05]]),
        scenarios=cc.FixedStart([-1.5, 0.0], cc.Gaussian([0.1])), steps=60,
    )  # fmt: skip
    return replace(stated, **changes)


def episodes(fraction, depth, n=4):
    """Episodes with these measures, returning −100 each."""
    full = torch.full((n,), 1.0, dtype=torch.float64)
    return Episode(-100 * full, full < 0, 0.1 * depth * full, depth * full, fraction * full)


@pytest.mark.check
@pytest.mark.parametrize("name", ["illustrative", "suspension"])
def test_where_the_limits_never_bind_the_results_are_those_without_limits(name, request, clone):
    study = request.getfixturevalue(name)
    results = []
    for tolerance in ("mpc", "off"):
        problem = replace(study.problem(), limit_tolerance=tolerance)
        learned = cc.Learned(agent=clone(study), config=cc.CoDesignConfig(**QUICK))
        results.append(learned.run(problem, np.array(study.p0), np.random.default_rng(1)))
    kept, off = results
    np.testing.assert_array_equal(kept.design, off.design)
    np.testing.assert_array_equal(kept.history.model_return, off.history.model_return)
    assert kept.limits.kept
    assert kept.limits.multipliers == Pair(0.0, 0.0)
    assert off.limits is None


def test_the_tolerance_is_a_quarter_more_than_what_mpc_does_there():
    problem = rail()
    scenarios = scenario_tensors(problem, 40, np.random.default_rng(0))
    v = torch.tensor([0.4])
    allowed = StateLimitPenalty(problem).updated(episodes(0.5, 0.3), v, scenarios)
    by_mpc = mpc_episodes(problem, v, scenarios)
    assert allowed.tolerance.allowed.depth == pytest.approx(1.25 * float(by_mpc.peak.mean()))
    assert allowed.tolerance.allowed.fraction == pytest.approx(1.25 * float(by_mpc.outside.mean()))
    assert "MPC of the same design" in allowed.tolerance.source
    idle = StateLimitPenalty(problem).updated(episodes(0.001, 0.001), v, scenarios)
    assert idle.tolerance.v is None
    assert not idle.active


def test_the_tolerance_follows_what_mpc_does_a_twentieth_of_the_box_away(monkeypatch):
    """By e per box where it is measured in steps of 0.02, and by far more at 0.15 from there."""

    def measured(problem, v, scenarios):
        away = round((float(v[0]) - 0.5) / 0.02) * 0.02
        return episodes(0.5, 0.1 * np.exp(away if abs(away) < 0.15 else 9 * away))

    monkeypatch.setattr("ccdtools.co_design.limits.mpc_episodes", measured)
    found = tolerance_by_mpc(None, torch.tensor([0.5], dtype=torch.float64), ())
    assert found.slopes[1, 0] == pytest.approx(1.0, abs=0.25)


@pytest.mark.check
def test_near_the_design_at_which_mpc_was_measured_the_tolerance_follows_the_design():
    problem = rail()
    scenarios = scenario_tensors(problem, 40, np.random.default_rng(0))
    v = torch.tensor([0.3])
    near = tolerance_by_mpc(problem, v, scenarios)
    there = tolerance_by_mpc(problem, v + 0.06, scenarios)
    assert near.holds_at(v + 0.06)
    assert not near.holds_at(v + 0.2)
    constant = near.allowed.fraction - there.allowed.fraction
    assert abs(constant) > 0.02 * there.allowed.fraction
    assert abs(float(near.at(v + 0.06)[0]) - there.allowed.fraction) < 0.3 * abs(constant)


@pytest.mark.check
@pytest.mark.parametrize("steps", [4, pytest.param(60, marks=pytest.mark.slow)])
def test_an_mpc_that_loses_every_run_grants_no_more_than_a_network_resolves(steps):
    lost = replace(rail(), scenarios=cc.FixedStart([-1.5, 0.4], cc.Gaussian([1e9])), steps=steps)
    allowed = tolerance_by_mpc(lost, torch.tensor([0.3]), scenario_tensors(lost, 40, np.random.default_rng(0)))
    assert allowed.allowed == Pair(0.002, 0.002)


@pytest.mark.parametrize(
    ("before", "depth", "after"),
    [(0.0, 0.87, 0.0), (0.0, 0.95, 0.02 * np.exp(0.4 * 0.05)), (0.0, 1.4, 0.02 * np.exp(0.4 * 0.5)),
     (0.0, 9.9, 0.02 * np.exp(0.4)), (0.5, 9.9, 0.5 * np.exp(0.4)), (0.01, 0.0, 0.01 * np.exp(-0.4 * 0.9)),
     (5e-4, 0.0, 0.0)],
)  # fmt: skip
def test_a_price_begins_at_a_fiftieth_aims_at_nine_tenths_and_moves_by_up_to_half(before, depth, after):
    """Of a peak depth of so many tolerances."""
    penalty = StateLimitPenalty(rail(limit_tolerance=(0.1, 0.05)), multipliers=Pair(0.0, before))
    found = penalty.updated(episodes(0.0, 0.05 * depth), torch.tensor([0.4]), ())
    assert found.multipliers.depth == pytest.approx(after)


@pytest.mark.parametrize(("mean", "spread"), [(0.3e-4, 0.01), (3e-4, 3e-4)])
def test_a_violation_of_a_ten_thousandth_says_how_far_the_states_outside_are(mean, spread):
    penalty = StateLimitPenalty(rail(limit_tolerance=(0.1, 0.05)))
    found = penalty.updated(episodes(1.0, 10 * mean), torch.tensor([0.4]), ())
    assert found.spread == pytest.approx(spread)


def test_multipliers_grow_while_the_limits_are_broken_and_fall_to_zero_once_kept():
    penalty = StateLimitPenalty(rail(limit_tolerance=(0.1, 0.05)))
    v = torch.tensor([0.4])
    assert not penalty.active
    values = []
    for _ in range(4):
        penalty = penalty.updated(episodes(0.05, 0.4), v, ())
        values.append(penalty.multipliers.depth)
    assert values == sorted(values)
    assert 0 < values[0] < values[-1]
    assert penalty.multipliers.fraction == 0
    assert penalty.violation(episodes(0.05, 0.4)) == pytest.approx(0.35)
    for _ in range(30):
        penalty = penalty.updated(episodes(0.0, 0.0), v, ())
    assert not penalty.active
    assert penalty.violation(episodes(0.1, 0.05)) == 0


@pytest.fixture
def priced():
    """Return a penalty whose multipliers are not zero, and episodes at which both measures are where they aim."""
    at = torch.tensor([0.4], dtype=torch.float64)
    tolerance = Tolerance(Pair(0.1, 0.05), "made up", at, torch.tensor([[0.0], [2.0]], dtype=torch.float64))
    penalty = replace(StateLimitPenalty(rail()), tolerance=tolerance, v=at, multipliers=Pair(0.2, 0.3), spread=0.25)
    full = torch.ones(2, dtype=torch.float64)
    return penalty, Episode(-100 * full, full < 0, 0.0225 * full, 0.045 * full, 0.09 * full), at


def by_unit(penalty, seen, v):
    """What a unit of depth, of peak and of the design costs at these prices."""
    none, one = torch.zeros(2, dtype=torch.float64), torch.ones(2, dtype=torch.float64)
    units = ((one, none, none[:1]), (none, one, none[:1]), (none, none, one[:1]))
    prices = penalty.prices(seen, v)
    return [float(prices(replace(seen, depth=depth, peak=peak), step).mean()) for depth, peak, step in units]


def test_the_cost_prices_peak_and_mean_depth_in_parts_of_the_return(priced):
    depth, peak, design = by_unit(*priced)
    np.testing.assert_allclose(peak, 100 * 0.3 / 0.05)
    np.testing.assert_allclose(depth, 100 * 0.2 / 0.1 / 0.25)
    np.testing.assert_allclose(design, -100 * 0.3 * 0.9 * 2.0)  # a larger tolerance has less to pay


def test_the_cost_follows_the_standard_errors_that_are_on_top(priced):
    penalty, seen, v = priced
    apart = torch.tensor([-1e-3, 1e-3], dtype=torch.float64)
    shift = torch.zeros((), dtype=torch.float64, requires_grad=True)

    def moved(t):
        return penalty.cost(replace(seen, depth=seen.depth + (2 + t) * apart, peak=seen.peak + (3 + t) * apart), v)

    (slope,) = torch.autograd.grad(moved(shift), shift)
    assert float(slope) > 0
    assert float(slope) == pytest.approx(float(moved(1e-5) - moved(-1e-5)) / 2e-5, rel=1e-6)


def test_the_prices_are_the_slopes_of_the_cost(priced):
    penalty, seen, v = priced
    seen = replace(seen, peak=1.4 * seen.peak)
    h = 1e-6
    slopes = [
        (penalty.cost(replace(seen, depth=seen.depth + h), v) - penalty.cost(replace(seen, depth=seen.depth - h), v)),
        (penalty.cost(replace(seen, peak=seen.peak + h), v) - penalty.cost(replace(seen, peak=seen.peak - h), v)),
        (penalty.cost(seen, v + h) - penalty.cost(seen, v - h)),
    ]
    expected = np.array([float(slope) for slope in slopes]) / (2 * h)
    np.testing.assert_allclose(by_unit(penalty, seen, v), expected, rtol=1e-5)


def test_an_outcome_that_is_kept_says_by_how_much():
    outcome = LimitsOutcome(Pair(0.1, 0.02), Pair(0.12, 0.05), "asked for", Pair(0.0, 0.0))
    assert str(outcome) == (
        "state limits kept: 10.00% of the states outside X, peak depth 0.02; tolerance 12.00% and 0.05 (asked for)"
    )
