"""What slopes, prices, notes and verdicts of a co-design say turns at the stated numbers: well below and well above."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ccdtools import DesignSpace
from ccdtools.co_design.closed_loop import ClosedLoopReturns
from ccdtools.co_design.design_gradients import Differences, Slope
from ccdtools.co_design.feasible import FeasibleSlope
from ccdtools.co_design.landscape import _same_hill, start_points
from ccdtools.co_design.learned_result import GradientCheck
from ccdtools.co_design.limits import BY_MPC, LimitsOutcome, Pair, Tolerance
from ccdtools.co_design.methods.feasible_cost import FeasibleCost
from ccdtools.co_design.methods.learned import start_designs
from ccdtools.co_design.methods.loop_cost import _settled as rounds_settled
from ccdtools.co_design.optimum_sensitivity import OptimumSensitivity
from ccdtools.co_design.policy_check import _check
from ccdtools.co_design.result import CoDesignResult
from ccdtools.co_design.secant import Linearisation
from ccdtools.co_design.settling import _better
from ccdtools.statistics import PairedDifference

ONE, NONE = np.ones(1), np.zeros(1)
BOX = DesignSpace(["p", "q"], [0, 0], [1, 1])
HALF = DesignSpace(["p", "q"], [0, 0], [1, 1], constraints=lambda p: p[0] - 0.5)


# ── slopes ──


@pytest.mark.parametrize(("errors", "sure"), [(1.0, False), (9.0, True)])
def test_a_slope_above_three_standard_errors_is_no_chance(errors, sure):
    assert Slope(ONE, ONE / errors, ONE, NONE, NONE).promises(0.0) == sure
    assert Slope(NONE, NONE, ONE, ONE, ONE / errors).rises_across_bounds(0.0) == sure


@pytest.mark.parametrize(("gain", "brought"), [(0.015, True), (0.15, False)])
def test_a_slope_predicts_its_gain_over_a_tenth_of_the_box(gain, brought):
    assert Slope(ONE, NONE, ONE, NONE, NONE).promises(gain) == brought


@pytest.mark.parametrize(("error", "says_nothing"), [(0.15, False), (1.5, True)])
def test_a_slope_says_nothing_whose_error_ahead_exceeds_a_twentieth_of_the_return(error, says_nothing):
    assert Slope(ONE, error * ONE, ONE, NONE, NONE).unresolved(1.0) == says_nothing


@pytest.mark.parametrize(
    ("coarse", "fine", "size", "step"),
    [(1 + 0.05 / 3, 1, 0, 1e-2), (1.15, 1, 0, 1e-3), (0.3e-3, 0, 1, 1e-2), (3e-3, 0, 1, 1e-3)],
)
def test_a_difference_is_confirmed_by_a_finer_one_within_a_twentieth_or_a_slope_without_consequence(
    coarse, fine, size, step
):
    """Slopes at steps of 1e-2 and below."""
    stated = SimpleNamespace(
        problem=SimpleNamespace(made_by_control=lambda *_: size, design=SimpleNamespace(lower=[0.0], upper=[1.0])),
        about=lambda v, step: torch.full((2, 1), float(coarse if step > 0.005 else fine)),
        _returns=lambda v: torch.zeros(2),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ccdtools.co_design.design_gradients.to_design", lambda problem, v: v)
        assert Differences.step(stated, torch.tensor([0.5])) == step


@pytest.mark.parametrize(
    ("apart", "error", "scale", "trusted"),
    [(0.06, 0, 0, True), (0.6, 0, 0, False), (1.2, 1, 0, True), (9.2, 1, 0, False), (0.2003, 0, 1, True),
     (0.203, 0, 1, False)],
)  # fmt: skip
def test_a_gradient_is_trusted_within_a_fifth_three_errors_and_a_slope_without_consequence(
    apart, error, scale, trusted
):
    check = GradientCheck(("p",), 1.0, 1 + apart, finite_difference_error=error, deviation_error=error, scale=scale)
    assert check.trusted == trusted


@pytest.mark.parametrize(
    ("slope", "gap", "agrees"), [(10, 0.3, True), (10, 3, False), (0, 0.003, True), (0, 0.03, False)]
)
def test_the_slopes_to_both_sides_of_an_optimum_agree_within_a_tenth(slope, gap, agrees):
    sides = {"slope": slope * ONE, "ahead": (slope + gap) * ONE, "behind": slope * ONE}
    found = OptimumSensitivity(value=1.0, design=ONE, return_slope=0.0, held=(), width=ONE, names=("p",), **sides)
    assert found.agrees == agrees


@pytest.mark.parametrize(("away", "edges"), [(0.3e-3, 1), (3e-3, 0)])
def test_a_slope_ends_at_a_constraint_within_a_thousandth_of_the_box(away, edges):
    by_run = np.array([[1.0, 0.1], [1.0, 0.1]])
    free = np.array([True, True])
    found = FeasibleSlope.within(by_run, np.array([0.5 - away, 0.5]), HALF.allowed, free)
    assert len(found.edges) == edges


@pytest.mark.parametrize(("part", "blind"), [(0.3e-9, 1.0), (3e-9, 0.0)])
def test_a_run_without_a_billionth_of_a_slope_has_no_gradient(part, blind):
    pathwise = torch.full((4, 1), 100 * part, dtype=torch.float64)
    assert _check(pathwise, pathwise, 100.0).blind == blind


# ── places ──


@pytest.mark.parametrize(("away", "one"), [(0.006, True), (0.06, False)])
def test_designs_within_a_fiftieth_of_the_box_are_one_place(away, one):
    valley = SimpleNamespace(design=[0.5 + away, 0.5])
    assert len(start_points(BOX, [0.5, 0.5], (valley,), 3)) == 2 - one


@pytest.mark.parametrize(("behind", "climbed"), [(0.06, True), (0.6, False)])
def test_no_climb_starts_at_a_local_optimum_behind_by_a_fifth(behind, climbed):
    found = tuple(
        SimpleNamespace(design=np.array(p), lqr_return=-1 - b) for p, b in (([0.5, 0.5], 0), ([0, 0], behind))
    )
    task = SimpleNamespace(problem=SimpleNamespace(design=BOX, made_by_control=lambda *_: 1.0),
                           config=SimpleNamespace(starts=None))  # fmt: skip
    assert len(start_designs(task, [0.5, 0.5], found)) == 1 + climbed


@pytest.mark.parametrize(
    ("apart", "dip", "same"), [(0.5, 0.7e-3, True), (0.5, 6e-3, False), (0.007, 1.0, True), (0.06, 1.0, False)]
)
def test_a_hill_is_parted_by_a_ridge_of_two_thousandths_unless_its_tops_are_neighbours(apart, dip, same):
    problem = SimpleNamespace(design=BOX, made_by_control=lambda *_: 1.0)
    landscape = SimpleNamespace(problem=problem, returns=lambda V: np.full(len(V), -1 - dip))
    assert _same_hill(landscape, np.array([0.2 + apart, 0.5]), np.array([0.2, 0.5]), -1.0) == same


# ── costs of searches ──


@pytest.mark.parametrize(
    ("cost", "away", "violation", "merit"),
    [
        (2.0, 0.0, 0.0, 2),
        (2.0, 0.1, 0.0, 4),
        (2.0, 0.0, 0.02, 3),
        (8.0, 0.0, 0.0, 4 + 4 * np.log(2)),
        (np.inf, 0, 0, 2e3),
    ],
)
def test_the_merit_of_a_search_adds_ten_squared_distances_and_a_twentieth_per_tolerance(cost, away, violation, merit):
    """The size of costs is their lower quartile, 2; of infinite ones the merit is a thousand."""
    known = SimpleNamespace(looks=[(NONE, value, 0.0, 0.0) for value in (1.0, 2.0, 30.0, 400.0, 5000.0)])
    box = SimpleNamespace(size=FeasibleCost.size.fget(known))
    assert FeasibleCost.merit(box, NONE, cost, away, violation) == pytest.approx(merit)


@pytest.mark.parametrize(("gain", "settled"), [(0.3e-3, True), (3e-3, False)])
def test_rounds_of_prices_end_where_they_gain_less_than_a_thousandth_each(gain, settled):
    ends = [SimpleNamespace(violation=0.0, cost=1 - k * gain, size=1.0) for k in range(9)]
    assert rounds_settled(ends) == settled


# ── limits ──


@pytest.mark.parametrize(("errors", "kept"), [(0.67, True), (6.0, False)])
def test_limits_are_kept_that_are_exceeded_by_up_to_two_errors(errors, kept):
    found = LimitsOutcome(Pair(0.1, 0.0), Pair(0.0, 0.0), "asked for", Pair(0, 0), errors=Pair(0.1 / errors, 0.0))
    assert found.kept == kept


@pytest.mark.parametrize(
    ("depth", "words"), [(0.0006, "state limits kept"), (0.006, "state limits left no more than MPC")]
)
def test_a_network_resolves_a_five_hundredth_of_the_states_or_half_widths(depth, words):
    assert words in str(LimitsOutcome(Pair(0.0, depth), Pair(1.0, 1.0), BY_MPC, Pair(0, 0)))


@pytest.mark.parametrize(("away", "near"), [(0.03, True), (0.3, False)])
def test_mpc_is_measured_again_further_than_a_tenth_of_the_box_away(away, near):
    v = torch.tensor([0.4, 0.4])
    assert Tolerance(Pair(0.1, 0.1), BY_MPC, v).holds_at(v + torch.tensor([away, 0.0])) == near


# ── notes and verdicts ──


@pytest.mark.parametrize(("spread", "said"), [(0.66, False), (6.0, True)])
def test_a_result_says_that_few_runs_decide(spread, said):
    values = -1 + spread * np.tile([-1.0, 1.0], 50) * np.sqrt(0.99)
    loop = ClosedLoopReturns(values, values > 99)
    lines = "\n".join(CoDesignResult(design=NONE, objective=-1.0, closed_loop=loop).describe())
    assert ("a few runs cost far more" in lines) == said


@pytest.mark.parametrize(("part", "better"), [(0.0017, False), (0.015, True)])
def test_half_a_per_cent_is_worth_a_secant_or_another_controller(part, better):
    assert Linearisation(np.eye(1), np.eye(1), np.zeros(1), None, -1.0, -1 - part, 1.0).better == better
    assert _better(SimpleNamespace(gain=PairedDifference(part, (part / 2, 2 * part)))) == better
