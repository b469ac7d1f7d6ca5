"""What cannot be meant is refused where it is stated; what cannot be solved says so."""

import math

import casadi as ca
import numpy as np
import pytest

from mpc import InputError
from mpc.optimal_control import (
    Collocation,
    MultipleShooting,
    OptimalControlProblem,
    OptimalControlStatus,
    Phase,
    Radau,
    build,
    solve,
)

GOOD = {"dynamics": lambda x, u: ca.vertcat(x[1], u), "states": 2, "inputs": 1, "start": [0, 0], "end": [1, 0],
        "stage_cost": lambda u: u**2}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "argument", "got"),
    [
        ({"dynamics": lambda x, v: x}, "dynamics", "argument named 'v'"),
        ({"dynamics": lambda x, u: x[1]}, "dynamics", "1 rows"),
        ({"dynamics": lambda x, u: ca.vertcat(x[5], u)}, "dynamics", "stops with index 5 beyond a column of 2"),
        ({"dynamics": lambda x, u: ca.vertcat(ca.SX.sym("stranger"), u)}, "dynamics", "stranger"),
        ({"dynamics": lambda x, u, p: ca.vertcat(x[1], u * p[0])}, "dynamics", "no p"),
        ({"dynamics": 3}, "dynamics", "3"),
        ({"dynamics": None}, "dynamics", "None"),
        ({"stage_cost": lambda x: x}, "stage_cost", "2 rows"),
        ({"terminal_cost": lambda u: u}, "terminal_cost", "argument named 'u'"),
        ({"states": 0}, "states", "0"),
        ({"start": [0, 0, 0]}, "start", "shape (3,)"),
        ({"end": [np.inf, 0]}, "end", "inf"),
        ({"x_bounds": ([0, 0], [1, -1])}, "x_bounds", "entry 2"),
        ({"x_bounds": ([-1, -1], [0.5, 1])}, "end", "state 1"),
        ({"u_bounds": (np.nan, 1)}, "u_bounds, lower", "nan"),
        ({"duration": 0}, "duration", "0"),
        ({"duration": (0, 3)}, "duration", "(0, 3)"),
        ({"duration": 2.5, "discrete": True}, "duration", "2.5"),
        ({"signal": [[1.0], [2.0]], "duration": (1, 2)}, "signal", "free"),
        ({"signal": [1.0, 2.0, 3.0]}, "signal", "got shape (3,), expected (n, nw), n ≥ 2"),
        ({"state_names": ["a"]}, "state_names", "('a',), expected 2 names"),
        ({"state_names": "ab"}, "state_names", "'ab'"),
        ({"duration": (1, 3), "duration_guess": np.nan}, "duration_guess", "nan"),
        ({"duration": (1e3, 2e3), "duration_guess": 5e3}, "duration_guess", "within duration, 1000.0 to 2000.0"),
        ({"duration": (1e-3, 2e-3), "duration_guess": 5e-4}, "duration_guess", "within duration"),
        ({"guess": 3}, "guess", "3"),
        ({"guess": ([0, 1], [[0, np.nan], [1, 0]], [[0], [0]])}, "guess", "nan at index (0, 1)"),
        ({"signal": lambda t: 1 / 0}, "signal", "ZeroDivisionError"),
        ({"path": lambda x: x[0] < 1}, "path", "a comparison, expected values: limits are stated as g ≤ 0"),
        ({"path": lambda x, u: ca.vertcat(x[0] - 1, u >= 2)}, "path", "such as x[0] - 1"),
        ({"path": lambda x: ca.logic_and(x[0] < 1, x[1] < 1)}, "path", "a comparison"),
        ({"boundary": lambda x: x[0] == 1}, "boundary", "a comparison"),
    ],
)
def test_a_bad_phase_is_refused_where_it_is_stated(change, argument, got):
    with pytest.raises(InputError) as caught:
        build(Phase(**(GOOD | change)))
    assert caught.value.argument == argument
    assert got in str(caught.value)


@pytest.mark.parametrize("intervals", [[np.ones(2), np.ones(3)], [np.ones(2, dtype=int)], [2.0], np.array(4.0), "ab"])
def test_intervals_that_are_no_whole_numbers_are_refused_by_name(intervals):
    with pytest.raises(InputError, match=r"^intervals: got .* expected") as caught:
        build(Phase(**GOOD), intervals=intervals)
    assert caught.value.argument == "intervals"


@pytest.mark.long
def test_an_integrator_that_stops_at_the_guess_is_told_in_words():
    away = Phase(lambda x, u: ca.vertcat(x[1], 500 * x[0] ** 3 + u), 2, 1, start=[0, 0], end=[1, 0], duration=3.0)
    with pytest.raises(InputError, match=r"guess: got one that stops with CVode returned .* Give a `guess`") as caught:
        build(away, MultipleShooting(integrator="cvodes"), intervals=5)
    assert ".cpp" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "argument"),
    [
        ({"phases": []}, "phases"),
        ({"p_bounds": 3}, "p_bounds"),
        ({"p_bounds": ([1], [0])}, "p_bounds"),
        ({"weights": [1, 2]}, "weights"),
        ({"risk": "best"}, "risk"),
        ({"p_constraints": lambda x: x, "p_bounds": (0, 1)}, "p_constraints"),
    ],
)
def test_a_bad_problem_is_refused(change, argument):
    with pytest.raises(InputError) as caught:
        build(OptimalControlProblem(**({"phases": Phase(**GOOD)} | change)))
    assert caught.value.argument == argument


def test_a_mesh_must_rise_and_a_scheme_end_at_one():
    with pytest.raises(InputError, match="rise from 0 to 1"):
        build(Phase(**GOOD), meshes=[[0, 0.6, 0.4, 1]])
    with pytest.raises(InputError, match="meshes: got 3, expected a list"):
        build(Phase(**GOOD), meshes=3)
    with pytest.raises(InputError, match="points"):
        Collocation((0.2, 0.8))


def test_dynamics_that_are_not_finite_at_the_guess_say_which_and_when():
    phase = Phase(
        lambda x, u: ca.vertcat(x[1], u / (x[0] - 0.5)), 2, 1, start=[0.5, 0], end=[0.5, 0], stage_cost=lambda u: u**2
    )
    with pytest.raises(InputError, match=r"dynamics of x2 at t = ") as caught:
        build(phase, Radau(3), 4)
    assert caught.value.argument == "guess"


def test_limits_that_contradict_are_named():
    phase = Phase(**(GOOD | {"u_bounds": (-1, 1), "duration": 1.0}))  # 1 m in 1 s needs 4 m/s²
    solution = solve(build(phase, Radau(3), 10))
    assert solution.status is OptimalControlStatus.INFEASIBLE
    assert {"u1 ≤ 1", "u1 ≥ -1", "end of x1 = 1", "start of x1 = 0"} <= set(solution.conflicts)
    assert any("dynamics of x" in conflict for conflict in solution.conflicts)
    path = Phase(**(GOOD | {"path": lambda x: ca.vertcat(x[0] - 3, 0.5 - x[0])}))
    named = solve(build(path, Radau(3), 10))
    assert named.status is OptimalControlStatus.INFEASIBLE
    assert any("path 2" in conflict for conflict in named.conflicts)


def test_a_solver_that_is_stopped_does_not_pass_for_optimal():
    from classical_problems import CLASSICAL

    stopped = solve(build(CLASSICAL["robot arm"].phase, Radau(3), 20), max_iterations=5)
    assert stopped.status is OptimalControlStatus.STOPPED
    assert "Raise the limit" in stopped.status.advice


def test_a_casadi_function_states_a_phase_as_well():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    named = ca.Function("f", [u, x], [ca.vertcat(x[1], u)], ["u", "x"], ["dx"])
    plain = ca.Function("f", [x, u], [ca.vertcat(x[1], u)])
    table = ca.interpolant("drag", "bspline", [np.linspace(-2, 4, 13)], 0.1 * np.linspace(-2, 4, 13) ** 2)
    costs = [solve(build(Phase(**(GOOD | {"dynamics": f})))).cost for f in (named, plain, GOOD["dynamics"])]
    assert costs == pytest.approx([12.0] * 3, rel=1e-7)
    v = ca.MX.sym("x", 2)
    f = ca.MX.sym("u")
    opaque = ca.Function("f", [v, f], [ca.vertcat(v[1], f - table(v[1]))])
    written = Phase(**(GOOD | {"dynamics": lambda x, u: ca.vertcat(x[1], u - 0.1 * x[1] ** 2)}))
    assert solve(build(Phase(**(GOOD | {"dynamics": opaque})))).cost == pytest.approx(
        solve(build(written)).cost, rel=1e-5
    )


@pytest.mark.parametrize(
    ("change", "argument", "got"),
    [
        ({"dynamics": lambda x, u: ca.vertcat(x[5], u)}, "dynamics", "index 5 beyond a column of 2"),
        ({"stage_cost": lambda x: x @ x}, "stage_cost", "a product of 2x1 and 2x1"),
        ({"dynamics": lambda x, u: ca.vertcat(x[1], math.sin(x[0]) + u)}, "dynamics", "use ca.sin"),
        ({"stage_cost": lambda u: float(u)}, "stage_cost", "NaN"),
        ({"path": lambda x: max(x[0], x[1])}, "path", "ca.fmax"),
        ({"dynamics": lambda x, u: [x[1], u] if x[0] > 0 else [x[1], 0]}, "dynamics", "ca.if_else"),
        ({"path": lambda x: []}, "path", "returns nothing"),
        ({"dynamics": lambda x, u, w: [x[1], u + w[0]]}, "dynamics", "no w"),
        ({"boundary": lambda x0, x: x0 - ca.vertcat(x, x)}, "boundary", "x0 (2 rows)"),
        ({"terminal_cost": lambda x, u: u}, "terminal_cost", "'u'"),
        ({"path": lambda x: x[0], "path_bounds": ([0, 0], 1)}, "path_bounds, lower", "[0, 0]"),
        ({"path": lambda x: x[0], "path_names": ["a", "b"]}, "path_names", "('a', 'b'), expected 1 name"),
        ({"path": lambda x: x, "path_names": ["a", "a"]}, "path_names", "'a' twice"),
        ({"path_bounds": (0, 1)}, "path_bounds", "function `path`"),
        ({"boundary_names": ["closed"]}, "boundary_names", "function `boundary`"),
        ({"start": (0, 1)}, "start", "[0, 1] for the values"),
        ({"guess": ([0, 2], np.zeros((2, 2)), np.zeros((2, 1)))}, "guess", "from 0 to 2"),
    ],
)  # fmt: skip
def test_what_is_known_of_a_phase_alone_is_told_when_it_is_stated(change, argument, got):
    with pytest.raises(InputError) as caught:
        Phase(**(GOOD | change))
    assert caught.value.argument == argument
    assert got in str(caught.value)
    assert "casadi/core" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "argument", "got"),
    [
        ({"phases": Phase(**(GOOD | {"dynamics": lambda u, p: [u, u * p[5]]}))}, "dynamics", "beyond a column of 3"),
        ({"phases": [Phase(**GOOD), Phase(**(GOOD | {"path": lambda p: p @ p}))]}, "path of phase 2", "product of 3x1"),
        ({"phases": Phase(**(GOOD | {"stage_cost": lambda u, p: u * p[0:2]}))}, "stage_cost", "2 rows"),
        ({"p_cost": lambda p: p[7]}, "p_cost", "index 7"),
        ({"p_constraints": lambda p: p[0], "p_constraint_names": ["a", "b"]}, "p_constraint_names", "expected 1 name"),
        ({"p_guess": [0.5, 5, 0.5]}, "p_guess", "within p_bounds"),
        ({"p_guess": [5e-9] * 3, "p_bounds": ([0] * 3, [1e-9] * 3)}, "p_guess", "within p_bounds"),
        ({"p_names": ["mass"]}, "p_names", "('mass',), expected 3 names"),
        ({"phases": [Phase(**GOOD)] * 2, "link": lambda x: x[4]}, "link", "index 4"),
        ({"phases": [Phase(**GOOD)] * 2, "link": lambda x: x, "linked": False}, "link", "side by side"),
        ({"phases": [Phase(**GOOD)] * 2, "linked": False, "risk": "worst", "weights": [1, 0]}, "weights", "largest"),
        ({"phases": [Phase(**GOOD)] * 2, "linked": False, "risk": "spread", "weights": [0, 0]}, "weights", "not all"),
        ({"p_bounds": [(0, 1), (0, 2), (1, 3)]}, "p_bounds", "pairs of every entry"),
    ],
)  # fmt: skip
def test_what_takes_the_parameters_is_told_when_the_problem_is_stated(change, argument, got):
    with pytest.raises(InputError) as caught:
        OptimalControlProblem(**({"phases": Phase(**GOOD), "p_bounds": ([0] * 3, [1] * 3)} | change))
    assert caught.value.argument == argument
    assert got in str(caught.value)
    assert "casadi/core" not in str(caught.value)


def test_an_error_within_a_function_tells_its_line():
    line = test_an_error_within_a_function_tells_its_line.__code__.co_firstlineno
    with pytest.raises(InputError, match=f"line {line + 3} of test_bad_statements.py"):
        Phase(**(GOOD | {"dynamics": lambda x, u: ca.vertcat(x[9], u)}))


@pytest.mark.parametrize(
    "use", [lambda p: p, lambda p: -p, abs, lambda p: 2**p, lambda p: p[0], lambda p: p[0:2], ca.sin, lambda p: p.T],
    ids=["itself", "less", "size", "power", "entry", "part", "sine", "turned"],
)  # fmt: skip
def test_a_column_that_the_problem_lacks_is_named(use):
    with pytest.raises(InputError, match="no p in this problem"):
        build(Phase(**(GOOD | {"dynamics": lambda x, u, p: ca.vertcat(x[1], u * use(p))})))
    with pytest.raises(InputError, match="no w in this problem"):
        Phase(**(GOOD | {"dynamics": lambda x, u, w: ca.vertcat(x[1], u * use(w))}))
    with pytest.raises(InputError, match="no u in this problem"):
        Phase(**(GOOD | {"inputs": 0, "stage_cost": lambda u: use(u)}))


def test_a_python_function_may_contain_a_table():
    grid = np.linspace(-2, 4, 61)
    table = ca.interpolant("drag", "bspline", [grid], 0.1 * grid**3)  # cubic splines have cubes exactly
    looked_up, written = (
        solve(build(Phase(**(GOOD | {"dynamics": lambda x, u, f=f: ca.vertcat(x[1], u - f(x[1]))})), Radau(3), 10))
        for f in (table, lambda v: 0.1 * v**3)
    )
    assert looked_up.solved
    assert looked_up.cost == pytest.approx(written.cost, rel=1e-7)


@pytest.mark.parametrize(
    ("scheme", "argument"),
    [
        (lambda: Radau(51), "degree"),
        (lambda: Collocation((np.nan, 1.0)), "points"),
        (lambda: Collocation("ab"), "points"),
        (lambda: MultipleShooting(integrator="cvodes", tolerance=0), "tolerance"),
    ],
)
def test_a_bad_scheme_is_refused_where_it_is_stated(scheme, argument):
    with pytest.raises(InputError) as caught:
        scheme()
    assert caught.value.argument == argument


@pytest.mark.parametrize("degree", [5, 9, 15, 30])
def test_a_single_interval_of_high_degree_is_as_good_as_many(degree):
    # a pendulum pushed from rest to upright: no polynomial, but smooth
    phase = Phase(**(GOOD | {"dynamics": lambda x, u: ca.vertcat(x[1], u - ca.sin(x[0])), "duration": 2.0}))
    many = solve(build(phase, Radau(3), 100), tolerance=1e-10)
    one = solve(build(phase, Radau(degree), 1), tolerance=1e-10)
    assert one.solved
    assert one.cost == pytest.approx(many.cost, rel=max(10.0 ** (1 - degree), 2e-9))


def test_a_duration_without_an_upper_bound_is_told_by_none():
    assert Phase(**(GOOD | {"duration": (0.1, None)})).duration == (0.1, np.inf)


def test_a_signal_of_a_phase_after_a_free_duration_is_refused_however_far_after():
    free = Phase(**(GOOD | {"duration": (1, 2), "end": None}))
    fixed = Phase(**(GOOD | {"start": None, "end": None}))
    known = Phase(**(GOOD | {"start": None, "signal": lambda t: np.zeros((len(t), 1))}))
    OptimalControlProblem([fixed, fixed, known])
    with pytest.raises(InputError, match="phase 3, whose start is free"):
        OptimalControlProblem([free, fixed, known])
