"""What happens between the points of a mesh is part of the status: limits, dynamics and cost."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from classical_problems import CLASSICAL
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq
from trajectory_verdicts import coarse, field, judged_field, judged_mesh

from mpc.optimal_control import (
    HermiteSimpson,
    MultipleShooting,
    OptimalControlProblem,
    OptimalControlStatus,
    Phase,
    Radau,
    Trapezoidal,
    build,
    refine,
    solve,
)

RADIUS = 0.3
CVODES = pytest.param(MultipleShooting(integrator="cvodes"), marks=pytest.mark.check)


def past_a_disc(unit=1.0, origin=0.0):
    """From one side of a disc to the other with the least energy; the straight guess goes through its centre."""
    start, end = (unit * np.array([origin + far, 0.0]) for far in (0, 2))
    return Phase(
        lambda u: u, 2, 2, start=start, end=end, stage_cost=lambda u: ca.sumsqr(u / unit),
        path=lambda x: (unit * RADIUS) ** 2 - (x[0] - unit * (1 + origin)) ** 2 - x[1] ** 2,
    )  # fmt: skip


def oscillator(fast=50.0):
    """From rest to x = 1 at rest in 1 s with the least ∫u²."""
    return Phase(
        lambda x, u: ca.vertcat(x[1], -(fast**2) * x[0] + u), 2, 1, start=[0, 0], end=[1, 0], stage_cost=lambda u: u**2
    )


def least_energy(fast):
    """Of the oscillator, by its controllability Gramian."""
    A = np.array([[0, 1], [-(fast**2), 0]])
    grown = solve_ivp(lambda t, _: (expm(A * t)[:, 1:] @ expm(A * t)[:, 1:].T).ravel(), [0, 1], np.zeros(4), rtol=1e-9)
    return np.linalg.inv(grown.y[:, -1].reshape(2, 2))[0, 0]


@pytest.mark.long
@pytest.mark.parametrize(("unit", "origin"), [(1.0, 0.0), (1e3, 3.0)])
def test_a_trajectory_through_an_obstacle_is_not_solved_and_refinement_goes_round_it(unit, origin):
    through = solve(build(past_a_disc(unit, origin), intervals=10))
    assert through.status is OptimalControlStatus.LIMITS_PASSED
    assert not through.solved
    assert through.solved_on_mesh
    assert "path 1 is exceeded" in through.advice
    assert "guess that goes round it" in through.advice
    around = refine(past_a_disc(unit, origin))
    assert around.solved
    length = 2 * np.sqrt(1 - RADIUS**2) + RADIUS * (np.pi - 2 * np.arccos(RADIUS))  # tangents and the arc between
    assert around.cost == pytest.approx(length**2, rel=1e-4)
    x = around.x(np.linspace(0, 1, 5001)) / unit - [1 + origin, 0]
    assert np.linalg.norm(x, axis=1).min() > RADIUS * (1 - 1e-3)


def test_a_bound_of_a_state_that_is_passed_between_the_points_is_told():
    slow = Phase(
        lambda x, u: ca.vertcat(x[1], u), 2, 1, start=[0, 0], end=[1, 0], stage_cost=lambda u: u**2,
        x_bounds=([-9, -9], [9, 1.1]), state_names=["place", "speed"],
    )  # fmt: skip
    found = solve(build(slow, Radau(3), 7))
    assert found.status is OptimalControlStatus.LIMITS_PASSED
    assert "speed is exceeded by" in found.advice
    highest = found.x(np.linspace(0, 1, 7001))[:, 1].max()
    assert found.path_excess[0].value[-1] == pytest.approx(highest - 1.1, rel=1e-2)
    assert refine(slow).solved


@pytest.mark.parametrize("scheme", [MultipleShooting(40), CVODES])
def test_a_swing_within_the_intervals_of_shooting_is_seen(scheme):
    # a load on a base, of period 1 where intervals take about as long
    along = Phase(
        lambda x, u: ca.vertcat(x[1], -39.478 * (x[0] - x[2]), u), 3, 1, start=[-1, 0, 0], end=[None, None, 1],
        duration=5.02, u_bounds=(-1, 1), x_bounds=([-9, -99, -9], [0.6, 99, 9]), stage_cost=lambda u: u**2,
    )  # fmt: skip
    found = solve(build(along, scheme, 5))
    assert found.status is OptimalControlStatus.LIMITS_PASSED
    apart, x = 0.0, found.phases[0].states[0]
    for k, (begin, end) in enumerate(zip(found.times[:-1], found.times[1:])):
        times, u = np.linspace(begin, end, 100), found.phases[0].inputs[k, 0]
        true = solve_ivp(lambda t, x, u=u: [x[1], -39.478 * (x[0] - x[2]), u], (begin, end), x, t_eval=times, rtol=1e-9)
        apart, x = max(apart, np.abs(found.x(times)[:, 0] - true.y[0]).max()), true.y[:, -1]
    assert apart < 1e-2


@pytest.mark.quick(1)
@pytest.mark.parametrize("row", [531, 537, 544])
def test_a_limit_that_dips_at_one_row_of_a_table_is_kept_there(row):
    table = np.ones((1001, 1))
    table[row] = -0.2
    found = refine(Phase(
        lambda x, u: ca.vertcat(x[1], u), 2, 1, start=[0, 0], end=[0, 0], signal=table, path=lambda x, w: x[0] - w[0],
        stage_cost=lambda x, u: 1e-3 * u**2 - 10 * x[0],
    ))  # fmt: skip
    assert found.solved
    over = (found.x(np.linspace(0, 1, 1001)) - table)[:, 0].max()
    assert over <= 2e-5
    assert found.cost > -1.5


def test_a_table_hides_no_obstacle_between_its_rows():
    centre = (165 / 32 + 0.48 / 16) / 10  # beside a place that is a row of 65, too
    for signal in (None, np.ones((65, 1))):
        through = solve(build(Phase(
            lambda u: u, 2, 2, start=[0, 0], end=[1, 0], stage_cost=lambda u: ca.sumsqr(u), signal=signal,
            path=lambda x: 1e3 * (1e-6 - (x[0] - centre) ** 2 - x[1] ** 2),
        ), intervals=10))  # fmt: skip
        assert through.status is OptimalControlStatus.LIMITS_PASSED


@pytest.mark.parametrize("scheme", [MultipleShooting(4), CVODES])
def test_a_spike_between_the_steps_of_shooting_is_met_or_said(scheme):
    table = np.zeros((1001, 1))
    table[333] = 50.0
    phase = Phase(
        lambda x, u, w: -x + u + w, 1, 1, start=[0.0], duration=10.0, stage_cost=lambda x, u: x**2 + u**2, signal=table,
        u_bounds=(-5, 5), x_bounds=(-5, 0.2),
    )  # fmt: skip
    assert solve(build(phase, scheme, 10)).status is not OptimalControlStatus.SOLVED
    if scheme.integrator == "rk4":
        found = refine(phase, scheme)
        assert found.solved
        assert found.cost == pytest.approx(0.2265, rel=0.01)


@pytest.mark.parametrize("steps", [1, 2, 4])
def test_a_doublet_of_a_table_within_a_step_is_seen(steps):
    table = np.zeros((41, 1))
    table[12:14, 0] = 40, -40  # which leaves the ends of the interval as they are
    found = solve(build(Phase(
        lambda u, w: w + u, 1, 1, stage_cost=lambda u: u**2, start=[0.5], end=[0.6], duration=4.0, x_bounds=(-1, 1),
        u_bounds=(-5, 5), signal=table,
    ), MultipleShooting(steps), 4))  # fmt: skip
    assert found.status is OptimalControlStatus.LIMITS_PASSED
    assert found.path_excess[0].value[0] > 1.5


def test_a_state_that_rests_makes_no_mesh_coarse():
    straight_up = Phase(
        lambda x, u: ca.vertcat(
            x[3:], -(u[0] + u[1]) * ca.sin(x[2]), (u[0] + u[1]) * ca.cos(x[2]) - 9.81, 10 * (u[0] - u[1])
        ), 6, 2, start=[0] * 6, end=[0, 1, 0, 0, 0, 0], u_bounds=(0, 15), stage_cost=lambda u: ca.sumsqr(u),
    )  # fmt: skip
    across = Phase(
        lambda u: ca.vertcat(ca.cos(u) + 0.5, ca.sin(u)), 2, 1, start=[0, 0], end=[0, 5], duration=(0.1, 50),
        terminal_cost=lambda t: t,
    )  # fmt: skip
    for phase, cost in ((straight_up, 54.11805), (across, 5 / np.sqrt(0.75))):
        found = solve(phase)
        assert found.solved
        assert found.cost == pytest.approx(cost, rel=1e-7)
        assert found.mesh_error < 1e-6


@pytest.mark.long
def test_inputs_that_jump_under_a_limit_of_their_own_are_refined():
    # the least time with a round limit of the thrust, whose direction turns fast
    found = refine(Phase(
        lambda x, u: ca.vertcat(x[2], x[3], u[0] - 0.2 * x[2], u[1] - 0.2 * x[3]), 4, 2, start=[0, 0, 1, 0],
        end=[0, 3, 0, 0], duration=(0.1, 50), terminal_cost=lambda t: t, path=lambda u: ca.sumsqr(u) - 1,
    ))  # fmt: skip
    assert found.solved, found.advice


@pytest.mark.parametrize("scheme", [Radau(3), HermiteSimpson(), Trapezoidal()], ids=lambda scheme: scheme.name)
def test_a_mesh_too_coarse_for_fast_dynamics_is_not_solved_and_says_what_the_cost_misses(scheme):
    true = least_energy(50.0)
    for intervals in (5, 20):
        found = solve(build(oscillator(), scheme, intervals))
        assert found.status is OptimalControlStatus.COARSE
        assert not found.solved
        assert "The cost may be off" in found.advice or "dynamics are missed" in found.advice
    fine = solve(build(oscillator(), scheme, 100))
    said = fine.cost_error / abs(fine.cost - true)
    assert 0.3 < said < 3
    assert fine.solved == (fine.cost_error <= 0.003 * fine.cost)
    assert "±" in repr(fine)


@pytest.mark.parametrize(("name", "true"), [("Bryson-Denham", 4.0), ("Rayleigh with a mixed limit", 44.8044447)])
def test_limits_passed_between_points_of_high_degree_count_in_the_error_of_the_cost(name, true):
    for intervals in (20, 40):
        found = solve(build(CLASSICAL[name].phase, Radau(5), intervals))
        assert 0.1 < found.cost_error / abs(found.cost - true) < 10


@pytest.mark.parametrize("row", [1, 333, 998])
def test_a_spike_of_a_signal_between_the_points_is_met(row):
    # x' = −x + u + w with a triangle of area 0.5; by three points in each of ten intervals w is 0
    table = np.zeros((1001, 1))
    table[row] = 50.0
    found = refine(Phase(
        lambda x, u, w: -x + u + w, 1, 1, start=[0.0], duration=10.0, stage_cost=lambda x, u: x**2 + u**2, signal=table,
        u_bounds=(-5, 5),
    ))  # fmt: skip
    assert found.solved, found.advice
    fine = solve(build(found.program.problem, Radau(3), intervals=2000))
    assert found.cost == pytest.approx(fine.cost, rel=1e-4)
    assert found.cost > 0.004


def test_a_condition_on_times_alone_is_one_where_they_are_free():
    # a unit way in two units of time takes ∫ u² = 12 / 2³
    found = refine(Phase(
        lambda x, u: ca.vertcat(x[1], u), 2, 1, start=[0, 0], end=[1, 0], start_time=100.0, duration=(0.1, 9),
        stage_cost=lambda u: u**2, boundary=lambda t0, t: t - t0 - 2,
    ))  # fmt: skip
    assert found.solved, found.advice
    assert found.duration == pytest.approx(2.0, rel=1e-8)
    assert found.cost == pytest.approx(1.5, rel=1e-8)


def test_a_cost_off_by_its_quadrature_alone_is_said():
    # the dynamics are met exactly; what the cost charges oscillates between the points
    swept = Phase(lambda u: u, 1, 1, start=[0.0], stage_cost=lambda x, u, t: 100 * (x - ca.sin(40 * t)) ** 2 + u**2)
    assert solve(build(swept, intervals=3)).status is OptimalControlStatus.COARSE
    assert solve(build(swept, intervals=60)).solved


@pytest.mark.long
def test_a_sample_of_the_fields_and_meshes_of_the_benchmark_is_judged_truly():
    given = field(0)
    assert judged_field(given, refine(given.phase())) == ("SOLVED", "")
    assert not any(judged_mesh(*coarse(seed)[1:])[1] for seed in (3, 8, 9))


def test_a_path_limit_that_is_stated_twice_is_one_limit():
    def slope(path):
        mass = Phase(
            lambda x, u: ca.vertcat(x[1], u), 2, 1, start=[0, 0], end=[1, 0], stage_cost=lambda u: u**2, path=path
        )
        found = solve(build(OptimalControlProblem(mass, p_bounds=(1, 1)), intervals=20), tolerance=1e-10)
        return found.sensitivity()

    once = slope(lambda x, p: x[1] - 1.2 * p)
    twice = slope(lambda x, p: ca.vertcat(x[1] - 1.2 * p, 1e3 * (x[1] - 1.2 * p)))
    assert twice.status is once.status
    assert twice.cost_by_parameters == pytest.approx(once.cost_by_parameters, rel=1e-5)
    assert twice.cost_curvature == pytest.approx(once.cost_curvature, rel=1e-5)


def test_a_number_is_the_guess_of_a_single_parameter():
    shared = Phase(lambda u, p: p * u, 1, 1, start=[0], end=[1], stage_cost=lambda u: u**2)
    assert OptimalControlProblem(shared, p_bounds=(0.01, 2), p_guess=0.08).p_guess == pytest.approx([0.08])


def test_a_program_with_too_many_equations_prints_nothing(capfd):
    mass = Phase(lambda x, u: ca.vertcat(x[1], u), 2, 1, start=[0, 0], end=[1, 0], stage_cost=lambda u: u**2)
    assert "more intervals" in solve(build(mass, Radau(1), 1)).advice
    assert capfd.readouterr() == ("", "")


NARROW = {  # inside of it, and how far it is passed at its centre
    "a disc of 3 mm": (lambda x: 3e-3 - ca.sqrt((x[0] - 0.8137) ** 2 + x[1] ** 2), 3e-3),
    "a disc of 1 mm, squared": (lambda x: 1e-6 - (x[0] - 0.8137) ** 2 - x[1] ** 2, 1e-6),
    "the same in other units": (lambda x: 1e6 * (1e-6 - (x[0] - 1.2345) ** 2 - (x[1] - 4e-4) ** 2), 1.0),
    "a thin wall": (lambda x: 1 - ((x[0] - 1) / 3e-4) ** 2 - x[1] ** 2, 1.0),
}


@pytest.mark.quick(11)
@pytest.mark.parametrize("intervals", [10, 20, 37])
@pytest.mark.parametrize(("inside", "deepest"), NARROW.values(), ids=NARROW)
def test_a_trajectory_straight_through_a_narrow_obstacle_is_not_solved(inside, deepest, intervals):
    phase = Phase(lambda u: u, 2, 2, start=[0, 0], end=[2, 0], path=inside, stage_cost=lambda u: ca.sumsqr(u))
    found = solve(build(phase, intervals=intervals))
    x = ca.SX.sym("x", 2)
    along = ca.Function("g", [x], [inside(x)]).map(200_001)(found.x(np.linspace(0, 1, 200_001)).T)
    depth = float(ca.mmax(along))
    assert (found.status is OptimalControlStatus.LIMITS_PASSED) is (depth > 0.02 * deepest)
    if depth > 0.02 * deepest:
        assert max(excess.value.max() for excess in found.path_excess) == pytest.approx(depth, rel=0.02)


def test_a_limit_that_is_no_number_between_the_points_is_passed_there():
    phase = Phase(
        lambda u: u, 1, 1, start=[0], end=[1], stage_cost=lambda u: u**2,
        path=lambda x: -ca.sqrt((x[0] - 0.522) ** 2 - 1.6e-7),
    )  # fmt: skip
    found = solve(build(phase, intervals=10))
    assert found.status is OptimalControlStatus.LIMITS_PASSED
    assert found.path_excess[0].value[0] == np.inf
    assert found.path_excess[0].time[0] == pytest.approx(0.522, abs=1e-3)


@pytest.mark.long
@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_the_depth_in_a_small_disc_counts_in_its_own_radius(unit):
    radius, centre = 0.004, np.array([1, 0.001])
    phase = Phase(
        lambda u: u, 2, 2, start=[0, 0], end=[2 * unit, 0], stage_cost=lambda u: ca.sumsqr(u / unit),
        path=lambda x: radius**2 - ca.sumsqr(x / unit - ca.DM(centre)),
    )  # fmt: skip
    found = solve(build(phase, meshes=[np.r_[0, 0.25, np.linspace(0.497, 0.503, 49), 0.75, 1]]))
    away = np.linalg.norm(found.x(np.linspace(0.49, 0.51, 100_001)) / unit - centre, axis=1)
    depth = 1 - away.min() / radius
    assert found.status is (OptimalControlStatus.LIMITS_PASSED if depth > 1e-3 else OptimalControlStatus.SOLVED)


def test_a_limit_that_neither_state_nor_input_moves_is_no_obstacle():
    phase = Phase(
        lambda u: u, 1, 1, start=[0], end=[1], stage_cost=lambda u: u**2,
        path=lambda x, t: ca.sin(3 * t) - 1 + 5e-8 + ca.floor(0.5 + 0.1 * x),
    )  # fmt: skip
    found = solve(build(phase, intervals=60))
    assert found.status is OptimalControlStatus.SOLVED
    assert 0 < found.excess < 1e-5


@pytest.mark.parametrize("scheme", [Radau(3), HermiteSimpson()], ids=lambda scheme: scheme.name)
def test_the_cost_is_off_by_no_more_than_thrice_what_is_told_where_inputs_jump(scheme):
    # as much thrust as there is, none, and as much against it: t (4 − t) = 1 for the time t of each, and the cost is 2t
    phase = Phase(
        lambda x, u: ca.vertcat(x[1], u[0] - u[1]), 2, 2, start=[0, 0], end=[1, 0], duration=4.0, u_bounds=(0, 1),
        stage_cost=lambda u: ca.sum1(u),
    )  # fmt: skip
    for intervals in range(10, 41, 3):
        found = solve(build(phase, scheme, intervals))
        assert found.solved_on_mesh
        assert found.cost - 2 * (2 - np.sqrt(3)) <= 3 * found.cost_error, intervals


def test_what_inputs_at_bounds_would_save_is_no_optimum():
    # at rest the cost cannot be made less by small inputs, by the largest it is -12
    phase = Phase(
        lambda u: u, 1, 1, start=[0], duration=1.0, u_bounds=(-2, 2), stage_cost=lambda x, u: u**2 - u**4 + x**2
    )
    found = refine(phase)
    assert not found.solved
    assert found.cost_error == pytest.approx(12, rel=1e-3)
    assert "By the Hamiltonian inputs at bounds would save 12: try another guess" in found.advice
    assert len(found.times) < 100
    assert refine(replace(phase, guess=([0, 1], np.zeros((2, 1)), np.full((2, 1), 1.9)))).cost < -10


def test_a_bound_that_inputs_leave_between_the_points_is_found():
    # what is left of the first flows into the second as long as it may
    flow = Phase(
        lambda x, u: ca.vertcat(-u * x[0], u * x[0] - (1 - u) * x[1]), 2, 1, start=[1, 0], duration=4.0,
        u_bounds=(0, 1), terminal_cost=lambda x: -x[1],
    )  # fmt: skip
    found = refine(flow)
    assert found.solved, found.advice
    assert found.cost == pytest.approx(np.exp(-4) - 1, rel=1e-6)


def test_limits_at_a_price_hide_no_other_one():
    # dearer than what u = 1 brings is more than that
    phase = Phase(
        lambda x, u: -x + u, 1, 1, start=[0], duration=3.0, u_bounds=(0, 2), path=lambda x, u: ca.vertcat(5 - x, u - 1),
        path_prices=([1, 10], [0, 0]),
    )  # fmt: skip
    found = solve(build(phase, intervals=30))
    assert found.solved, found.advice
    assert found.cost == pytest.approx(13 - np.exp(-3), rel=1e-6)
    assert found.cost_error < 1e-6


def test_what_the_solver_leaves_at_bounds_saves_nothing():
    phase = Phase(
        lambda x, u: ca.vertcat(x[1], u - ca.sin(x[0])), 2, 1, start=[1, 0], end=[0, 0], duration=4.0, u_bounds=(-1, 1)
    )
    found = solve(build(phase, intervals=400))
    assert found.solved, found.advice
    assert found.cost_error < 1e-8


def test_a_price_of_states_and_inputs_together_is_integrated_along_the_plan():
    """26.863422 by 400 to 2500 intervals; SOLVED at 26.9365, 4.9e-6 said, where straight lines of inputs counted."""
    phase = Phase(
        lambda x, u: ca.vertcat(x[1], -x[0] + u), 2, 1, start=[2, 0], end=[0, 0], duration=3.0, u_bounds=(-3, 3),
        stage_cost=lambda x, u: x[0] ** 2 + 0.1 * u**2, path=lambda x, u: u - 0.3 * x[0], path_bounds=(-0.7, 0.7),
        path_prices=(100.0, 0.0),
    )  # fmt: skip
    found = refine(phase, of="cost", tolerance=1e-4)
    assert found.solved, found.advice
    assert found.cost == pytest.approx(26.863422, rel=1e-4)


def dear_to_pass(dearness):
    """From 0 to 2 in 1 s with the least ∫u² and dearness · (x − 1)² beyond 1, stated by two limits, and its cost."""
    root = np.sqrt(dearness)
    cut = brentq(lambda t: 1 / t - root / np.sinh(root * (1 - t)), 0.2, 0.9999)  # when 1 is passed
    return Phase(
        lambda u: u, 1, 1, start=[0], end=[2], duration=1.0, stage_cost=lambda u: u**2,
        path=lambda x: ca.vertcat(x, -2 * x), path_bounds=([-np.inf, -2], [1, np.inf]),
        path_prices=([0, 0], [dearness / 2, dearness / 8]),
    ), 1 / cut + root / np.tanh(root * (1 - cut))  # fmt: skip


@pytest.mark.parametrize(
    "scheme", [Radau(3), HermiteSimpson(), Trapezoidal(), MultipleShooting()], ids=lambda s: s.name
)
def test_prices_of_limits_between_the_points_count_in_the_error_of_the_cost(scheme):
    for dearness in (500, 50_000):
        phase, true = dear_to_pass(dearness)
        found = solve(build(phase, scheme, 10))
        assert found.status is OptimalControlStatus.COARSE
        assert 0.1 < found.cost_error / (found.cost - true) < 10


@pytest.mark.parametrize("dearness", [50, 5000])
def test_refined_costs_are_exact_where_limits_have_a_price(dearness):
    phase, true = dear_to_pass(dearness)
    found = refine(phase, of="cost", tolerance=1e-6)
    assert found.solved, found.advice
    assert found.cost == pytest.approx(true, rel=1e-6)


def test_linear_prices_of_limits_count_in_the_error_of_the_cost():
    # ẍ = a/2 beyond 1, which is passed as fast as it was come to
    price = 200.0
    cut = brentq(lambda t: (1 - t) / t + price * (1 - t) ** 2 / 4 - 1, 0.5, 1)
    speed, left = 1 / cut, 1 - cut
    true = speed + ((speed + price * left / 2) ** 3 - speed**3) / (1.5 * price)
    true += price * (speed * left**2 / 2 + price * left**3 / 12)
    phase = replace(dear_to_pass(1)[0], path=lambda x: x, path_bounds=(-np.inf, 1), path_prices=(price, 0))
    found = solve(build(phase, HermiteSimpson(), 7))
    assert 0.1 < found.cost_error / abs(found.cost - true) < 10
    assert refine(phase, of="cost", tolerance=1e-6).cost == pytest.approx(true, rel=1e-6)
