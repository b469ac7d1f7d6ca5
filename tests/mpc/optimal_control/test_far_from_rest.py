"""Plans that begin far from rest are the best of what Ipopt finds from several places, and every one is an optimum."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from nonlinear_programs import optimum

from mpc import InputError, NotConvexError, Status
from mpc.optimal_control import NonlinearMPC, sampled

Q, R = np.diag([10.0, 10.0, 0.1, 0.1]), np.diag([0.01, 0.01])
STRONGEST = np.array([6.0, 3.0])
HANGING = np.array([np.pi, 0.0, 0.0, 0.0])


def arm(x, u):
    """Two links of 1 kg and 0.5 m, angles from upright, 40 ms later."""

    def rate(x):
        c, s = ca.cos(x[1]), ca.sin(x[1])
        own, cross, outer = 0.25 * (5 / 3 + c), 0.25 * (1 / 3 + c / 2), 0.25 / 3
        lower, upper = 0.75 * 9.81 * ca.sin(x[0]), 0.25 * 9.81 * ca.sin(x[0] + x[1])
        a = u[0] + 0.125 * s * (2 * x[2] * x[3] + x[3] ** 2) + lower + upper
        b = u[1] - 0.125 * s * x[2] ** 2 + upper
        whole = own * outer - cross**2
        return ca.vertcat(x[2], x[3], (outer * a - cross * b) / whole, (own * b - cross * a) / whole)

    for _ in range(2):
        k1 = rate(x)
        k2 = rate(x + 0.01 * k1)
        k3 = rate(x + 0.01 * k2)
        x = x + 0.02 / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + 0.02 * k3))
    return x


def law(sx=1.0, su=1.0, cost=1.0, **changes):
    """The arm's controller in other units."""
    return NonlinearMPC(
        lambda x, u: sx * arm(x / sx, u / su), 4, 2, Q=cost * Q / sx**2, R=cost * R / su**2, horizon=40,
        U=(-su * STRONGEST, su * STRONGEST), **changes,
    )  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("x", [HANGING, [2.8, 0.5, 0.0, 0.0]])
def test_the_plan_is_the_best_of_several_starts(x):
    x = np.asarray(x)
    controller = law()
    plan = controller.solve(x)
    columns = ca.SX.sym("x", 4), ca.SX.sym("u", 2)
    model = ca.Function("model", columns, [arm(*columns)])
    way = np.linspace(1, 0, 41)[:, None] * x
    found = [
        optimum(model, x, Q=Q, R=R, P=controller.linear.P, horizon=40, U=(-STRONGEST, STRONGEST),
                guess=(states, np.zeros((40, 2))))[0]
        for states in (np.tile(x, (41, 1)), way)
    ]  # fmt: skip
    assert plan.status is Status.SOLVED
    assert plan.cost <= min(found) * (1 + 1e-6)
    assert plan.cost < 0.9 * law(starts=1).solve(x).cost  # the linear law leads to a dearer optimum


@pytest.mark.long
@pytest.mark.parametrize(("sx", "su", "cost"), [(57.3, 1e3, 1e-4), (1e-3, 1e-2, 1e6)])
def test_units_do_not_matter(sx, su, cost):
    plan, other = law().solve(HANGING), law(sx, su, cost).solve(sx * HANGING)
    assert other.status is Status.SOLVED
    assert other.cost / cost == pytest.approx(plan.cost, rel=1e-6)


@pytest.mark.long
def test_it_swings_up_and_every_plan_on_the_way_is_solved():
    controller, x = law(), HANGING
    solvers = []
    for _ in range(60):
        u = controller(x)
        assert controller.last_plans[0].status is Status.SOLVED
        solvers.append(controller.last_plans[0].solver)
        x = np.asarray(arm(x, u)).ravel()
    assert np.abs(x).max() < 0.05
    assert set(solvers[1:]) == {"SQP"}  # quadratic programs alone, without the interior-point solver


@pytest.mark.long
def test_a_solver_that_is_stopped_goes_on_in_the_next_sample():
    controller, x = law(most_iterations=5, starts=1), HANGING
    statuses = []
    for _ in range(80):
        u = controller(x)
        statuses.append(controller.last_plans[0].status)
        x = np.asarray(arm(x, u)).ravel()
    assert statuses[0] is not Status.SOLVED
    assert statuses[-1] is Status.SOLVED
    assert np.abs(x).max() < 0.01


@pytest.mark.long
def test_after_a_kick_it_is_the_optimum_again():
    controller = law()
    controller(0.1 * HANGING)
    controller(HANGING)
    assert controller.last_plans[0].status is Status.SOLVED
    assert controller.last_plans[0].cost <= law(starts=1).solve(HANGING).cost * (1 + 1e-6)


def damped(x, u):
    """Machine on a heavy base [mm, mm/s] 10 ms later, the damper between them set by u from −1 to 1."""

    def rate(x):
        force = 9.0 * (1.1 + u[0]) * (x[1] - x[3]) + 400 * (x[0] - x[2])
        return ca.vertcat(x[1], -900 * x[0] - force, x[3], 3 * force - 2000 * x[2])

    k1 = rate(x)
    k2 = rate(x + 0.005 * k1)
    k3 = rate(x + 0.005 * k2)
    return x + 0.01 / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + 0.01 * k3))


@pytest.mark.long
def test_inputs_that_go_from_bound_to_bound_are_followed_by_quadratic_programs():
    controller = NonlinearMPC(
        damped, 4, 1, Q=np.diag([1.0, 1e-4, 0.3, 1e-5]), R=[[1e-6]], horizon=40, U=([-1.0], [1.0])
    )  # fmt: skip
    model = ca.Function("model", columns := (ca.SX.sym("x", 4), ca.SX.sym("u", 1)), [damped(*columns)])
    stated = {"Q": controller.Q, "R": np.array([[1e-6]]), "P": controller.linear.P, "U": (np.array([-1.0]), np.ones(1))}
    x, rng, solvers = np.array([10.0, 0.0, -5.0, 100.0]), np.random.default_rng(3), []
    for _ in range(9):
        u = controller(x)
        plan = controller.last_plans[0]
        solvers.append(plan.solver)
        assert plan.status is Status.SOLVED
        if len(solvers) % 4 == 1:
            there = optimum(model, x, horizon=40, guess=(plan.states, plan.inputs), **stated)[0]
            assert plan.cost == pytest.approx(there, rel=1e-6)
        x = np.asarray(model(x, u)).ravel() + 0.5 * rng.normal(size=4) * [1.0, 60.0, 0.5, 120.0]
    assert solvers[1:].count("SQP") >= 7


@pytest.mark.long
def test_the_same_starts_every_time():
    plans = [law(starts=5).solve(HANGING) for _ in range(2)]
    assert (plans[0].inputs == plans[1].inputs).all()


def unicycle(x, u):
    return ca.vertcat(x[0] + 0.1 * u[0] * ca.cos(x[2]), x[1] + 0.1 * u[0] * ca.sin(x[2]), x[2] + 0.1 * u[1])


@pytest.mark.parametrize("starts", [1, 3])
def test_a_plan_that_stands_still_at_a_saddle_is_left(starts):
    weights = {"Q": np.diag([1, 1, 0.1]), "R": np.diag([0.05, 0.05]), "P": np.diag([10.0, 10, 1]), "horizon": 20}
    limit, aside = np.array([1.0, 2.0]), np.array([0.0, 1.0, 0.0])
    controller = NonlinearMPC(unicycle, 3, 2, **weights, U=(-limit, limit), starts=starts)
    columns = ca.SX.sym("x", 3), ca.SX.sym("u", 2)
    near = aside + 1e-3 * np.array([0, 0, 1])
    best, *_ = optimum(ca.Function("model", columns, [unicycle(*columns)]), near, **weights, U=(-limit, limit),
                       guess=(np.tile(near, (21, 1)), np.zeros((20, 2))))  # fmt: skip
    plan = controller.solve(aside)  # whose first derivatives say that no input moves it there
    assert plan.status is Status.SOLVED
    assert plan.cost == pytest.approx(best, rel=1e-2)
    controller([0.0, 0.0, 0.0])
    controller([0.0, 0.0, 0.0], x_ref=aside)  # it follows a plan that stands still
    assert controller.last_plans[0].status is Status.SOLVED
    assert controller.last_plans[0].cost == pytest.approx(best, rel=1e-2)


@pytest.mark.check
def test_threads_may_share_a_controller():
    controller, states = law(), [angle / 8 * HANGING for angle in range(1, 9)]
    alone = [controller.solve(x) for x in states]
    with ThreadPoolExecutor(8) as threads:
        together = list(threads.map(controller.solve, states))
    assert all((one.inputs == other.inputs).all() for one, other in zip(alone, together))


@pytest.mark.long
def test_limits_of_states_that_cannot_be_kept_far_from_rest_are_softened():
    wide = np.array([10.0, 10.0, 5.0, 5.0])
    plan = law(X=(-wide, wide)).solve([np.pi, 0.0, 30.0, 0.0])
    assert plan.status is Status.SOFTENED
    assert plan.violation > 1.0
    assert (np.abs(plan.inputs) <= STRONGEST * (1 + 1e-9)).all()


@pytest.mark.long
def test_limits_that_a_known_disturbance_breaks_have_their_price_at_rest_too():
    def pole(x, u, w):
        sine, cosine = ca.sin(x[2]), ca.cos(x[2])
        push = (u[0] + w[0] + 0.1 * x[3] ** 2 * sine - 1.962 * sine * cosine) / (1 + 0.2 * sine**2)
        return ca.vertcat(x[1], push, x[3], (9.81 * sine - push * cosine) / 0.5)

    track = np.array([0.6, 9, 9, 99])
    controller = NonlinearMPC(
        sampled(pole, 0.04), 4, 1, Q=[4, 0.25, 25, 0.25], R=0.01, horizon=30, X=(-track, track), U=(-10, 10),
        disturbances=1,
    )  # fmt: skip
    pushed = np.full((30, 1), 12.0)
    at_rest, beside = (controller.solve([0, 0, angle, 0], w=pushed) for angle in (0.0, 0.05))
    assert at_rest.status is beside.status is Status.SOFTENED
    assert at_rest.violation == pytest.approx(beside.violation, rel=0.05)


@pytest.mark.parametrize("far", [1e80, 1e150, 1e200])
def test_a_plan_whose_slopes_overflow_is_left_for_another(far):
    controller = NonlinearMPC(lambda x, u: x + 0.1 * x**3 + u, 2, 2, Q=[1, 1], R=[1, 1], horizon=5, U=(-1, 1))
    plan = controller.solve([0.5, 0.2])
    states = plan.states.copy()
    states[1:] = far
    again = controller.solve([0.5, 0.2], start=replace(plan, states=states))
    assert again.status is Status.SOLVED
    assert again.inputs == pytest.approx(plan.inputs, abs=1e-5)


@pytest.mark.parametrize("starts", [0, -1, 1.5, "all"])
def test_starts_are_a_count(starts):
    with pytest.raises(InputError) as caught:
        law(starts=starts)
    assert caught.value.argument == "starts"


@pytest.mark.long
def test_costates_are_the_slopes_of_the_cost_by_the_states():
    controller = NonlinearMPC(lambda x, u, w: unicycle(x, u) + w, 3, 2, Q=[1, 1, 0.1], R=[0.05, 0.05], P=[10, 10, 1],
                              horizon=15, U=([-1, -2], [1, 2]), disturbances=3)  # fmt: skip
    x, step = [1.0, 0.5, 0.3], 1e-4
    costates = controller.solve(x).costates
    for k in (0, 7):
        for i in range(3):
            w = np.zeros((15, 3))
            w[k, i] = step
            up, down = (controller.solve(x, w=sign * w).cost for sign in (1, -1))
            assert costates[k, i] == pytest.approx((up - down) / (2 * step), rel=1e-4, abs=1e-6)


@pytest.mark.long
def test_a_horizon_too_long_for_a_condensed_program_is_built():
    stated = {"Q": [1, 1, 0.1], "R": [0.05, 0.05], "P": [10, 10, 1], "horizon": 5000, "U": ([-1, -2], [1, 2])}
    controller = NonlinearMPC(unicycle, 3, 2, **stated)
    with pytest.raises(InputError, match="horizon"):
        _ = controller.linear


def test_an_input_that_costs_nothing_is_refused():
    with pytest.raises(NotConvexError, match="input is free of cost"):
        NonlinearMPC(lambda x, u: 0.5 * x + 0 * u, 1, 1, Q=[1], R=[0], P=[1], horizon=3, U=(-1, 1))


@pytest.mark.long
def test_a_real_time_iteration_beyond_hard_limits_goes_to_the_optimum():
    """A plan that is shifted to a state after a kick may leave limits that the optimum keeps."""
    limits = {"X": ([-9, -9, -7, -7], [9, 9, 7, 7])}
    real_time, whole = law(iterations=1, **limits), law(**limits)
    before = whole.solve(HANGING)
    rng = np.random.default_rng(0)
    for k in (5, 10, 15, 20):
        x = before.states[k] + np.append(np.zeros(2), rng.choice([-1.5, 1.5], 2))
        x[2:] = np.clip(x[2:], -6.5, 6.5)
        plan = real_time.solve(x, start=before)
        assert plan.status is not Status.SOFTENED or whole.solve(x).status is Status.SOFTENED
