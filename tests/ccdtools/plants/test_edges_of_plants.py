"""What counts as allowed, as a jump, as at rest or as accurate turns at the number that its page states."""

import warnings

import casadi as ca
import numpy as np
import pytest

import ccdtools as cc
from ccdtools import DesignSpace, InputError, Plant, discretise, equilibrium, linearise
from ccdtools.exceptions import JumpWarning, SamplingWarning

NONE = DesignSpace([], [], [])
HALF = DesignSpace(["p", "q"], [0, 0], [2, 2], constraints=lambda p: p[0] - 1.0, constraint_names=["p below 1"])


def plant(rates, nx=1, dt=0.1, design=NONE, **more):
    """A plant of so many states and one input, dx/dt = rates(x, u)."""
    x, u = ca.SX.sym("x", nx), ca.SX.sym("u")
    return Plant(x, u, None, ca.SX.sym("p", design.dim), rates(x, u), design, dt, **more)


def jumps(*given, **limits):
    """Whether the model of a plant without inputs says that its right-hand side jumps."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", JumpWarning)
        discretise(plant(*given), **limits)
    return bool(caught)


# ── designs ──


@pytest.mark.parametrize(("beyond", "allowed"), [(0.3e-6, True), (3e-6, False)])
def test_a_design_keeps_a_constraint_up_to_a_millionth_of_the_box(beyond, allowed):
    design = [1 + 2 * beyond, 1.0]
    assert HALF.feasible(design) == allowed
    if allowed:
        np.testing.assert_allclose(HALF.check_feasible(design), [1, 1], atol=1e-9)
    else:
        with pytest.raises(InputError, match="expected constraints ≤ 0"):
            HALF.check_feasible(design)


@pytest.mark.parametrize(("beyond", "within"), [(0.3e-9, True), (3e-9, False)])
def test_a_design_is_within_bounds_up_to_a_billionth_of_their_range(beyond, within):
    assert DesignSpace(["p"], [0], [2]).feasible([2 + 2 * beyond]) == within


@pytest.mark.parametrize(("beyond", "moved"), [(0.3e-10, False), (3e-10, True)])
def test_a_violation_of_the_last_digits_is_rounding_and_is_left(beyond, moved):
    assert (HALF.project([1 + 2 * beyond, 1.0])[0] < 1 + beyond) == moved


@pytest.mark.parametrize(("away", "price"), [(0.3e-7, 1.0), (3e-7, 0.0)])
def test_a_constraint_holds_a_design_within_a_ten_millionth_of_its_edge(away, price):
    found = HALF.allowed.prices(np.array([0.5 - away, 0.5]), np.array([1.0, 0.0]), np.array([True, True]))
    np.testing.assert_allclose(found[1], [price], atol=1e-9)


@pytest.mark.parametrize(("away", "active"), [(0.3e-3, True), (3e-3, False)])
def test_a_constraint_is_named_active_within_a_thousandth_of_its_edge(away, active):
    assert ("p below 1" in HALF.active_constraints([1 - 2 * away, 1.0])) == active


def test_the_size_of_a_constraint_is_not_that_of_its_poles():
    """A violation counts in parts of what g varies by over nine tenths of the box; in 3 % of it g is above 100."""
    space = DesignSpace(["p"], [0], [1], constraints=lambda p: p[0] - 0.5 + 100.0 * (p[0] > 0.97))
    assert space.violation([0.6]) == pytest.approx(0.1 / 0.9, rel=0.03)


@pytest.mark.parametrize(("slope", "level"), [(0.3e-12, True), (3e-12, False)])
def test_a_constraint_is_level_where_its_slope_is_a_trillionth_of_its_value(slope, level):
    space = DesignSpace(["p", "q"], [0, 0], [1, 1], constraints=lambda p: slope * p[0] - 1.0)
    assert np.isinf(space.allowed.limits.edges(np.array([0.5, 0.5]))[1][0]) == level


@pytest.mark.parametrize(("left", "slope"), [(0.3, 1 / 0.3), (0.03, 1.0)])
def test_the_nearest_point_beside_a_disc_moves_faster_unless_the_centre_is_near(left, slope):
    """From so many radii off the centre the nearest point of the circle moves by 1/left."""
    space = DesignSpace(["p", "q"], [0, 0], [1, 1], constraints=lambda p: 0.09 - ca.sumsqr(p - 0.5))
    at, nearest = np.array([0.5 + 0.3 * left, 0.5]), np.array([0.8, 0.5])
    moved = space.allowed.pulled_back(at, nearest, np.array([0.0, 1.0]), np.array([True, True]))
    np.testing.assert_allclose(moved, [0, slope], rtol=1e-4, atol=1e-5)


# ── steps ──


@pytest.fixture(scope="module")
def cubic():
    """ẋ = −x³, with x(t) = x/√(1 + 2 x² t)."""
    return plant(lambda x, u: -(x**3) + 0 * u, dt=0.5)


def test_a_step_is_accurate_to_a_millionth_unless_asked(cubic):
    limits = {"X": (-1, 1), "U": (-1, 1)}
    own = discretise(cubic, **limits).error.relative
    coarser, finer = (discretise(cubic, accuracy=part, **limits).error.relative for part in (1e-5, 1e-7))
    assert finer < own <= 1e-6 < coarser


def test_the_stated_error_is_above_the_true_one_and_not_far(cubic):
    model = discretise(cubic, X=(-1, 1), U=(-1, 1), accuracy=1e-3)
    x = np.linspace(-1, 1, 401)[:, None]
    true = np.abs(model.advance(x, 0 * x, np.zeros((401, 0)), np.zeros(0)) - x / np.sqrt(1 + 2 * x**2 * 0.5)).max()
    assert 1.5 < model.error.bound[0] / true < 6


@pytest.mark.parametrize(("part", "warned"), [(0.3, False), (0.7, False), (0.9, True)])
def test_oscillations_above_four_fifths_of_half_the_sampling_rate_are_warned_of(part, warned):
    fast = plant(lambda x, u: ca.vertcat(x[1], -((part * np.pi / 0.1) ** 2) * x[0] + u), nx=2)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SamplingWarning)
        discretise(fast)
    assert bool(caught) == warned


# ── jumps ──


@pytest.mark.parametrize(("at", "found"), [(300.0, True), (3000.0, False)])
def test_without_limits_jumps_are_looked_for_up_to_a_thousand(at, found):
    assert jumps(lambda x, u: ca.if_else(x > at, -1.0, -2.0)) == found


@pytest.mark.parametrize(("gap", "found"), [(0.3e-12, False), (3e-12, True)])
def test_a_change_by_a_trillionth_of_the_rates_is_no_jump(gap, found):
    assert jumps(lambda x, u: 1 + gap / 2 * ca.sign(x), X=(-1, 1), U=(-1, 1), accuracy=0.5) == found


@pytest.mark.parametrize(("away", "refused"), [(0.3e-9, True), (3e-9, False)])
def test_a_point_is_at_a_jump_within_a_billionth(away, refused):
    relay = plant(lambda x, u: ca.vertcat(x[1] + u, -ca.sign(x[1]) - x[0]), nx=2)
    if refused:
        with pytest.raises(InputError, match="got a point at which the dynamics of x2 jump"):
            linearise(relay, [0.0, away])
    else:
        assert linearise(relay, [0.0, away]).linear


# ── rest ──


@pytest.mark.parametrize(("moved", "refused"), [(0.3e-9, False), (3e-9, True)])
def test_a_model_rests_that_moves_by_a_billionth_of_what_a_state_of_one_does(moved, refused):
    model = discretise(
        plant(lambda x, u: ca.sin(x) + u + moved, dt=1.0, design=DesignSpace(["p"], [1], [2]), continuous=False)
    )
    given = {"X": (-1, 1), "U": (-1, 1), "steps": 3, "scenarios": cc.FixedStart([0.5], cc.Gaussian([])),
             "objective": cc.QuadraticObjective([[1.0]], [[1.0]], design_cost=lambda p: p[0])}  # fmt: skip
    if refused:
        with pytest.raises(InputError, match="a plant that does not rest at x = 0, u = 0: x1 moves by 3e-09"):
            cc.CoDesignProblem(model, **given)
    else:
        assert cc.CoDesignProblem(model, **given).steps == 3


@pytest.mark.parametrize(("part", "rests"), [(0.3e-9, True), (3e-9, False)])
def test_a_rate_is_zero_within_a_billionth_of_its_terms(part, rests):
    given = {"x": [1.0], "u": [1 + 2 * part]}
    balanced = plant(lambda x, u: u - x)
    if rests:
        assert equilibrium(balanced, **given).x[0] == 1.0
    else:
        with pytest.raises(InputError, match="no equilibrium"):
            equilibrium(balanced, **given)


@pytest.mark.parametrize(("pivot", "unique"), [(0.3e-9, False), (3e-9, True)])
def test_an_equation_within_a_billionth_of_another_says_nothing_new(pivot, unique):
    twice = plant(lambda x, u: ca.vertcat(x[0] + x[1] + u, x[0] + (1 + 2 * pivot) * x[1] + u), nx=2)
    assert equilibrium(twice, x=[np.nan, np.nan], u=[0.0]).unique == unique
