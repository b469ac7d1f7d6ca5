"""What plants, sets, searches and comparisons of a co-design say turns at the stated numbers."""

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from matplotlib.figure import Figure

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    Plant,
    QuadraticObjective,
    discretise,
)
from ccdtools.co_design import expert_loops
from ccdtools.co_design.agents import check_agent
from ccdtools.co_design.ascent import Ascent
from ccdtools.co_design.closed_loop import ClosedLoopReturns
from ccdtools.co_design.design_search import DesignPoint, _Watched, confirmed, descend
from ccdtools.co_design.differentiable_model import scenario_tensors
from ccdtools.co_design.expert import _leaving
from ccdtools.co_design.expert_loops import set_filter
from ccdtools.co_design.idle_entries import acting_together
from ccdtools.co_design.learned_result import GradientCheck, LearnedCoDesign
from ccdtools.co_design.least_depth import unavoidable_depth
from ccdtools.co_design.limits import LimitsOutcome, Pair
from ccdtools.co_design.lqr_regions import LQRRegions
from ccdtools.co_design.method_comparison import MethodComparison
from ccdtools.co_design.method_pairs import MethodRow
from ccdtools.co_design.method_plots import _returns
from ccdtools.co_design.methods.loop_cost import LoopCost
from ccdtools.co_design.methods.open_loop import fed_back
from ccdtools.co_design.methods.sequential import _stands_alone
from ccdtools.co_design.preview import _drawn_bounds
from ccdtools.co_design.result import Baseline, CoDesignResult, CoDesignStatus, History
from ccdtools.co_design.settling import Settling
from ccdtools.statistics import PairedDifference
from invariant_sets import Polytope
from learning import ActorCritic, NetworkConfig

ONE = np.ones(1)
BOX = DesignSpace(["p", "q"], [0, 0], [1, 1])


def scalar(after, design=("p",), **changes):
    """A problem of one state, x⁺ = after(x, u, p), within ±1."""
    x, u, w, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", len(design))
    space = DesignSpace(list(design), [0.0] * len(design), [1.0] * len(design))
    plant = Plant(x, u, w, p, after(x, u, p) + w, space, dt=1.0, continuous=False)
    given = {"X": (-1, 1), "U": (-1, 1), "steps": 5, "objective": QuadraticObjective([[1.0]], [[1.0]]),
             "scenarios": FixedStart([0.5], Gaussian([0.01]))}  # fmt: skip
    return CoDesignProblem(discretise(plant), **(given | changes))


@pytest.mark.parametrize(("apart", "together"), [(0.3e-6, True), (3e-6, False)])
def test_two_entries_act_together_below_a_millionth(apart, together):
    """The columns (1, 1 − δ) and (1, 1) have the least singular value δ/√8."""
    second = 1 + np.sqrt(8) * apart
    problem = scalar(lambda x, u, p: (1 + p[0] + p[1]) * x + (1 + p[0] + second * p[1]) * u, ("k", "l"))
    assert acting_together(problem).startswith("k, l act only together") == together


@pytest.mark.parametrize(("part", "named"), [(0.3e-3, "k, l act"), (3e-3, "k, l, m act")])
def test_an_entry_has_a_part_in_what_changes_nothing_from_a_thousandth_on(part, named):
    after = lambda x, u, p: (1 + p[0] + p[1]) * x + (1 + np.sqrt(2) * part * p[1] + p[2]) * u  # noqa: E731
    assert acting_together(scalar(after, ("k", "l", "m"))).startswith(f"{named} only together")


@pytest.mark.parametrize(("beyond", "seen"), [(0.3e-5, False), (3e-5, True)])
def test_a_violation_that_no_input_avoids_counts_from_a_hundred_thousandth_on(beyond, seen):
    begun = FixedStart([1.0], Gaussian([0.01]))
    problem = scalar(lambda x, u, p: (1 + beyond) * x + 1e-9 * p * u, scenarios=begun, steps=1)
    assert (unavoidable_depth(problem, np.array([0.5]))[0] > 0) == seen


@pytest.mark.parametrize(("inside", "alone"), [(0.3e-6, False), (3e-6, True)])
def test_a_plant_stands_alone_whose_eigenvalues_are_a_millionth_inside_the_circle(inside, alone):
    problem = scalar(lambda x, u, p: (1 - inside) * x + (1 + p) * u)
    scenarios = scenario_tensors(problem, 4, np.random.default_rng(0))
    assert _stands_alone(problem, np.array([0.5]), scenarios) == alone


@pytest.mark.parametrize(("part", "accepted"), [(0.3e-5, True), (3e-5, False)])
def test_an_agent_acts_within_U_up_to_what_single_precision_rounds(part, accepted):
    agent = ActorCritic([-1, 0], [1, 1], [-1.0], [1 + 2 * part], config=NetworkConfig((3,)), seed=0)
    problem = scalar(lambda x, u, p: x + (1 + p) * u)
    if accepted:
        check_agent(problem, agent)
    else:
        with pytest.raises(InputError, match="the bounds U"):
            check_agent(problem, agent)


@pytest.mark.parametrize(("away", "put"), [(0.3e-9, 0.0), (3e-9, 3e-9)])
def test_a_search_is_on_a_bound_within_a_billionth(away, put):
    watched = _Watched(lambda v: (0.0, lambda: v), BOX, np.array([0.5, 0.5]), 1.0, 0.0, 9)
    np.testing.assert_array_equal(watched.point(np.array([away, 1 - away])), [put, 1 - put])


def test_a_saturation_is_rounded_off_within_a_thousandth_of_the_range():
    stated = SimpleNamespace(U=None, input_bounds=(-ONE, ONE), design=SimpleNamespace(dim=1))
    missed = 1 - float(fed_back(stated, (1, 1), ca.DM(1.0), ca.DM([0.5, -1.0])))
    assert 0.3e-3 < missed < 3e-3


def test_a_linearisation_is_trusted_in_a_tenth_of_its_ellipsoid():
    linear = scalar(lambda x, u, p: 1.2 * x + (1 + p) * u)
    bent = scalar(lambda x, u, p: 1.2 * ca.sin(x) + (1 + p) * u)
    shapes = [float(LQRRegions.of(problem, np.array([[0.5]])).shapes[0, 0, 0]) for problem in (linear, bent)]
    assert 1 / 0.3 < np.sqrt(shapes[1] / shapes[0]) < 1 / 0.03


@pytest.mark.parametrize(("beyond", "leaving"), [(0.6e-3, 0.0), (6e-3, 1.0)])
def test_an_input_leads_to_the_edge_of_a_set_within_a_thousandth(beyond, leaving):
    S = Polytope.from_bounds([-1.0], [1.0])
    problem = SimpleNamespace(model=SimpleNamespace(advance=lambda x, u, w, p: x + u), mean_disturbance=np.zeros(1))
    begin = SimpleNamespace(sets=[S], p=np.zeros((1, 1)))
    assert _leaving(problem, begin, np.array([[0.5]]), np.array([[0.5 + beyond]])) == leaving


def compared(mean, *, lost=0, outside=0.0, design=0.5, objective=-100.0):
    """A method beside a reference that returns −100, with so many of 3000 runs lost."""
    values = np.full(3000, -100.0)

    def result(change=0.0, lost=0, outside=0.0, p=0.5, **more):
        loop = ClosedLoopReturns(values + change, np.arange(3000) < lost, outside)
        return CoDesignResult(design=np.array([p]), closed_loop=loop, status=CoDesignStatus.CONVERGED, **more)

    gap = PairedDifference(mean, (mean - 0.01, mean + 0.01))
    other = result(mean, lost, outside, design, criterion="sum", objective=objective + mean)
    rows = (MethodRow(name="first", result=result(), difference=PairedDifference(0.0, (0.0, 0.0))),
            MethodRow(name="other", result=other, difference=gap))  # fmt: skip
    problem = scalar(lambda x, u, p: x + (1 + p) * u)
    return MethodComparison(rows=rows, reference="first", size=100.0, problem=problem, seed=0)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"mean": -0.17}, "Equal within 0.5 % of the return of first: first, other"),
        ({"mean": -1.5}, "No other method is within 0.5 % of first."),
        ({"mean": 0.1, "design": 0.507}, "; at one design, "),
        ({"mean": 0.1, "design": 0.56}, "; at designs up to 6% of the box apart"),
        ({"mean": 3.0, "objective": -101.7}, "its criterion is the sum."),
        ({"mean": 3.0, "objective": -115.0}, "its criterion is the sum, -112, beside -97 in closed loop."),
    ],
)
def test_methods_are_equal_within_half_a_per_cent_at_one_design_within_a_fiftieth(given, words):
    assert words in "\n".join(compared(**given).verdict)


@pytest.mark.parametrize(
    ("given", "best"),
    [({"lost": 1}, "other"), ({"lost": 9}, "first"), ({"outside": 0.3e-3}, "other"), ({"outside": 3e-3}, "first")],
)
def test_a_method_is_not_the_best_that_loses_or_leaves_the_limits_a_thousandth_more(given, best):
    assert compared(3.0, **given).best.name == best


def test_what_is_known_ahead_may_be_three_times_the_largest_drawn():
    drawn = np.array([[[0.5], [-2.0]]])
    stated = SimpleNamespace(scenarios=SimpleNamespace(sample=lambda *_: (None, drawn)), steps=2)
    low, high = _drawn_bounds(stated, (0,))
    assert (low[0], high[0]) == (-6.0, 6.0)


def test_returns_behind_by_a_quarter_are_drawn_at_the_lower_edge():
    figure = Figure()
    ax = figure.add_subplot()
    _returns(ax, compared(-500.0), compared(-500.0).rows, {"first": ("k", "o"), "other": ("r", "s")})
    assert -100 - 3 * 25 < ax.get_ylim()[0] < -100 - 25 / 3


@pytest.mark.parametrize(("used", "active"), [(0.5, False), (0.95, True)])
def test_a_limit_of_the_closed_loop_is_active_from_four_fifths_of_its_tolerance_on(used, active):
    outcome = LimitsOutcome(Pair(used, 0.0), Pair(1.0, 1.0), "asked for", Pair(1.0, 1.0))
    found = DesignPoint(ONE, 0.0, ONE, penalty=SimpleNamespace(outcome=lambda seen: outcome, active=True))
    stated = SimpleNamespace(seen=lambda v: None, differences=lambda *_: (ONE, ONE, ONE), _cost_and_violations=None)
    assert ("mean violation of the limits" in LoopCost.examined(stated, found).active) == active


@pytest.mark.parametrize(("blind", "led"), [(0.2, True), (0.9, False)])
def test_a_policy_is_not_led_by_a_gradient_that_half_of_its_runs_lack(monkeypatch, blind, led):
    check = GradientCheck(("direction 1",), 1.0, 1.0, blind=blind)
    monkeypatch.setattr("ccdtools.co_design.settling.gradient_of_policy", lambda *_: check)
    monkeypatch.setattr("ccdtools.co_design.settling.better_by_search", lambda *_: None)
    none = Baseline("retuned", ONE, PairedDifference(0.0, (-1.0, 1.0)))
    stated = SimpleNamespace(
        problem=SimpleNamespace(jump=""),
        _drawn=lambda *_: None,
        _logged=lambda *_: None,
        _in_parts=lambda *_: none,
        _may_have_other_optima=False,
    )
    agent = ActorCritic([-1, 0], [1, 1], [-1.0], [1.0], config=NetworkConfig((3,)), seed=0)
    history = History(*(np.zeros(1) for _ in range(2)), np.zeros((1, 1)), *(np.zeros(1) for _ in range(3)))
    result = LearnedCoDesign(design=0.5 * ONE, agent=agent, history=history, status=CoDesignStatus.CONVERGED)
    found = Settling.confirmed(stated, result, result.controller, None)
    assert (found.status is CoDesignStatus.CONVERGED) == led


@pytest.mark.parametrize(("left", "worth_it"), [(0.6, True), (0.97, False)])
def test_a_block_was_worth_it_that_leaves_nine_tenths_of_a_violation(left, worth_it):
    config = SimpleNamespace(tolerance=1.0, iterations=10)
    stated = SimpleNamespace(
        best=SimpleNamespace(lost=0, violation=left), gain=PairedDifference(0.0, (-1.0, 1.0)), quiet=0, iterations=0,
        task=SimpleNamespace(config=config, method="pathwise", moving=False), limited=True, _size=1.0,
        reach=1.0,
    )  # fmt: skip
    Ascent._judge(stated, SimpleNamespace(lost=0, violation=1.0))
    assert stated.quiet == 1 - worth_it


@pytest.mark.parametrize(("beyond", "led_back"), [(0.06, True), (0.6, False)])
def test_a_state_outside_its_set_by_up_to_a_tenth_is_led_back(monkeypatch, beyond, led_back):
    problem = scalar(lambda x, u, p: x + (1 + p) * u, X=(-9, 9))
    one, E = np.ones((1, 1, 1)), np.ones((1, 1, problem.model.nw))
    regions = SimpleNamespace(A=one, B=one, E=E, designs=[problem.design.centre])
    projected = SimpleNamespace(project=lambda x, u: (0 * u - 0.5, None))
    monkeypatch.setattr(expert_loops, "AdmissibleInputs", lambda A, B, S, U, W: projected)
    filtered = set_filter(problem, SimpleNamespace(regions=regions, sets=[Polytope.from_bounds([-1.0], [1.0])]))
    assert filtered(np.array([[1 + beyond]]), np.zeros((1, 1))) == (-0.5 if led_back else 0.0)


@pytest.mark.parametrize(("gain", "searches"), [(0.3e-7, 2), (3e-7, 3)])
def test_searches_follow_one_another_while_they_gain_a_ten_millionth(monkeypatch, gain, searches):
    begun = []

    def search(value, first, **options):
        begun.append(first)
        value(np.array([0.5 + 0.1 * len(begun)]))

    monkeypatch.setattr("ccdtools.co_design.design_search.minimize", search)
    space = DesignSpace(["p"], [0], [1])
    descend(lambda v: (2 - 20 * gain * v[0], lambda: ONE), space, np.array([0.5]), size=2.0, evaluations=9)
    assert len(begun) == searches


@pytest.mark.parametrize("slope", [1.0, 1.2])
def test_a_slope_is_confirmed_by_differences_over_a_ten_thousandth_of_the_box(slope):
    """Of a cost that bends by as much within a thousandth, and has steps of a two-hundred-and-fifty-thousandth."""

    def cost(v):
        away = v[0] - 0.5
        return np.round((away + 1e6 * away**3) / 4e-6) * 4e-6, lambda: np.array([slope])

    assert confirmed(cost, DesignSpace(["p"], [0], [1]), np.array([0.5]), size=0.0) == (slope == 1.0)
