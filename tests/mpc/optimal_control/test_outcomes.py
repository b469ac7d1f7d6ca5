"""Every way a solve may end has its own status, which is confirmed a second way and says what to do."""

from dataclasses import replace
from itertools import count, pairwise

import casadi as ca
import numpy as np
import pytest

from mpc import InputError
from mpc.optimal_control import (
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

INF = float("inf")


def block(k=1.0, **change):
    """A mass brought over a length k, from rest to rest."""
    given = {
        "dynamics": lambda x, u: ca.vertcat(x[1], u), "states": 2, "inputs": 1, "start": [0, 0], "end": [k, 0],
        "stage_cost": lambda u: u**2,
    }  # fmt: skip
    return Phase(**(given | change))


@pytest.mark.parametrize("k", [1e-3, 1.0, 1e6])
def test_what_contradicts_is_named_in_any_unit(k):
    fast = solve(block(k, u_bounds=(-k, k)))  # k in 1 s needs 4 k/s² at least
    assert fast.status is OptimalControlStatus.INFEASIBLE
    assert {f"u1 ≤ {k:.6g}", f"u1 ≥ {-k:.6g}", f"end of x1 = {k:.6g}"} <= set(fast.conflicts)
    assert solve(block(k, u_bounds=(-4.5 * k, 4.5 * k))).solved  # and no more than that


@pytest.mark.long
def test_conflicts_of_every_kind_are_named():
    mixed = solve(block(path=lambda x: 2 - x[0], x_bounds=([-9, -9], [1.5, 9]), start=None, end=None))
    assert mixed.conflicts[-1] == "x1 ≤ 1.5"
    assert mixed.conflicts[0].startswith("path 1 at t = ")
    ends = solve(block(boundary=lambda x0, x: x[0] - 2))
    assert ends.conflicts == ("boundary 1 at t = 1, by 1", "end of x1 = 1")
    shared = solve(OptimalControlProblem(block(), p_bounds=(0, 1), p_constraints=lambda p: 2 - p[0]))
    assert shared.conflicts == ("p_constraints 1, by 1", "p1 ≤ 1")
    joined = solve(OptimalControlProblem([block(), block(start=[2, 0], end=[3, 0])]))
    assert joined.conflicts == (
        "link of x1 of phase 2 at t = 1, by 1", "end of x1 = 1 of phase 1", "start of x1 = 2 of phase 2",
    )  # fmt: skip
    assert all(one.status is OptimalControlStatus.INFEASIBLE for one in (mixed, ends, shared, joined))


@pytest.mark.long
def test_a_limit_of_many_scenarios_is_named_once():
    weak = block(u_bounds=(-1, 1), path=lambda x: x[1] - 1.4, path_names=["speed limit"])
    many = solve(OptimalControlProblem([replace(weak, end=[1 + 0.1 * k, 0]) for k in range(12)], linked=False))
    assert many.status is OptimalControlStatus.INFEASIBLE
    assert many.conflicts.count("u1 ≤ 1") == many.conflicts.count("u1 ≥ -1") == 1
    assert len(many.conflicts) <= 20
    # one after the other, each phase has limits of its own
    both = solve(OptimalControlProblem([weak, replace(weak, start=None, end=[2, 0])]))
    assert {"u1 ≤ 1 of phase 1", "u1 ≤ 1 of phase 2"} <= set(both.conflicts)


def test_a_problem_that_is_feasible_is_not_called_infeasible_from_a_bad_guess():
    # through a wall whose only gap is where the guess has no reason to go, in a unit of its own
    k = 1e3
    wall = Phase(
        lambda u: u, 2, 2, start=[-k, 0], end=[k, 0], stage_cost=lambda u: ca.sumsqr(u / k),
        path=lambda x: 1 - (x[0] / k) ** 2 * 4 - (x[1] / k) ** 2 * 4 + 0.1 * x[1] / k,
    )  # fmt: skip
    plain, led = (
        solve(build(replace(wall, guess=guess), Radau(3), 30))
        for guess in (None, ([0, 0.5, 1], [[-k, 0], [0, -k], [k, 0]], [[2 * k, 0]] * 3))
    )
    assert plain.solved_on_mesh
    assert led.solved_on_mesh
    assert plain.cost == pytest.approx(led.cost, rel=1e-5)


@pytest.mark.parametrize(("far", "guess", "longest"), [(6.0, None, 50), (10.0, 1.0, 50), (6.0, None, np.inf)])
def test_a_duration_that_is_guessed_too_short_makes_nothing_infeasible(far, guess, longest):
    # to rest in the least time, as long as half a swing for every two of the way
    found = solve(build(Phase(
        lambda x, u: ca.vertcat(x[1], u - x[0]), 2, 1, start=[far, 0], end=[0, 0], u_bounds=(-1, 1),
        duration=(0.1, longest), duration_guess=guess, terminal_cost=lambda t: t,
    ), intervals=40))  # fmt: skip
    assert found.solved_on_mesh
    assert found.cost == pytest.approx(far / 2 * np.pi, rel=0.02)


def test_a_coarse_mesh_over_a_longer_time_is_refined():
    swing = Phase(
        lambda x, u: ca.vertcat(x[1], u - ca.sin(x[0])), 2, 1, stage_cost=lambda u: 1 + u**2, start=[0, 0],
        end=[np.pi, 0], duration=(0.1, 200), duration_guess=1.0, u_bounds=(-0.3, 0.3),
    )  # fmt: skip
    found = refine(swing)
    assert found.solved
    assert found.cost == pytest.approx(13.6813, rel=1e-4)


def test_long_intervals_make_nothing_feasible():
    # a vehicle is asked for twenty times its top speed, and steps of 20 s take it there
    found = solve(build(Phase(
        lambda x, u: ca.vertcat(x[1], 0.1 * u - x[1]), 2, 1, start=[0, 0], end=[5, 2], u_bounds=(-1, 1),
        duration=(0.1, np.inf), terminal_cost=lambda t: t, x_bounds=([-1, 0], [100, 1e3]),
    ), MultipleShooting(4), 15))  # fmt: skip
    assert found.status is OptimalControlStatus.INFEASIBLE


@pytest.mark.parametrize(
    "cost", [lambda x: -x[0], lambda u: -(u**2), lambda u: -ca.exp(u)], ids=["linear", "concave", "exponential"]
)
def test_a_cost_without_end_is_called_unbounded(cost):
    found = solve(block(end=None, stage_cost=cost))
    assert found.status is OptimalControlStatus.UNBOUNDED
    assert "Bound" in found.advice


@pytest.mark.parametrize(("far", "found"), [(3e11, "SOLVED"), (3e12, "UNBOUNDED")])
def test_an_optimum_that_is_very_far_away_is_none(far, found):
    assert solve(block(end=None, stage_cost=lambda u: (u / far - 1) ** 2)).status is OptimalControlStatus[found]


SLOW = {  # costs of (x, size of states) whose slope vanishes far out, and whether they fall without end
    "logarithm": (lambda x: -ca.log(1 + x**2), True),
    "logarithm of a power, which overflows": (lambda x: -ca.log(1 + x**8), True),
    "logarithm of a stock": (lambda x: -ca.log(x), True),
    "logarithm, until a square weighs more": (lambda x: -ca.log(1 + x**2) + 1e-30 * x**2, False),
    "logarithm, until a size weighs more": (lambda x: -ca.log(1 + x**2) + 1e-20 * ca.sqrt(1 + x**2), False),
    "share": (lambda x: -(x**2) / (1 + x**2), False),
    "inverse": (lambda x: 1 / x, False),
    "square about a far place": (lambda x: (x / 1e10 - 1) ** 2, False),
}


@pytest.mark.parametrize(("unit", "price"), [(1, 1), (1e9, 1e-9), (1e-9, 1e9), (1, 1e9)])
@pytest.mark.parametrize("name", SLOW)
def test_a_cost_that_falls_slowly_without_end_is_told_from_one_with_an_end(name, unit, price):
    cost, endless = SLOW[name]
    saved = Phase(lambda x, u: x + u, 1, 1, terminal_cost=lambda x: price * cost(x / unit), start=[unit],
                  discrete=True, duration=4)  # fmt: skip
    found = OptimalControlStatus.UNBOUNDED if endless else OptimalControlStatus.SOLVED
    assert solve(saved, max_iterations=300).status is found


@pytest.mark.parametrize("find", [solve, refine])
def test_a_sum_of_logarithms_is_unbounded_beside_a_term_that_nothing_moves(find):
    # the second state of the sum is given by the start, and its slope hides those of the states far out
    mass = Phase(lambda x, u: x + 0.1 * ca.vertcat(x[1], u), 2, 1, stage_cost=lambda x: -ca.log(1 + x[0] ** 2),
                 start=[1, 0], discrete=True, duration=8)  # fmt: skip
    assert find(mass).status is OptimalControlStatus.UNBOUNDED


@pytest.mark.parametrize(("gain", "found"), [(3e11, "STOPPED"), (3e12, "UNBOUNDED")])
def test_a_cost_that_has_fallen_very_far_is_without_end(gain, found):
    falling = block(end=None, u_bounds=(-1, 1), stage_cost=lambda u: -gain * u)
    assert solve(falling, max_iterations=3).status is OptimalControlStatus[found]


def test_a_stationary_guess_that_is_no_minimum_is_left():
    # two wells, and the guess on the ridge between them
    wells = block(end=None, stage_cost=lambda u: 0.01 * u**2, terminal_cost=lambda x: (x[0] ** 2 - 1) ** 2)
    found = solve(wells)
    assert found.solved
    assert found.cost == pytest.approx(0.03 - 0.015**2, rel=1e-6)  # 0.03 x² + (x² − 1)², least at x² = 1 − 0.015


def test_functions_that_are_not_finite_where_the_solver_goes_say_so():
    found = solve(block(dynamics=lambda x, u: ca.vertcat(x[1], u - ca.fabs(x[1]) ** 1.5)))
    assert found.status is OptimalControlStatus.UNDEFINED
    assert found.conflicts == ("second derivatives",)


def test_a_stopped_solve_returns_the_best_feasible_iterate():
    tight = build(block(path=lambda x: x[1] - 1.2), Radau(3), 20)
    whole = solve(tight)
    costs = []
    for most in range(3, whole.iterations):
        stopped = solve(tight, max_iterations=most)
        if stopped.status is OptimalControlStatus.STOPPED and stopped.residuals.primal <= 1e-6:
            costs.append(stopped.cost)
    assert len(costs) > 1
    assert all(after <= before * (1 + 1e-9) for before, after in pairwise(costs))
    assert whole.cost <= costs[-1] * (1 + 1e-6)


@pytest.mark.parametrize("unit", [1e-9, 1e-7, 1.0])
def test_an_iterate_at_which_the_clock_stopped_the_solver_is_no_optimum_in_any_unit(unit, monkeypatch):
    """It was SOLVED at 1.4 times the optimum, where slopes are small beside a guess's size."""
    phase = Phase(lambda x, u: ca.vertcat(x[1], u - 9.81 * ca.sin(x[0])), 2, 1, start=[0, 0], end=[np.pi, 0],
                  duration=2.0, u_bounds=(-9, 9), stage_cost=lambda u: unit * u**2)  # fmt: skip
    best = solve(build(phase, Radau(3), 40)).cost
    clock = count()
    monkeypatch.setattr("time.perf_counter", lambda: float(next(clock)))  # by reads of the clock
    for limit in range(2, 60, 3):
        found = solve(build(phase, Radau(3), 40), time_limit=limit)
        assert found.status.name != "SOLVED" or found.cost == pytest.approx(best, rel=1e-6)


def test_a_time_limit_stops_a_solve():
    late = solve(build(block(path=lambda x: x[1] - 1.2), Radau(3), 400), time_limit=1e-3)
    assert late.status is OptimalControlStatus.STOPPED


@pytest.mark.parametrize(("barrier", "status"), [(1e-4, "SOLVED"), (1e-3, "INACCURATE")])
def test_an_optimum_is_one_up_to_what_its_conditions_miss(barrier, status):
    found = solve(block(u_bounds=(-4.5, 4.5)), options={"mu_target": barrier})  # where Ipopt is told to stop
    assert found.residuals.worst == pytest.approx(0.032 * barrier, rel=0.1)  # 3e-6, 3e-5
    assert found.status is OptimalControlStatus[status]


def test_dynamics_that_may_jump_are_told():
    rough = solve(block(dynamics=lambda x, u: ca.vertcat(x[1], u - ca.sign(x[1] - 0.5))))
    assert "may jump (sign)" in rough.advice
    pushed = solve(block(dynamics=lambda x, u: ca.vertcat(x[1], u - ca.if_else(x[0] > 0.5, 1.0, 0.0))))
    assert "if_else" in pushed.advice
    assert not solve(block()).notes


def test_a_duration_that_runs_to_its_bound_is_told():
    found = solve(block(end=None, duration=(1e-3, 10), stage_cost=lambda u: 1 + u**2))
    assert "lower bound 0.001" in found.advice
    kept = solve(block(duration=(1e-3, 10), stage_cost=lambda u: 1 + u**2))
    assert not kept.notes
    assert kept.duration == pytest.approx(36**0.25, rel=1e-6)  # t + 12/t³ is least


@pytest.mark.parametrize(
    ("call", "argument"),
    [
        ({"start": "x"}, "start"),
        ({"tolerance": -1}, "tolerance"),
        ({"options": [1]}, "options"),
        ({"options": {"nonsense": 1}}, "options"),
        ({"options": {"linear_solver": "none such"}}, "options"),
        ({"time_limit": 0}, "time_limit"),
        ({"max_iterations": 2.5}, "max_iterations"),
    ],
)
def test_bad_calls_are_refused(call, argument):
    with pytest.raises(InputError) as caught:
        solve(build(block()), **call)
    assert caught.value.argument == argument


@pytest.mark.parametrize("unit", [1.0, 3600.0, 1 / 3600])
def test_units_of_time_change_nothing(unit):
    phase = block(
        dynamics=lambda x, u: ca.vertcat(x[1], u) / unit, duration=(0.1 * unit, 50 * unit), u_bounds=(-1, 1),
        stage_cost=None, terminal_cost=lambda t: t / unit,
    )  # fmt: skip
    found = solve(phase)
    assert found.solved
    assert found.cost == pytest.approx(2.0, rel=1e-5)


@pytest.mark.parametrize("k", [1e-3, 1.0, 1e6])
def test_units_of_length_change_neither_plan_nor_iterations(k):
    phase = block(k, u_bounds=(-5 * k, 5 * k), path=lambda x: x[1] - 1.4 * k, stage_cost=lambda u: (u / k) ** 2)
    found = solve(phase)
    plain = solve(block(u_bounds=(-5, 5), path=lambda x: x[1] - 1.4))
    assert found.cost == pytest.approx(plain.cost, rel=1e-6)
    assert found.x([0.3, 0.5]) == pytest.approx(k * plain.x([0.3, 0.5]), rel=1e-4)
    assert abs(found.iterations - plain.iterations) <= 2


def test_a_small_limit_is_kept_as_well_as_a_large_one():
    # a path limit in units of which all values are 1e-9
    phase = block(path=lambda x: 1e-9 * (x[1] - 1.2))
    found = solve(build(phase, Radau(3), 40))
    assert found.phases[0].stages.states[..., 1].max() <= 1.2 + 1e-6


@pytest.mark.long
def test_the_largest_cost_of_scenarios_starts_warm_on_another_mesh():
    problem = OptimalControlProblem([block(1e3), block(2e3)], linked=False, risk="worst")
    coarse = solve(problem)
    program = build(problem, intervals=40)
    warm = solve(program, start=coarse)
    assert warm.cost == pytest.approx(12 * 4e6, rel=1e-6)
    assert warm.iterations < solve(program).iterations
    with pytest.raises(InputError, match="side by side"):
        coarse.x(0.5)


@pytest.mark.long
def test_what_cvodes_misses_is_its_own_tolerance():
    phase = block(dynamics=lambda x, u: ca.vertcat(x[1], u - ca.sin(5 * x[0])))
    found = solve(build(phase, MultipleShooting(integrator="cvodes", tolerance=1e-8), 4))
    assert 0 < found.errors[0].max() < 1e-5
    assert found.errors[0].max() < 0.01 * solve(build(phase, MultipleShooting(), 4)).errors[0].max()


def test_refinement_takes_a_start():
    phase = block(x_bounds=([-INF, -INF], [INF, 1.2]))
    first = refine(phase)
    assert refine(phase, start=first).iterations < first.iterations


def test_a_start_with_other_inputs_and_options_without_names_are_refused():
    def phase(inputs):
        return Phase(
            dynamics=lambda x, u: ca.vertcat(x[1], u[0]), states=2, inputs=inputs, start=[0, 0], end=[1, 0],
            duration=1.0, stage_cost=lambda x, u: ca.sumsqr(u),
        )  # fmt: skip

    one = solve(phase(1))
    assert solve(phase(1), start=one).cost == pytest.approx(one.cost)
    with pytest.raises(InputError, match="start"):
        solve(phase(2), start=one)
    with pytest.raises(InputError, match="options"):
        solve(phase(1), options={3: 1})


def test_a_limit_that_is_passed_between_the_points_is_told():
    # a wall about t = 0.5 that one mesh of few intervals jumps over, and one of many does not
    over = Phase(
        dynamics=lambda u: u, states=1, inputs=1, start=[0.0], end=[0.0], duration=1.0, stage_cost=lambda u: u**2,
        path=lambda x, t: ca.exp(-(((t - 0.47) / 0.02) ** 2)) - 0.1 - x,
    )  # fmt: skip
    coarse, fine = (solve(build(over, Trapezoidal(), n)) for n in (10, 400))
    assert coarse.status is OptimalControlStatus.LIMITS_PASSED
    assert not coarse.solved
    assert coarse.path_excess[0].value[0] > 0.1
    assert coarse.path_excess[0].time[0] == pytest.approx(0.47, abs=0.03)
    assert "path 1 is exceeded by" in coarse.advice
    assert fine.path_excess[0].value[0] < 1e-2


def test_a_guess_in_seconds_is_not_taken_for_fractions():
    guess = ([0, 1, 2], np.zeros((3, 1)), np.zeros((3, 1)))
    with pytest.raises(InputError, match="fractions of the duration"):
        Phase(dynamics=lambda u: u, states=1, inputs=1, start=[0.0], end=[1.0], duration=2.0, guess=guess)


@pytest.mark.check
def test_a_bound_of_the_duration_that_is_far_away_costs_no_iterations():
    from classical_problems import CLASSICAL

    counts = []
    for most in (100.0, 1e3, 1e5):
        phase = replace(CLASSICAL["robot arm"].phase, duration=(0.1, most), duration_guess=8.0)
        found = solve(build(phase, Radau(3), 20))
        assert found.duration == pytest.approx(9.14093, rel=1e-3)
        counts.append(found.iterations)
    assert max(counts) <= min(counts) + 3


@pytest.mark.parametrize(("length", "minute"), [(1.0, 1.0), (1e3, 1 / 60), (1e-4, 3600.0), (1e6, 1e-3)])
@pytest.mark.parametrize("current", [0.5, -0.8])
def test_a_state_that_vanishes_along_the_optimum_keeps_its_size(length, minute, current):
    # Zermelo's swimmer, straight across a river: the state along the river stays 0 while the current is held against
    speed = length / minute
    found = solve(Phase(
        lambda u: ca.vertcat(speed * (ca.cos(u) - current), speed * ca.sin(u)), 2, 1, start=[0, 0], end=[0, length],
        duration=(0.1 * minute, 100 * minute), u_bounds=(-np.pi, np.pi), terminal_cost=lambda t: t,
        guess=([0, 1], [[0, 0], [0, length]], [[1.5], [1.5]]),
    ))  # fmt: skip
    assert found.solved
    assert found.cost == pytest.approx(minute / np.sqrt(1 - current**2), rel=1e-7)
    assert found.u(0.5 * found.duration) == pytest.approx(np.arccos(current), rel=1e-4)


@pytest.mark.quick(3)
@pytest.mark.parametrize(
    "scheme", [Radau(3), Radau(9), Trapezoidal(), MultipleShooting(integrator="cvodes")], ids=lambda scheme: scheme.name
)
def test_a_cost_that_vanishes_at_the_optimum_is_solved(scheme):
    # the rate of a decay from what it does, by least squares that end at 0; no input
    decay = Phase(lambda x, p: -p * x, 1, 0, start=[1], duration=2.0, stage_cost=lambda x, t: (x - ca.exp(-2 * t)) ** 2)
    found = solve(build(OptimalControlProblem(decay, p_bounds=(0, 10)), scheme, 20))
    assert found.solved, found.advice
    assert found.p == pytest.approx([2.0], abs=1e-2)
    assert found.u(0.3).shape == (0,)


def test_a_program_of_a_single_constraint_is_solved():
    once = Phase(
        lambda x, u: 0.5 * x + u, 1, 1, start=[1], duration=1, discrete=True, stage_cost=lambda x, u: x**2 + u**2,
        terminal_cost=lambda x: x**2,
    )  # fmt: skip
    found = solve(once)
    assert found.solved
    assert found.u(0.0) == pytest.approx(-0.25)  # u² + (0.5 + u)² is least
    assert found.cost == pytest.approx(1.125)


def test_a_mesh_of_too_few_unknowns_says_so():
    coarse = solve(build(block(), Radau(1), 1))
    assert coarse.status is OptimalControlStatus.INFEASIBLE
    assert "more intervals" in coarse.advice
    assert solve(build(block(), Radau(1), 4)).status is OptimalControlStatus.COARSE


def test_a_single_parameter_is_held_as_a_number():
    problem = OptimalControlProblem(block(dynamics=lambda x, u, p: ca.vertcat(x[1], p * u)), p_bounds=(0.1, 2))
    assert solve(problem, p=0.5).cost == pytest.approx(48.0)


def test_no_bounds_may_be_said_by_none_for_all_or_one_entry_and_inputs_have_times():
    def cost(**bounds):
        double = Phase(lambda x, u: ca.vertcat(x[1], u), 2, 1, start=[0, 0], end=[1, 0], duration=1.0,
                       stage_cost=lambda u: u**2, **bounds)  # fmt: skip
        return solve(double)

    free = cost()
    assert free.cost == pytest.approx(12.0, rel=1e-3)
    for bounds in ({"x_bounds": None, "u_bounds": None}, {"x_bounds": ([None, -9.0], None), "u_bounds": (None, 9.0)}):
        assert cost(**bounds).cost == pytest.approx(free.cost, rel=1e-9)
    (phase,) = free.phases
    assert phase.input_times.shape == (len(phase.inputs),)
    for t, u in zip(phase.input_times, phase.inputs):
        assert phase.u(t) == pytest.approx(u)
        assert u == pytest.approx([6 - 12 * t], abs=0.05)
