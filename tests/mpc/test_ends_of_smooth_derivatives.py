"""Derivatives of linear MPC are one-sided, none or far from an end, as constraints are weak, dependent or near."""

import numpy as np
import pytest
from adversarial_laws import KINDS, rows
from differences import slopes
from law_that_changes import START, STATEMENT, A, B, family
from plants import double_integrator

from mpc import Constraint, LinearMPC, SensitivityStatus

REQUIRED = 1e-5


def at_the_bound():
    """A state from which the regulator asks for just what the input allows, and how its input changes with p."""
    A, B = double_integrator()
    controller = LinearMPC(A, B, Q=np.eye(2), R=[[1.0]], horizon=6, U=(-1, 1))
    x = np.array([1.0, 0.6])
    x = x / (controller.gain @ x)[0]
    return controller, x


def test_weakly_active_constraints_are_flagged_and_directions_have_their_own_rates():
    controller, x = at_the_bound()
    dA = np.array([[[0.1], [0.3]], [[0.0], [0.2]]])
    found = controller.sensitivity(x, dA=dA)
    assert found.status is SensitivityStatus.ONE_SIDED
    assert "weakly active" in found.status.advice
    assert found.weakly_active == (Constraint("input", 0, 1),)
    assert not found.active
    assert found.regular
    step = 1e-5
    for dx, dp in (([1.0, 0.0], [0.0]), ([-1.0, 0.0], [0.0]), ([0.2, -1.0], [0.5]), ([0.0, 0.0], [-1.0])):
        ahead = controller.with_model(controller.A + dA @ (step * np.array(dp)), controller.B)
        plan = ahead.solve(x + step * np.array(dx))
        rates = found.along(dx, dp)
        assert rates.inputs == pytest.approx((plan.inputs - found.plan.inputs) / step, abs=1e-3)
        assert rates.states == pytest.approx((plan.states - found.plan.states) / step, abs=1e-3)
    free = controller.sensitivity(x * (1 - 1e-4))
    assert free.smooth
    assert found.inputs_by_state == pytest.approx(free.inputs_by_state, abs=1e-9)
    cost = slopes(lambda y: controller.solve(y).cost, x, [1e-6, 1e-6])
    assert found.cost_by_state == pytest.approx(cost, rel=1e-6)


@pytest.mark.parametrize("side", [-1, 1])
def test_margin_says_how_near_the_next_active_set_is(side):
    controller, x = at_the_bound()
    near = controller.sensitivity(x * (1 + side * 1e-3))
    assert near.smooth
    assert 1e-4 < near.margin < 1e-2
    assert bool(near.active) == (side > 0)


def test_held_inputs_do_not_hide_how_near_the_next_active_set_is():
    controller = LinearMPC(A, B, **STATEMENT, U=(-0.3, 0.3), blocks=(1, 2, 3, 6))
    x = 1.2 * START
    found = controller.sensitivity(x)
    assert found.smooth
    assert {label.kind for label in found.active} == {"input"}
    assert found.margin > 1e-3
    for side in (-1, 1):
        near = controller.sensitivity(x * (1 + 0.1 * side * found.margin))
        assert set(near.active) == set(found.active)
        assert near.input_by_state == pytest.approx(found.input_by_state, abs=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("scale", [1.0, 1e3])
def test_where_derivatives_are_called_smooth_no_limit_is_passed(scale):
    # near these states an input begins or ceases to act while a soft limit is violated
    weights = {"Q": np.array([1.0, 0.1]) / scale**2, "R": 0.1, "horizon": 2, "soft": (1.0, 5.0)}
    controller = LinearMPC(
        A, scale * B, **weights, U=(-0.3, 0.3), X=(scale * np.array([-2, -0.3]), scale * np.array([2, 0.3]))
    )
    for switch in (1.2941188235294252, 1.3871071633238965):
        for off in np.concatenate([-np.logspace(-8, -4, 13), np.logspace(-8, -4, 13)]):
            found = controller.sensitivity(scale * switch * (1 + off) * START)
            assert found.margin > 0 or not found.smooth


def test_dependent_constraints_that_part_are_flagged():
    # full braking for two steps just keeps the speed at its limit: a little more speed, and there is no plan
    A, B = double_integrator()
    controller = LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=10, U=(-1, 1), X=([-5, -1.5], [5, 1.5]))
    found = controller.sensitivity([4.0, 0.5])
    assert found.status is SensitivityStatus.DEPENDENT
    assert not found.regular
    assert found.dependent == (Constraint("state", 2, 3),)
    assert np.isnan(found.along([1.0, 0.0]).cost)


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_at_the_corners_of_a_law_rates_are_its_gains_or_none(kind):
    ((_, found),) = rows(60, 3, (kind,))
    assert set(found) <= {"right", "DEPENDENT, NaN"}
    assert found["right"] > 20


@pytest.mark.parametrize(
    ("A", "B", "horizon", "soft", "signals", "ends", "shares"),
    [
        ([[-0.02, 0.34, -0.09], [-0.15, -1.08, -0.85], [0.71, 0.68, -0.19]], [0.63, -0.97, 1.79], 2, 5.0,
         {"u_prev": [0.48]}, ([-1.45, 0.58, -0.19], [-1.41, 1.0, 0.27]), (0.5085147094726689, 0.508514709472669)),
        ([[-0.46, -0.01, -0.76], [0.38, 0.69, 0.34], [-1.0, -1.39, 0.53]], [-0.38, 0.54, -0.25], 2, 0.5,
         {}, ([0.54, 0.68, 0.12], [0.38, 1.0, -0.18]), (0.5262477759830275, 0.5262477759830276)),
        ([[-0.01, -0.47, -0.23], [0.52, 0.09, -0.47], [-0.2, -0.07, 0.69]], [0.42, 1.04, 2.36], 4, 5.0,
         {"u_prev": [-0.07]}, ([0.68, 0.12, -0.67], [0.74, 0.08, -0.89]), (0.48644196830534187, 0.4864419683053419)),
    ],
    ids=["input held by its rate", "soft limits alone", "four steps"],
)  # fmt: skip
def test_more_limits_met_than_the_plan_has_inputs_give_no_wrong_rates(A, B, horizon, soft, signals, ends, shares):
    limits = {"X": (-0.5, 0.5), "U": (-0.5, 0.5), "soft": (soft, 20.0)} | ({"rate_limit": 0.2} if signals else {})
    controller = LinearMPC(A, np.reshape(B, (-1, 1)), Q=1.0, R=0.1, horizon=horizon, **limits)
    first, last = np.array(ends)
    for share in (*shares, shares[0] - 1e-3, shares[0] + 1e-3):
        x = first + share * (last - first)
        found = controller.sensitivity(x, **signals)
        ahead = controller.solve(x + 1e-4 * (last - first), **signals)
        rates = found.along(last - first)
        if share in shares and found.status is SensitivityStatus.DEPENDENT:
            assert np.isnan(rates.inputs).all()
        else:
            assert rates.inputs == pytest.approx((ahead.inputs - found.plan.inputs) * 1e4, abs=1e-3)


@pytest.mark.parametrize("beyond", [1e-3, 1e-2])
def test_margin_sees_a_violation_that_is_about_to_end(beyond):
    # the inputs are held at their limits: only the slope of the cost jumps where the speed is within its limit again
    controller = LinearMPC([[1.0]], [[0.1]], Q=1.0, R=0.1, horizon=1, U=(-0.5, 0.5), X=(-1.0, 1.0), soft=(5.0, 20.0))
    found = controller.sensitivity([1.05 + beyond])
    assert found.smooth
    assert beyond / 10 < found.margin <= beyond * (1 + 1e-6)
    inside = controller.sensitivity([1.05 - beyond])
    assert abs(found.cost_by_state[0] - inside.cost_by_state[0]) > 5


def test_a_constraint_stated_twice_changes_nothing():
    box = ([-0.05, -0.05], [0.05, 0.05])
    statement = STATEMENT | {"U": (-3, 3)}
    once = LinearMPC(A, B, **statement, terminal_set=box).sensitivity(START, dA=family(1)["dA"])
    far = ([-0.05, -0.05], [0.05, 0.05])
    twice = LinearMPC(A, B, **(statement | {"blocks": None}), terminal_set=_doubled(far)).sensitivity(
        START, dA=family(1)["dA"]
    )
    assert not twice.regular
    assert twice.dependent
    assert twice.smooth
    assert twice.inputs_by_parameters == pytest.approx(once.inputs_by_parameters, rel=1e-7, abs=1e-9)
    assert twice.cost_by_parameters == pytest.approx(once.cost_by_parameters, rel=1e-7)


def _doubled(box):
    """A box with every row twice, once in another unit."""
    from types import SimpleNamespace

    lower, upper = map(np.array, box)
    rows, bounds = np.vstack([np.eye(2), -np.eye(2)]), np.concatenate([upper, -lower])
    return SimpleNamespace(A=np.vstack([rows, 7 * rows]), b=np.concatenate([bounds, 7 * bounds]))


@pytest.mark.parametrize("room", [1e-4, 1e-5, 3e-6])
def test_a_soft_limit_that_the_plan_only_comes_near_does_not_push(room):
    """The rate limit decides the first state, which keeps a little room to its soft limit: the cost is smooth there."""
    A = np.array([[0.1, -0.8, 0.2], [-0.6, -0.3, 0.1], [-0.3, 0.2, 0.1]])
    B = np.array([[-0.4], [2.9], [-0.4]])
    mpc = LinearMPC(A, B, Q=1.0, R=0.1, horizon=3, U=(-0.5, 0.5), X=(-0.5, 0.5), soft=(5.0, 20.0), rate_limit=0.2)
    last = {"u_prev": [0.41]}
    x = np.array([0.69, (0.1 * 0.69 + 0.2 * 0.2 - 0.4 * 0.21 - 0.5 * (1 - room)) / 0.8, 0.2])
    assert mpc.solve(x, **last).states[1, 0] == pytest.approx(0.5 * (1 - room), abs=1e-12)
    moved = np.array([0.0, 1e-7, 0.0])
    expected = (mpc.solve(x + moved, **last).cost - mpc.solve(x - moved, **last).cost) / 2e-7
    sensitivity = mpc.sensitivity(x, **last)
    assert sensitivity.status is SensitivityStatus.SMOOTH
    assert sensitivity.margin == pytest.approx(room, rel=1e-6)
    assert sensitivity.along([0.0, 1.0, 0.0]).cost == pytest.approx(expected, rel=1e-5)


def test_a_limit_that_is_passed_by_as_much_as_rounding_decides_is_met_or_acts():
    """A plan of which one rate limit acts from some state on: next to that state it never counts as neither."""
    A = np.array(
        [
            [0.18089289678750647, 0.48653306819065284, -0.05697017087073391],
            [0.40610119309398635, -0.11794358065227739, 1.1573122525389195],
            [0.12348576114586524, -0.176628767070605, -1.121032477283419],
        ]
    )
    B = np.array([[0.45757388702260815], [-0.4034421712858918], [-0.03163922518024754]])
    x = np.array([0.20103873363044802, 0.14560152772011448, 0.30192457884842333])
    along = np.array([0.4022714429034858, -0.9129606523493713, -1.2655934529116821])
    last = {"u_prev": [-0.013437282809325879]}
    mpc = LinearMPC(A, B, Q=1.0, R=0.1, horizon=4, U=(-0.5, 0.5), X=(-0.5, 0.5), soft=(0.5, 20.0), rate_limit=0.2)
    for step in range(-7, 8):
        sensitivity = mpc.sensitivity(x + 1e-15 * step**3 * along, **last)
        if sensitivity.status is SensitivityStatus.SMOOTH:
            assert sensitivity.margin > 0.0
            assert sensitivity.along(along).cost == pytest.approx(-13.95, abs=0.01)
        else:
            assert np.isnan(sensitivity.along(along).cost)
