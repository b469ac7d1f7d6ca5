"""Nonlinear MPC is linear MPC on linear models, the optimum of the nonlinear program on others, and always an input."""

import copy

import casadi as ca
import numpy as np
import pytest

from mpc import InputError, LinearMPC, Status
from mpc.optimal_control import NonlinearMPC, Phase, build, solve

A = np.array([[1.0, 0.1], [0.05, 1.1]])
B = np.array([[0.005], [0.1]])
E = np.array([[0.0], [0.1]])
WEIGHTS = {"Q": [1.0, 0.1], "R": 0.1, "horizon": 12}


def linear_step(x, u, w):
    """A linear model."""
    return ca.DM(A) @ x + ca.DM(B) @ u + ca.DM(E) @ w


def cart_pole(x, u, p):
    """A pole of length p on a cart, upright at 0, sampled by two Runge–Kutta steps of 25 ms."""

    def rate(z):
        s, c = ca.sin(z[1]), ca.cos(z[1])
        free = 1.0 + 0.2 * s**2
        push = (u + 0.2 * s * (9.81 * c - p[0] * z[3] ** 2)) / free
        return ca.vertcat(z[2], z[3], push, (u * c + 1.2 * 9.81 * s - 0.2 * p[0] * z[3] ** 2 * s * c) / (p[0] * free))

    for _ in range(2):
        h = 0.025
        k1 = rate(x)
        k2 = rate(x + h / 2 * k1)
        k3 = rate(x + h / 2 * k2)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3))
    return x


def pole(**changes):
    """The controller of the cart-pole."""
    return NonlinearMPC(
        cart_pole, 4, 1,
        **({"Q": [1, 5, 0.1, 0.1], "R": 0.05, "horizon": 30, "U": (-10, 10), "p": [0.5],
            "X": ([-2, -4, -np.inf, -np.inf], [2, 4, np.inf, np.inf])} | changes),
    )  # fmt: skip


def closed_loop(controller, x, samples):
    """Cost of a run, and its last state."""
    cost = 0.0
    columns = ca.SX.sym("x", 4), ca.SX.sym("u")
    plant = ca.Function("plant", columns, [cart_pole(*columns, [0.5])])
    for _ in range(samples):
        u = controller(x)
        cost += x @ np.diag([1, 5, 0.1, 0.1]) @ x + 0.05 * u @ u
        x = np.asarray(plant(x, u)).ravel()
    return cost, x


@pytest.mark.parametrize(
    ("limits", "signals"),
    [
        ({}, {}),
        ({"U": (-1, 1), "X": ([-2, -0.6], [2, 0.6])}, {}),
        ({"U": (-1, 1), "rate_limit": 0.2}, {"u_prev": [0.3]}),
        ({"U": (-1, 1), "X": ([-2, -0.3], [2, 0.3]), "soft": (50.0, 20.0)}, {}),
        ({"U": (-1, 1)}, {"x_ref": [0.2, 0.0], "w": np.linspace(-0.2, 0.4, 12)[:, None]}),
        ({"U": (-1, 1), "S": [[0.05], [0.02]]}, {}),
        ({"U": (-3, 3), "terminal_set": ([-0.05, -0.05], [0.05, 0.05])}, {}),
    ],
    ids=["free", "limits", "rate", "soft", "reference and preview", "cross weight", "terminal set"],
)
def test_on_a_linear_model_it_is_linear_mpc(limits, signals):
    x = np.array([0.4, -0.25])
    linear = LinearMPC(A, B, E=E, **WEIGHTS, **limits).solve(x, **signals)
    nonlinear = NonlinearMPC(linear_step, 2, 1, disturbances=1, **WEIGHTS, **limits).solve(x, **signals)
    assert nonlinear.status is linear.status
    assert nonlinear.inputs == pytest.approx(linear.inputs, abs=1e-6)
    assert nonlinear.cost == pytest.approx(linear.cost, rel=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("angle", [0.4, 1.2])
def test_plan_is_the_optimum_of_the_nonlinear_program(angle):
    controller = pole()
    plan = controller.solve([0.1, angle, 0, 0])
    P = controller.linear.P
    phase = Phase(
        lambda x, u: cart_pole(x, u, [0.5]), 4, 1, start=[0.1, angle, 0, 0], duration=30, discrete=True,
        stage_cost=lambda x, u: ca.bilin(ca.diag(ca.DM([1, 5, 0.1, 0.1])), x) + 0.05 * u**2,
        terminal_cost=lambda x: ca.bilin(ca.DM(P), x), u_bounds=(-10, 10),
        x_bounds=([-2, -4, -np.inf, -np.inf], [2, 4, np.inf, np.inf]),
        guess=(np.arange(30) / 30, plan.states[:30] * 0.9, plan.inputs * 0.9),
    )  # fmt: skip
    reference = solve(build(phase), tolerance=1e-10)
    assert plan.status is Status.SOLVED
    assert reference.solved
    assert plan.cost == pytest.approx(reference.cost, rel=1e-6)
    assert plan.inputs[0] == pytest.approx(reference.u(0.0), abs=1e-4)


@pytest.mark.long
def test_real_time_iteration_follows_the_optimum():
    x = np.array([0.0, 0.3, 0.0, 0.0])
    converged, _ = closed_loop(pole(), x, 60)
    followed, end = closed_loop(pole(iterations=1), x, 60)
    assert followed == pytest.approx(converged, rel=0.01)
    assert np.abs(end).max() < 0.1


@pytest.mark.check
def test_it_swings_the_pole_up():
    _, end = closed_loop(pole(), np.array([0.0, 3.1, 0.0, 0.0]), 100)
    assert np.abs(end).max() < 0.05


def test_from_outside_the_limits_they_are_relaxed_and_inputs_kept():
    plan = pole().solve([2.5, 0.0, 0.0, 0.0])
    assert plan.status is Status.SOFTENED
    assert np.abs(plan.inputs).max() <= 10
    assert plan.violation > 0.1


@pytest.mark.long
def test_every_finite_state_has_an_admissible_input():
    controller = pole(most_iterations=5)
    rng = np.random.default_rng(3)
    for x in rng.normal(size=(6, 4)) * [5, 5, 20, 40]:
        controller.reset()
        u = controller(x)
        assert np.isfinite(u).all()
        assert np.abs(u).max() <= 10 + 1e-9


@pytest.mark.long
def test_rows_have_plans_of_their_own():
    x = np.array([[0.0, 0.3, 0.0, 0.0], [0.5, -0.4, 0.1, 0.0]])
    together, alone = pole(), [pole(), pole()]
    for _ in range(3):
        u = together(x)
        assert u == pytest.approx(np.array([one(row) for one, row in zip(alone, x)]), abs=1e-6)
        x = x * 0.97


@pytest.mark.long
def test_parameters_change_without_building_anew():
    controller = pole()
    other = controller.with_parameters([0.8])
    assert other.model is controller.model
    x = [0.1, 0.3, 0.0, 0.0]
    assert other.solve(x).inputs == pytest.approx(pole(p=[0.8]).solve(x).inputs, abs=1e-6)
    assert controller.solve(x).inputs == pytest.approx(pole().solve(x).inputs, abs=1e-6)  # SOLVED to 1e-8 of the KKT
    assert copy.copy(controller).solve(x).cost == pytest.approx(controller.solve(x).cost)


@pytest.mark.parametrize(
    ("arguments", "argument"),
    [
        ({"step": lambda x, u: x + 1.0}, "step"),
        ({"step": lambda x, u: ca.sqrt(x) + u}, "step"),
        ({"step": lambda x, v: x}, "step"),
        ({"Q": [1.0]}, "Q"),
        ({"iterations": 0}, "iterations"),
        ({"p": [[1.0]]}, "p"),
        ({"step": lambda x: ca.vertcat(x, x)}, "step"),
        ({"step": lambda x, u: 1 / 0}, "step"),
        ({"step": lambda x, u: 0.9 * x + u + ca.SX.sym("z", 2)}, "step"),
        ({"step": "0.9 x"}, "step"),
        ({"step": lambda x, u: 0.9 * x + u / ca.sum1(u)}, "step"),
        ({"states": 0}, "states"),
        ({"horizon": 2.5}, "horizon"),
        ({"most_iterations": -1}, "most_iterations"),
        ({"time_limit": 0.0}, "time_limit"),
        ({"time_limit": "1 ms"}, "time_limit"),
        ({"disturbances": -1}, "disturbances"),
        ({"U": ([1, 1], [-1, -1])}, "U"),
        ({"X": (0, 1, 2)}, "X"),
        ({"soft": (1.0,)}, "soft"),
        ({"rate_limit": -1.0}, "rate_limit"),
        ({"terminal_set": "big"}, "terminal_set"),
        ({"uses": ("preview",)}, "uses"),
    ],
)
def test_a_bad_statement_is_refused(arguments, argument):
    good = {"step": lambda x, u: 0.9 * x + u, "Q": [1.0, 1.0], "R": [1.0, 1.0], "horizon": 3}
    settings = good | arguments
    step, states = settings.pop("step"), settings.pop("states", 2)
    with pytest.raises(InputError) as caught:
        NonlinearMPC(step, states, 2, **settings)
    assert caught.value.argument == argument


@pytest.mark.parametrize("size", [1e-12, 1.0, 1e12])
def test_whether_a_model_rests_does_not_depend_on_units(size):
    def stated(drift):
        return NonlinearMPC(
            lambda x, u: 0.9 * x + u + drift * size, 1, 1, Q=1 / size**2, R=1 / size**2, horizon=3, U=(-size, size)
        )  # fmt: skip

    assert stated(1e-12).solve([0.5 * size]).status is Status.SOLVED
    with pytest.raises(InputError, match="moves from rest"):
        stated(1e-3)


@pytest.mark.parametrize(
    ("call", "argument"),
    [
        (lambda law: law.solve([0.0, 1.0]), "x"),
        (lambda law: law.solve([0.0, np.nan, 0, 0]), "x"),
        (lambda law: law([[0.0, np.inf, 0, 0]]), "x"),
        (lambda law: law(np.zeros(4), w=[0.0]), "w"),
        (lambda law: law(np.zeros(4), speed=[0.0]), "speed"),
        (lambda law: law.solve(np.zeros(4), x_ref=np.zeros((3, 4))), "x_ref"),
        (lambda law: law.solve(np.zeros(4), u_prev=[0.0]), "u_prev"),
        (lambda law: law.solve(np.zeros(4), start=3), "start"),
        (lambda law: law.solve(np.zeros(4), start=pole(horizon=5).solve(np.zeros(4))), "start"),
        (lambda law: law.with_parameters([1.0, 2.0]), "p"),
        (lambda law: law.with_parameters([np.nan]), "p"),
        (lambda law: law.with_parameters([0.0]), "step"),  # a pole without length
    ],
)
def test_a_bad_call_is_refused(call, argument):
    with pytest.raises(InputError) as caught:
        call(pole())
    assert caught.value.argument == argument


@pytest.mark.parametrize("units", [(1.0, 1.0), (1e6, 1e-3)], ids=["alike", "N and kN"])
def test_two_inputs_in_a_polytope_are_those_of_linear_mpc(units):
    from invariant_sets import Polytope

    A, B = np.array([[1.0, 0.1], [0.05, 1.1]]), np.array([[0.1, 0.02], [0.01, 0.1]]) / units
    U = Polytope(np.array([[1, 1], [-1, 0], [0, -1], [1, -2.0]]) / units, [1.0, 0.6, 0.5, 0.8])
    stated = {"Q": [1.0, 0.1], "R": 0.1 / np.square(units), "horizon": 10, "U": U, "rate_limit": 0.3 * np.array(units)}
    linear = LinearMPC(A, B, **stated)
    nonlinear = NonlinearMPC(lambda x, u: ca.DM(A) @ x + ca.DM(B) @ u, 2, 2, **stated)
    for x in ([0.5, -0.3], [-0.9, 0.4], [0.05, 0.0]):
        plan, expected = (law.solve(x, u_prev=[0.1 * units[0], 0.0]) for law in (nonlinear, linear))
        assert plan.status is expected.status is Status.SOLVED
        assert plan.inputs / units == pytest.approx(expected.inputs / units, abs=1e-6)
        assert (plan.inputs @ U.A.T <= U.b + 1e-9).all()


@pytest.mark.long
def test_out_of_time_the_best_there_is_stands_in_and_says_so():
    x = [0.1, 1.2, 0.0, 0.0]
    late = pole(time_limit=1e-9)
    first = late.solve(x)
    optimum = pole().solve(x)
    assert first.status is Status.LATE
    assert not first.feasible
    assert np.abs(first.inputs).max() <= 10
    assert first.cost > optimum.cost
    from_optimum = late.solve(x, start=optimum)  # a plan that is there already is not given up
    assert from_optimum.status is Status.LATE
    assert from_optimum.cost == pytest.approx(optimum.cost, rel=1e-6)
    assert pole(time_limit=60.0).solve(x).status is Status.SOLVED


@pytest.mark.long
def test_out_of_time_in_every_sample_it_still_gets_there():
    cost, end = closed_loop(pole(time_limit=1e-9), np.array([0.0, 0.3, 0.0, 0.0]), 60)
    converged, _ = closed_loop(pole(), np.array([0.0, 0.3, 0.0, 0.0]), 60)
    assert cost == pytest.approx(converged, rel=0.05)
    assert np.abs(end).max() < 0.1


def test_a_model_that_ends_within_the_limits_gets_the_linear_law():
    def step(x, u):
        return 0.9 * x + u * ca.sqrt(1 - x**2)  # no number beyond |x| = 1

    plan = NonlinearMPC(step, 1, 1, Q=1.0, R=1.0, horizon=5, U=(-1, 1)).solve([2.0])
    assert plan.status is Status.REPLACED
    assert plan.solver == "linear law"
    assert np.isfinite(plan.inputs).all()
    assert np.isfinite(plan.states).all()


def test_a_real_time_iteration_is_not_called_solved_away_from_the_optimum():
    controller = pole(iterations=1)
    controller([0.0, 0.3, 0.0, 0.0])
    assert controller.last_plans[0].status is Status.SOLVED  # the first sample goes to the optimum
    controller([0.0, 0.6, 0.0, 0.0])  # far from where the plan led
    assert controller.last_plans[0].status is Status.FOLLOWED
    assert controller.last_plans[0].residuals.worst > 1e-3
