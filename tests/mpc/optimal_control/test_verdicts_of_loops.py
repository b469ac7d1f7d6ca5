"""Plans of phases say what is so: limits of every size and price, saddles, inputs that cannot be kept, no numbers."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from mpc import Status
from mpc.optimal_control import NonlinearMPC, Phase


def runge_kutta(rate, x, h):
    """State one classical step of h later."""
    k1 = rate(x)
    k2 = rate(x + h / 2 * k1)
    k3 = rate(x + h / 2 * k2)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3))


def braking(stop, edge, **bounds):
    """Vehicle of 6 m/s that stops within `stop` metres; a disc of 1 m on the way."""
    speed, dt = 6.0, 0.1
    hardest = speed**2 / (2 * stop)
    return Phase(
        lambda x, u: ca.vertcat(x[0] + dt * x[1] + dt**2 / 2 * u, x[1] + dt * u), 2, 1, discrete=True, duration=40,
        u_bounds=(-hardest, hardest), stage_cost=lambda x, u: (x[1] - speed) ** 2 + 0.01 * u**2,
        path=lambda x: 1 - (x[0] - edge - 1) ** 2, **bounds,
    )  # fmt: skip


@pytest.mark.parametrize("lowest", [-np.inf, -1e4])
def test_an_obstacle_that_cannot_be_kept_off_is_said_however_long_the_way(lowest):
    controller = NonlinearMPC(braking(9.0, 8.98, x_bounds=([lowest, 0], [np.inf, np.inf])))
    for _ in range(3):
        controller(np.array([0.0, 6.0]))
        (plan,) = controller.last_plans
        over = float(np.max(1 - (plan.states[1:, 0] - 9.98) ** 2))
        assert plan.status is Status.SOFTENED
        assert plan.violation == pytest.approx(over, abs=1e-6)
        assert over > 0.03
    assert (
        NonlinearMPC(braking(9.0, 9.02, x_bounds=([lowest, 0], [np.inf, np.inf]))).solve([0, 6]).status is Status.SOLVED
    )


@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_a_violation_is_told_in_the_unit_of_its_limit(unit):
    phase = Phase(
        lambda x, u: x + 0.1 * unit * u, 1, 1, discrete=True, duration=10, u_bounds=(-1, 1),
        x_bounds=(-unit, unit), stage_cost=lambda x, u: (x / unit) ** 2 + u**2,
    )  # fmt: skip
    controller = NonlinearMPC(phase)
    for _ in range(2):
        controller(np.array([1.6 * unit]))
        (plan,) = controller.last_plans
        assert plan.status is Status.SOFTENED
        assert plan.violation == pytest.approx(0.5 * unit, rel=1e-6)


@pytest.mark.parametrize("limit", [lambda u: u - 0.1, lambda u, u_prev: u - u_prev - 0.1])
def test_a_limit_of_inputs_alone_that_has_a_price_may_be_passed_in_every_sample(limit):
    phase = Phase(
        lambda x, u: ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * (u - ca.sin(x[0]))), 2, 1, discrete=True, duration=15,
        u_bounds=(-3, 3), stage_cost=lambda x, u: 10 * (x[0] - 2) ** 2 + 0.01 * u**2, path=limit, path_prices=(1, 0),
    )  # fmt: skip
    controller, x = NonlinearMPC(phase), np.array([0.0, 0.0])
    given = {"u_prev": [0.0]} if limit.__code__.co_argcount == 2 else {}
    for _ in range(3):
        u = controller(x, **given)
        (plan,), anew = controller.last_plans, controller.solve(x, **given)
        assert plan.status is anew.status is Status.SOLVED
        assert plan.cost == pytest.approx(anew.cost, rel=1e-6)
        assert u[0] > 1
        given = {"u_prev": u} if given else {}
        x = np.array([x[0] + 0.1 * x[1], x[1] + 0.1 * (u[0] - np.sin(x[0]))])


def test_a_plan_that_stands_at_a_maximum_when_the_reference_turns_is_left():
    signal = np.full((31, 1), -1.0)
    phase = Phase(
        lambda x, u: ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * (u - 5 * ca.sin(x[0]))), 2, 1, discrete=True,
        duration=30, u_bounds=(-3, 3), signal=signal,
        stage_cost=lambda x, u, w: 10 * (1 + w * ca.cos(x[0])) + 0.1 * x[1] ** 2 + 0.1 * u**2,
    )  # fmt: skip
    controller = NonlinearMPC(phase)
    controller(np.zeros(2))
    controller(np.zeros(2), w=-signal)
    (plan,) = controller.last_plans
    assert plan.status is Status.SOLVED
    assert plan.cost < 500
    assert plan.cost == pytest.approx(controller.solve(np.zeros(2), w=-signal).cost, rel=1e-5)


def test_inputs_that_cannot_be_reached_from_the_one_before_are_infeasible():
    phase = Phase(
        lambda x, u: x + 0.01 * (u - x), 1, 1, discrete=True, duration=5, u_bounds=(280, 340),
        stage_cost=lambda x: (x - 300) ** 2, guess=([0, 1], [[290], [290]], [[290], [290]]),
    )  # fmt: skip
    quadratic = NonlinearMPC(
        lambda x, u: 0.9 * x + u + 0.1 * x**2, 1, 1, Q=1, R=1, horizon=5, U=(-1, 1), rate_limit=0.05
    )
    for controller, x, before in ((NonlinearMPC(phase, rate_limit=5.0), 290.0, 270.0), (quadratic, 0.1, 3.0)):
        assert controller.solve([x], u_prev=[before]).status is Status.INFEASIBLE
    assert NonlinearMPC(phase, rate_limit=5.0).solve([290.0], u_prev=[278.0]).status is Status.SOLVED


def test_a_model_that_is_no_number_at_the_state_is_replaced():
    phase = Phase(
        lambda x, u: ca.vertcat(x[0] + 0.1 * u, ca.sqrt(x[0])), 2, 1, discrete=True, duration=5, u_bounds=(-1, 1),
        stage_cost=lambda x, u: x[0] ** 2 + u**2,
    )  # fmt: skip
    assert NonlinearMPC(phase).solve([-1.0, 0.0]).status is Status.REPLACED


def test_a_limit_that_is_no_number_is_not_kept():
    phase = Phase(
        lambda x, u: ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * u), 2, 1, discrete=True, duration=10, u_bounds=(-1, 1),
        stage_cost=lambda x, u: (x[0] - 1) ** 2 + u**2, path=lambda x: ca.log(x[0] + 0.5) - 9,
    )  # fmt: skip
    controller = NonlinearMPC(phase)
    told = []
    for x in ([1.0, 0.0], [-1.0, 0.0], [-1.0, 0.0]):
        controller(np.array(x))
        told += [(plan.status, plan.violation) for plan in controller.last_plans]
    assert told[0][0] is Status.SOLVED
    assert [status for status, _ in told[1:]] == 2 * [Status.REPLACED]
    assert all(np.isinf(violation) for _, violation in told[1:])


@pytest.mark.parametrize("lowest", [-np.inf, -1e3, -1e6, -1e9])
def test_a_bound_on_one_side_that_nothing_reaches_tells_no_size(lowest):
    # the wall is at 1, and braking with all force from 1.5 at 0.9 ends beyond it
    phase = Phase(
        lambda x, u: ca.vertcat(x[0] + 0.1 * x[1] + 0.005 * u, x[1] + 0.1 * u), 2, 1, discrete=True, duration=20,
        u_bounds=(-1, 1), x_bounds=([lowest, -9], [1, 9]), stage_cost=lambda x, u: ca.sumsqr(x) + 0.1 * u**2,
    )  # fmt: skip
    controller = NonlinearMPC(phase)
    for _ in range(2):
        controller(np.array([0.9, 1.5]))
        (plan,) = controller.last_plans
        x = np.array([0.9, 1.5])
        for u, planned in zip(plan.inputs[:, 0], plan.states[1:]):
            x = np.array([x[0] + 0.1 * x[1] + 0.005 * u, x[1] + 0.1 * u])
            assert planned == pytest.approx(x, abs=1e-9)
        assert plan.status is Status.SOFTENED
        assert plan.violation == pytest.approx(plan.states[:, 0].max() - 1, rel=1e-9)


def test_a_plan_that_moves_along_a_ridge_is_left():
    """A well becomes a ridge between two wells while another state moves: what stays on the ridge is no optimum."""
    ones = np.ones((16, 1))
    phase = Phase(
        lambda x, u: ca.vertcat(x[0] + u[0], x[1] + 0.5 * ca.sin(u[1])), 2, 2, discrete=True, duration=15,
        u_bounds=(-1, 1), signal=ones,
        stage_cost=lambda x, u, w: w * x[0] ** 2 + 0.1 * x[0] ** 4 + ca.exp(x[1]) - x[1] + ca.sumsqr(u),
    )  # fmt: skip
    controller = NonlinearMPC(phase, uses=("preview",))
    for y in (1.0, 0.5, -1.0):
        controller([0, y], w=ones)
    controller([0, 1.2], w=-0.4 * ones)
    (plan,) = controller.last_plans
    assert plan.status is Status.SOLVED
    assert plan.cost == pytest.approx(13.541547, rel=1e-6)


def test_a_limit_whose_slope_runs_away_hides_nothing():
    """The solver ends where log x has no slope to speak of in its sizes; the optimum costs 2.5560."""
    phase = Phase(
        lambda x, u: ca.vertcat(x[1], u), 2, 1, duration=2.0, u_bounds=(-3, 3), x_bounds=(-20, 20),
        stage_cost=lambda x, u: ca.sumsqr(x) + 0.1 * u**2, path=lambda x: ca.log(x[0]) - 0.2,
        guess=([0, 1], [[0.9, 0], [0.9, 0]], [[0], [0]]),
    )  # fmt: skip
    plan = NonlinearMPC(phase, horizon=10).solve([1.5, -2])
    assert plan.status is not Status.SOLVED or plan.cost == pytest.approx(2.5560422, rel=1e-6)


def test_a_model_that_escapes_over_the_horizon_does_not_end_the_process():
    """Steps of Euler's rule that are too long: a concentration grows thirtyfold in every one, to 1e36."""
    phase = Phase(
        lambda x, u: ca.vertcat(x[0] + 0.1 * (u - x[0] * x[1]), x[1] + 0.1 * (300 - x[1] + 20 * u)), 2, 1,
        discrete=True, duration=25, u_bounds=(0, 5), x_bounds=([0, 0], [1e6, 1e6]),
        stage_cost=lambda x, u: (x[1] - 320) ** 2 + 0.01 * u**2,
    )  # fmt: skip
    controller = NonlinearMPC(phase)
    for _ in range(2):
        assert np.isfinite(controller([0.1, 300.0])).all()
        assert controller.last_plans[0].status is not Status.SOLVED


@pytest.mark.parametrize("load", [1.0, 10.0])
@pytest.mark.parametrize("pull", [3.2, 4.0])
def test_a_plan_before_a_disc_is_left_when_the_pull_changes_though_another_costate_is_larger(load, pull):
    """A state that nothing moves has the largest multiplier, which hid that the disc's had changed."""

    def cost(x, w):
        return -w * x[0] + 0.5 * x[0] ** 2 + x[1] ** 2

    phase = Phase(
        lambda x, u: ca.vertcat(x[0] + u[0], x[1] + u[1], x[2]), 3, 2, discrete=True, duration=8,
        stage_cost=lambda x, u, w: cost(x, w) + 0.2 * ca.sumsqr(u) + load * (x[2] - 1) ** 2, terminal_cost=cost,
        u_bounds=(-0.5, 0.5), path=lambda x: (x[0] - 2) ** 2 + x[1] ** 2, path_bounds=(1, np.inf),
        signal=np.zeros((9, 1)),
    )  # fmt: skip
    controller = NonlinearMPC(phase)
    before = controller.solve([1, 0, 0], w=[1.5])
    assert np.abs(before.states[:, 1]).max() < 1e-6
    found = controller.solve([1, 0, 0], start=before, w=[pull])
    assert found.status is Status.SOLVED
    assert found.cost == pytest.approx(controller.solve([1, 0, 0], w=[pull]).cost, rel=1e-6)


def test_other_parameters_have_the_terminal_cost_that_is_theirs():
    """Sizes of states follow the parameters where there is no X; the statement for Ipopt took those of the first."""

    def controller(p):
        return NonlinearMPC(
            lambda x, u, p: ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * (p * u - 3 * ca.sin(3 * x[0]))), 2, 1, p=[p],
            Q=np.diag([1, 0.1]), R=0.01 * 1e6, horizon=25, U=(-2e-3, 2e-3),
        )  # fmt: skip

    other = controller(1.0).with_parameters([1e3])
    assert other.solve([4.2, 0]).cost == pytest.approx(controller(1e3).solve([4.2, 0]).cost, rel=1e-6)


def test_a_disc_that_another_way_keeps_off_is_not_softened():
    """The loop went 0.02 deep into the disc where a solve of the same controller kept off it."""
    centre, radius = np.array([-0.191, -0.603]), 0.223

    def step(x, u):
        rate = lambda z: ca.vertcat(z[1], (1 - z[0] ** 2) * z[1] - z[0] + u)  # noqa: E731
        for _ in range(2):
            x = runge_kutta(rate, x, 0.075)
        return x

    law = NonlinearMPC(Phase(
        step, 2, 1, discrete=True, duration=13, u_bounds=(-1.2, 1.2), stage_cost=lambda x, u: ca.sumsqr(x) + 0.1 * u**2,
        terminal_cost=lambda x: 5 * ca.sumsqr(x), path=lambda x: radius**2 - ca.sumsqr(x - centre),
    ))  # fmt: skip
    x = np.array([0.273, -0.684])
    for k in range(9):
        x = x + np.array([0.172, -0.3]) if k == 4 else x
        u = law(x)
        assert law.last_plans[0].status is Status.SOLVED
        x = np.asarray(ca.DM(step(ca.DM(x), ca.DM(u)))).ravel()
        assert np.hypot(*(x - centre)) >= radius - 1e-6


def test_a_late_plan_that_keeps_limits_is_followed_as_one_in_time():
    def step(x, u):
        rate = lambda z: ca.vertcat(z[2] * ca.cos(z[3]), z[2] * ca.sin(z[3]), u)  # noqa: E731
        return runge_kutta(rate, x, 0.1)

    discs = np.array([[3, 0.05, 1], [5, -1.6, 0.8], [5, 1.5, 0.8]])
    law = NonlinearMPC(Phase(
        step, 4, 2, discrete=True, duration=20, u_bounds=([-6, -2.5], [6, 2.5]),
        x_bounds=([-99, -99, 0.5, -99], [99, 99, 6, 99]),
        stage_cost=lambda x, u: 0.1 * ((x[0] - 9) ** 2 + x[1] ** 2) + 0.02 * u[0] ** 2 + 0.05 * u[1] ** 2,
        path=lambda x: ca.vertcat(*(area - (x[0] - a) ** 2 - (x[1] - b) ** 2 for a, b, area in discs)),
    ))  # fmt: skip
    before = law.solve([-0.014, -0.25, 4.441, 0.081])
    for status in (Status.SOLVED, Status.LATE):
        assert law.solve([0.794, -0.521, 6.046, 0.327], start=replace(before, status=status)).status is Status.SOLVED


def test_a_plan_is_late_where_its_time_was_up():
    law = lambda limit: NonlinearMPC(Phase(  # noqa: E731
        lambda x, u: ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * (u - ca.sqrt(x[0] + 1))), 2, 1, discrete=True,
        duration=30, u_bounds=(-1, 1), x_bounds=([-1, -5], [60, 5]), end=([50, 0], [50, 0]),
        stage_cost=lambda x, u: (x[0] - 3) ** 2 + u**2,
    ), starts=1, most_iterations=20, time_limit=limit)  # fmt: skip
    anew = law(None)
    free = min((anew.solve([0.5, 0]) for _ in range(2)), key=lambda plan: plan.solve_time)
    assert free.status is Status.REPLACED
    limit = 1.6 * free.solve_time
    found = law(limit).solve([0.5, 0])
    assert found.status is Status.REPLACED or found.solve_time > 0.8 * limit


@pytest.mark.parametrize("iterations", [1, None])
@pytest.mark.parametrize(("x", "spike"), [([2, 0], [-9.8, 0]), ([-1.18, 38.34], [0.29, -475.99])])
def test_a_levitation_comes_back_after_a_spike_of_its_sensor(x, spike, iterations):
    def step(x, u):
        rate = lambda z: ca.vertcat(z[1], 9810 - 9810 * ((1 + u) / (1 + z[0] / 10)) ** 2)  # noqa: E731
        for _ in range(2):
            x = runge_kutta(rate, x, 0.0025)
        return x

    law = NonlinearMPC(
        step, 2, 1, iterations=iterations, Q=[1, 1e-4], R=20, X=([-8, -900], [6, 900]), U=([-0.9], [1.5]), horizon=15
    )
    for k in range(30):
        u = law(np.array(spike if k == 5 else x))
        if k > 5:
            assert law.last_plans[0].violation < 0.1
        x = np.asarray(ca.DM(step(ca.DM(x), ca.DM(u)))).ravel()
    assert abs(x[0]) < 0.1


@pytest.mark.parametrize("price", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize(
    ("pull", "drag", "push", "load", "effort", "most", "horizon", "unit", "best"),
    [
        (0.759, 0.02, 0.525, 2.477, 0.669, 2.017, 24, 8.279, 47.72),
        (1.754, 0.406, 0.892, 0.416, 0.782, 2.034, 28, 0.01, 9.394),
        (0.731, 0.307, 0.664, 2.419, 0.187, 1.139, 22, 51.132, 39.87),
        (1.097, 0.057, 0.671, 1.558, 0.097, 2.629, 19, 0.118, 21.41),
        (0.842, 0.391, 1.58, 2.352, 0.027, 2.602, 16, 75.092, 21.41),
    ],
)  # fmt: skip
def test_a_plan_that_rests_between_two_wells_is_left(pull, drag, push, load, effort, most, horizon, unit, best, price):
    """By its actuator's lag it hardly moves there, so that its own moves tell no size."""

    def step(x, u):
        rate = lambda z: ca.vertcat(  # noqa: E731
            z[1], pull * z[0] - z[0] ** 3 / unit**2 - drag * z[1] + z[2], 3 * (push * unit * u - z[2])
        )
        return runge_kutta(rate, x, 0.1)

    law = NonlinearMPC(Phase(
        step, 3, 1, discrete=True, duration=horizon, u_bounds=(-most, most),
        stage_cost=lambda x, u: price * (load * ((x[0] / unit) ** 2 - 1) ** 2 + effort * u**2),
    ))  # fmt: skip
    anew = law.solve([0, 0, 0])
    still = replace(
        anew, states=np.zeros((horizon + 1, 3)), inputs=np.zeros((horizon, 1)), costates=np.zeros((horizon, 3)),
        pushes=0 * anew.pushes, hessian=None,
    )  # fmt: skip
    for plan in (anew, law.solve([0, 0, 0], start=still)):
        assert plan.status is Status.SOLVED
        assert plan.cost == pytest.approx(price * best, rel=1e-3)


def test_starts_by_chance_keep_bounds_that_are_far_from_zero():
    law = NonlinearMPC(Phase(
        lambda x, u: x + 0.1 * (u - 1e4 - ca.sin(3 * x)), 1, 1, discrete=True, duration=15, u_bounds=(9990, 10010),
        stage_cost=lambda x, u: (x**2 - 1) ** 2 + 0.1 * (u - 1e4) ** 2,
    ), starts=6)  # fmt: skip
    plan = law.solve([0.0])
    assert plan.status is Status.SOLVED
    assert ((plan.inputs >= 9990) & (plan.inputs <= 10010)).all()
