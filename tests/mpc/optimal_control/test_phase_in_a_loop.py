"""Nonlinear MPC of a `Phase`: plans are the optima of plain Ipopt, loops keep what the phase states."""

import copy
import pickle
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from ipopt_reference import Reference
from random_statements import law_of, random_statement

from mpc import InputError, Status
from mpc.optimal_control import (
    HermiteSimpson,
    MultipleShooting,
    NonlinearMPC,
    OffsetFreeNonlinearMPC,
    OptimalControlProblem,
    OptimalControlStatus,
    Phase,
    Radau,
    Trapezoidal,
    build,
    solve,
)


def step(x, u):
    """A mass, pushed; a tenth of a second later."""
    return ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * u[0])


def cost(x, u):
    """Squares."""
    return ca.sumsqr(x) + u**2


def push(**stated):
    """Phase of ten steps of the mass."""
    usual = {"dynamics": step, "stage_cost": cost, "duration": 10, "discrete": True, "u_bounds": (-1, 1)}
    return Phase(**(usual | {"states": 2, "inputs": 1} | stated))


@pytest.mark.parametrize("seed", [1, 2, 3, 4, 5, 8])
def test_a_random_statement_has_the_best_optimum_of_plain_ipopt_from_eleven_places(seed):
    one = random_statement(seed)
    law, signals = law_of(one, 3)
    plan = law.solve(one.x * one.size_x, **signals)
    reference = Reference(one)
    best = min(reference.from_(*start)[0] for start in reference.starts())
    found, over = reference.worth(plan.states / one.size_x, plan.inputs / one.size_u)
    assert plan.status is Status.SOLVED
    assert found <= best + 1e-6 * max(1.0, abs(best))
    assert over <= 1e-6
    assert plan.cost / one.unit == pytest.approx(found, rel=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("seed", [25, 40])
def test_what_no_start_can_meet_is_softened(seed):
    one = random_statement(seed)
    law, signals = law_of(one, 1)
    plan = law.solve(one.x * one.size_x, **signals)
    reference = Reference(one)
    assert not np.isfinite(min(reference.from_(*start)[0] for start in reference.starts()))
    assert plan.status is Status.SOFTENED
    assert plan.violation > 1e-3
    assert (np.abs(plan.inputs) <= reference.limit * one.size_u).all()


def test_the_plan_of_a_loop_is_the_plan_of_the_phase():
    stated = {"path": lambda x: x[1], "path_bounds": (-0.3, np.inf), "path_prices": (0.3, 2.0), "end": [0.7, None]}
    plan = NonlinearMPC(push(**stated)).solve([1.0, 0.0])
    solution = solve(push(start=[1.0, 0.0], **stated))
    assert plan.status is Status.SOLVED
    assert solution.solved
    assert plan.cost == pytest.approx(solution.cost, rel=1e-6)
    assert plan.states == pytest.approx(solution.phases[0].states, abs=1e-5)


def test_a_phase_in_continuous_time_is_sampled():
    stated = {"dynamics": lambda x, u: u - x**3, "states": 1, "inputs": 1, "stage_cost": lambda x, u: x**2 + u**2}
    plan = NonlinearMPC(Phase(duration=2.0, **stated), horizon=20).solve([1.0])
    exact = solve(build(Phase(duration=2.0, start=[1.0], **stated), MultipleShooting(4), 20))
    assert plan.cost == pytest.approx(exact.cost, rel=1e-7)


@pytest.mark.parametrize("scheme", [Radau(3), Trapezoidal(), HermiteSimpson()])
def test_a_soft_limit_costs_what_a_violation_stated_as_an_input_costs(scheme):
    stated = {"states": 1, "start": [1.0], "duration": 1.0}
    soft = Phase(lambda x, u: u, inputs=1, stage_cost=lambda x, u: (x - 2) ** 2 + 0.1 * u**2, path=lambda x: x,
                 path_bounds=(-9, 1.2), path_prices=(0.5, 0.3), **stated)  # fmt: skip
    spelt = Phase(lambda u: u[0], inputs=2, u_bounds=([-np.inf, 0], np.inf), path=lambda x, u: x - 1.2 - u[1],
                  stage_cost=lambda x, u: (x - 2) ** 2 + 0.1 * u[0] ** 2 + 0.5 * u[1] + 0.3 * u[1] ** 2,
                  **stated)  # fmt: skip
    found = solve(build(soft, scheme, 20))
    assert found.status is OptimalControlStatus.SOLVED  # what is passed at its price passes no limit
    assert found.cost == pytest.approx(solve(build(spelt, scheme, 20)).cost, rel=1e-6)
    assert found.phases[0].states.max() > 1.21


def test_an_obstacle_that_moves_is_avoided_by_the_clock():
    def clear(x, t):
        return 0.04 - (x[0] - 1.5 + 0.05 * t) ** 2 - (x[1] - 0.05) ** 2

    phase = Phase(
        lambda x, u: x + 0.1 * u, 2, 2, stage_cost=lambda x, u: ca.sumsqr(x) + 0.1 * ca.sumsqr(u), path=clear,
        terminal_cost=lambda x: 20 * ca.sumsqr(x), u_bounds=(-1, 1), duration=15, discrete=True,
    )  # fmt: skip
    law, x = NonlinearMPC(phase), np.array([2.0, 0.0])
    for k in range(30):
        u = law(x, t=k)
        assert law.last_plans[0].status is Status.SOLVED
        x = x + 0.1 * u
        assert float(clear(x, k + 1)) <= 1e-6
    assert np.linalg.norm(x) < 0.3


def test_signals_parameters_and_references_change_from_sample_to_sample():
    phase = push(
        stage_cost=lambda x, u, w, p: p[0] * (x[0] - w) ** 2 + 0.1 * u**2, terminal_cost=lambda x, w: (x[0] - w) ** 2,
        signal=lambda t: np.sin(t)[:, None],
    )  # fmt: skip
    law = NonlinearMPC(phase, p=[2.0])
    ahead = np.sin(3.0 + np.arange(11.0))[:, None]
    assert law.solve([0, 0], t=3.0).cost == pytest.approx(law.solve([0, 0], t=0.0, w=ahead).cost, rel=1e-9)
    assert law.needs == {"time"}
    assert law([0, 0], time=3) == pytest.approx(law.solve([0, 0], t=3.0).inputs[0], abs=1e-6)
    other = law.with_parameters([5.0])
    fresh = NonlinearMPC(phase, p=[5.0])
    assert other.solve([0, 0], t=1.0).cost == pytest.approx(fresh.solve([0, 0], t=1.0).cost, rel=1e-7)
    assert law.solve([0, 0], t=1.0).cost < other.solve([0, 0], t=1.0).cost


@pytest.mark.parametrize("far", [1.0, 1e6, 1e9])
def test_what_is_given_has_no_part_in_the_sizes_of_cost_and_limits(far):
    plan = NonlinearMPC(push(stage_cost=lambda x, u, p: cost(x, u) + 1e-6 * p**2), p=[far]).solve([1.0, 0.5])
    assert plan.inputs == pytest.approx(NonlinearMPC(push()).solve([1.0, 0.5]).inputs, abs=1e-6)
    late = push(path=lambda x, t: t - far + 5 - x[1], start_time=far)  # speeds of 5, which no input reaches
    plan = NonlinearMPC(late).solve([1.0, 0.0], t=far)
    assert plan.status is Status.SOFTENED
    assert plan.violation > 1e-3


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_states_without_bounds_are_planned_in_any_unit(unit):
    """A boat whose heading no input turns at rest."""

    def sail(x, u):
        x = x / unit
        return unit * (x + 0.2 * ca.vertcat(x[3] * ca.cos(x[2]), x[3] * ca.sin(x[2]), u[1] * x[3], u[0] - 0.2 * x[3]))

    stated = {"duration": 10, "discrete": True, "u_bounds": (-1, 1)}
    boat = Phase(sail, 4, 2, stage_cost=lambda x, u: ca.sumsqr(x / unit) + 0.1 * ca.sumsqr(u), **stated)
    spelt = Phase(lambda x, u: sail(unit * x, u) / unit, 4, 2, stage_cost=lambda x, u: cost(x, 0) + 0.1 * ca.sumsqr(u),
                  **stated)  # fmt: skip
    start = np.array([0.8, -0.8, -0.9, -0.5])
    assert NonlinearMPC(boat).solve(unit * start).cost == pytest.approx(NonlinearMPC(spelt).solve(start).cost, rel=1e-6)


def test_changes_of_inputs_are_limited_and_priced_from_the_last_input_on():
    phase = push(stage_cost=lambda x, u, u_prev: ca.sumsqr(x) + 3 * (u - u_prev) ** 2)
    law = NonlinearMPC(phase, rate_limit=0.2)
    assert law.needs == {"last_input"}
    plan = law.solve([1.0, 0.0], u_prev=[0.5])
    moves = np.diff(plan.inputs[:, 0], prepend=0.5)
    assert np.abs(moves).max() <= 0.2 + 1e-7
    assert np.abs(moves).max() > 0.19
    total = (plan.states[:-1] ** 2).sum() + 3 * (moves**2).sum()
    assert plan.cost == pytest.approx(total, rel=1e-7)
    rows = law([[1.0, 0.0], [0.0, 1.0]], u_prev=[[0.5], [0.0]])
    assert rows[0] == pytest.approx(plan.inputs[0], abs=1e-6)


def test_a_state_outside_its_bounds_returns_into_them():
    plan = NonlinearMPC(push(x_bounds=(-1, 1))).solve([1.01, -0.9])
    assert plan.status is Status.SOLVED
    assert plan.states[1:].max() <= 1 + 1e-6


def test_a_loop_that_begins_beyond_its_limits_is_softened_until_it_is_back():
    law, x = NonlinearMPC(push(x_bounds=(-1, 1)), rate_limit=0.5), np.array([1.2, 0.0])
    u, statuses = np.zeros(1), []
    for _ in range(12):
        u = law(x, u_prev=u)
        statuses.append(law.last_plans[0].status)
        x = np.asarray(step(x, u)).ravel()
    assert statuses[0] is Status.SOFTENED
    assert statuses[-1] is Status.SOLVED
    assert set(statuses) == {Status.SOFTENED, Status.SOLVED}
    assert x[0] < 1.0


def test_copies_answer_alike_and_remember_for_themselves():
    law = NonlinearMPC(push())
    first = law([1.0, 0.0])
    stored = pickle.loads(pickle.dumps(law))
    assert stored([1.0, 0.0]) == pytest.approx(first, abs=1e-8)
    assert copy.deepcopy(law).last_plans == ()


def test_a_time_limit_is_said():
    assert NonlinearMPC(push(), time_limit=1e-4).solve([1.0, 0.0]).status is Status.LATE


def test_late_plans_come_to_the_optimum_from_sample_to_sample():
    """A limit below one program: the plan begins with two iterations of Ipopt, as did every later one, for ever."""

    def step(x, u):
        return ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * (4 * ca.sin(x[0]) - 0.2 * x[1] + u))

    cost = lambda x: 10 * x[0] ** 2 + x[1] ** 2  # noqa: E731
    phase = Phase(step, 2, 1, discrete=True, duration=30, u_bounds=(-6, 6), x_bounds=(-4, 4),
                  stage_cost=lambda x, u: cost(x) + 0.1 * u**2, terminal_cost=lambda x: 10 * cost(x))  # fmt: skip
    late, free, x = NonlinearMPC(phase, time_limit=1e-4), NonlinearMPC(phase), np.array([1.0, 0.0])
    for _ in range(12):
        before, x = x, np.array(step(x, late(x)[0])).ravel()
    (plan,) = late.last_plans
    assert plan.status is Status.LATE
    assert plan.cost == pytest.approx(free.solve(before).cost, rel=1e-3)
    assert abs(x[0]) < 0.5


def test_a_solver_that_is_stopped_goes_on_at_the_next_sample():
    law, x = NonlinearMPC(push(), most_iterations=3, starts=1), np.array([1.0, 0.5])
    statuses = []
    for _ in range(60):
        u = law(x)
        plan = law.last_plans[0]
        statuses.append(plan.status)
        assert (np.abs(u) <= 1).all()
        x = np.asarray(step(x, u)).ravel()
    assert statuses[0] is not Status.SOLVED
    assert np.linalg.norm(x) < 0.5 * np.linalg.norm([1.0, 0.5])


def test_where_nothing_is_finite_the_guess_stands_in():
    plan = NonlinearMPC(push(stage_cost=lambda x, u: ca.log(x[0] - 3) + u**2, start=[4, 0])).solve([1.0, 0.0])
    assert plan.status is Status.REPLACED
    assert plan.solver == "guess"
    assert (plan.inputs == 0).all()


def test_states_that_inputs_by_chance_lead_out_of_the_numbers_are_no_warning():
    plan = NonlinearMPC(push(stage_cost=lambda x, u: ca.sumsqr(x) + u**2, u_bounds=(0, 1))).solve([1e300, 0.0])
    assert plan.status is Status.REPLACED
    assert np.isfinite(plan.inputs).all()


def test_a_row_of_the_wrong_width_is_told_as_it_was_given():
    law = NonlinearMPC(push(stage_cost=lambda x, u, w: cost(x - w, u), signal=np.zeros((11, 2))))
    with pytest.raises(InputError, match=r"^w: got shape \(10,\), expected \(11, 2\), a row for each .* or \(2,\)"):
        law.solve([1.0, 0.0], w=np.zeros(10))


def test_a_signal_of_no_columns_is_none():
    plan = NonlinearMPC(push(signal=np.zeros((11, 0)))).solve([1.0, 0.0])
    assert plan.cost == pytest.approx(NonlinearMPC(push()).solve([1.0, 0.0]).cost)


@pytest.mark.parametrize(
    ("stated", "argument"),
    [
        ({"path": lambda x: x[0], "path_prices": (-1, 1)}, "path_prices"),
        ({"path": lambda x: x[0], "path_prices": (0, 0)}, "path_prices"),
        ({"path": lambda x: x[0], "path_prices": (None, 1)}, "path_prices"),
        ({"path": lambda x: x[0], "path_prices": ([1, 2, 3], 1)}, "path_prices"),
        ({"path_prices": (1, 1)}, "path_prices"),
        ({"path": lambda x, t: ca.vertcat(x[0], t - 3)}, "path"),
    ],
)
def test_limits_that_cannot_be_meant_are_told(stated, argument):
    with pytest.raises(InputError) as told:
        push(**stated)
    assert told.value.argument == argument


@pytest.mark.parametrize(
    ("stated", "argument"),
    [
        ({"Q": np.eye(2)}, "Q"),
        ({"iterations": 1}, "iterations"),
        ({"horizon": 3}, "horizon"),
        ({"rate_limit": -1}, "rate_limit"),
        ({"starts": 0}, "starts"),
        ({"uses": ("reference",)}, "uses"),
        ({"step": push(stage_cost=lambda x, u, p: p * cost(x, u))}, "stage_cost"),
        ({"step": Phase(lambda u: u, 1, 1, duration=(1, 2)), "horizon": 5}, "duration"),
        ({"step": Phase(lambda u: u, 1, 1, stage_cost=cost)}, "horizon"),
        ({"step": push(samples=([1.0], [[0.0]]), sample_cost=lambda x, y: (x[0] - y) ** 2)}, "samples"),
        ({"step": Phase(lambda x: x, 1, 0, duration=3, discrete=True)}, "inputs"),
        ({"step": OptimalControlProblem(push())}, "step"),
    ],
)
def test_loops_that_cannot_be_meant_are_told(stated, argument):
    with pytest.raises(InputError) as told:
        NonlinearMPC(**({"step": push()} | stated))
    assert told.value.argument == argument


@pytest.mark.parametrize(
    ("phase", "signals", "argument"),
    [
        ({"stage_cost": lambda x, u, w: cost(x - w, u), "signal": np.zeros((11, 2))}, {"w": [[1, 2], [1]]}, "w"),
        ({"stage_cost": lambda x, u, t: cost(x, u) + t}, {}, "t"),
        ({"stage_cost": lambda x, u, u_prev: cost(x, u - u_prev)}, {}, "u_prev"),
        ({}, {"t": 0.0}, "t"),
        ({}, {"x_ref": [0, 0]}, "x_ref"),
        ({"stage_cost": lambda x, u, w: cost(x - w, u), "signal": np.zeros((11, 2))}, {"w": np.zeros((9, 2))}, "w"),
        ({"stage_cost": lambda x, u: x[0], "u_bounds": None}, {}, "stage_cost"),
    ],
)
def test_samples_that_cannot_be_meant_are_told(phase, signals, argument):
    with pytest.raises(InputError) as told:
        NonlinearMPC(push(**phase))([1.0, 0.0], **signals)
    assert told.value.argument == argument


@pytest.mark.parametrize(
    "asked",
    [
        lambda law: law.to_c("nowhere"), lambda law: law.sensitivity([1, 0]),
        lambda law: OffsetFreeNonlinearMPC(law, [[1, 0]]),
    ],
)  # fmt: skip
def test_what_needs_quadratic_costs_says_so(asked):
    with pytest.raises(InputError, match="got a Phase, expected quadratic costs"):
        asked(NonlinearMPC(push()))


@pytest.mark.parametrize("limit", [
    {"path": lambda x: x[0] ** 3, "path_bounds": (-np.inf, 0.125)}, {"boundary": lambda x: x[0] - 0.5},
])  # fmt: skip
def test_a_single_state_without_bounds_takes_limits_of_functions(limit):
    """An integrator on its way to 1, whose limits stop it at a half."""
    phase = Phase(lambda x, u: u, 1, 1, stage_cost=lambda x, u: (x - 1) ** 2 + 1e-3 * u**2, duration=1.0,
                  u_bounds=(-1, 1), **limit)  # fmt: skip
    law = NonlinearMPC(phase, horizon=10)
    assert float(law.solve([0.2]).states[-1, 0]) == pytest.approx(0.5, abs=1e-5)


def vehicle(scale, prices):
    """A unicycle in units, past a disc that moves, with a soft limit, a rate limit and a price of turns."""

    def step(x, u):
        return x + 0.2 * ca.vertcat(scale * u[0] * ca.cos(x[2]), scale * u[0] * ca.sin(x[2]), u[1])

    def path(x, t):
        disc = 0.25 - (x[0] / scale - 1.0 - 0.02 * t) ** 2 - (x[1] / scale - 0.6) ** 2
        return ca.vertcat(disc, x[1] / scale - 0.7)

    return NonlinearMPC(Phase(
        step, 3, 2, discrete=True, duration=12, u_bounds=([-1, -1.5], [1, 1.5]), path=path, path_prices=prices,
        stage_cost=lambda x, u, u_prev: ca.sumsqr(x[:2] / scale) + 0.1 * ca.sumsqr(u) + 0.2 * (u[1] - u_prev[1]) ** 2,
        terminal_cost=lambda x: 5 * ca.sumsqr(x[:2] / scale),
    ), rate_limit=[0.8, 1.0])  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("scale", [1.0, 1e3])
@pytest.mark.parametrize("prices", [([None, 3.0], [None, 0.0]), ([None, 0.2], [None, 4.0])], ids=["linear", "both"])
def test_plans_followed_by_programs_are_the_optima_of_the_solver(scale, prices):
    law = vehicle(scale, prices)
    x, u = np.array([2.2 * scale, 1.0 * scale, 3.0]), np.zeros(2)
    by = []
    for k in range(12):
        signals = {"u_prev": u, "t": float(k)}
        u = law(x, **signals)
        plan = law.last_plans[0]
        assert plan.status is Status.SOLVED
        by.append(plan.solver)
        other = law.solve(x, start=replace(plan, costates=None), **signals)
        assert plan.cost == pytest.approx(other.cost, rel=1e-6)
        assert plan.inputs == pytest.approx(other.inputs, abs=1e-3)
        x = plan.states[1] + 2e-3 * np.array([scale, scale, 1.0])
    assert by.count("SQP") >= 9


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e-4])
def test_a_state_thrown_beyond_a_hard_limit_comes_back_as_fast_as_it_can_by_programs(unit):
    phase = Phase(
        lambda x, u: x + 0.1 * u, 1, 1, discrete=True, duration=12, u_bounds=(-unit, unit),
        stage_cost=lambda x, u: (x / unit - 2) ** 2 + 0.1 * (u / unit) ** 2, path=lambda x: x - unit,
    )  # fmt: skip
    law = NonlinearMPC(phase)
    law(np.array([0.5 * unit]))
    x, found = 1.35 * unit, []
    for _ in range(5):
        u = law(np.array([x]))[0]
        plan = law.last_plans[0]
        found.append((plan.status.name, plan.solver))
        expected = max(x - 0.1 * unit, unit)
        x += 0.1 * u
        assert x == pytest.approx(expected, rel=1e-6)
    assert [status for status, _ in found] == ["SOFTENED"] * 3 + ["SOLVED"] * 2
    assert [solver for _, solver in found[1:]] == ["SQP"] * 4


@pytest.mark.parametrize("northing", [1e5, 5.3e6])
def test_limits_are_kept_far_from_the_origin_of_the_coordinates(northing):
    # metres in a national grid: a disc of 1 m to pass by, then a lane of 0.5 m to each side
    c = np.array([northing / 10, northing])

    def towards(aim, **limits):
        return NonlinearMPC(Phase(
            dynamics=lambda x, u: x + 0.1 * u, states=2, inputs=2, discrete=True, duration=20, u_bounds=(-5, 5),
            stage_cost=lambda x, u: ca.sumsqr(x - c - ca.DM(aim)) + 0.1 * ca.sumsqr(u), **limits,
        ))  # fmt: skip

    passing = towards([3, 0.1], path=lambda x: 1 - ca.sumsqr(x - c)).solve(c - np.array([3, -0.1]))
    assert passing.status is Status.SOLVED
    assert np.linalg.norm(passing.states[1:] - c, axis=1).min() >= 1 - 1e-6
    assert passing.cost == pytest.approx(195.48922, rel=1e-3)  # as at the origin
    lane = ([-np.inf, c[1] - 0.5], [np.inf, c[1] + 0.5])
    inside = towards([3, 1], x_bounds=lane).solve(c)
    assert inside.status is Status.SOLVED
    assert np.abs(inside.states[:, 1] - c[1]).max() <= 0.5 + 1e-6
