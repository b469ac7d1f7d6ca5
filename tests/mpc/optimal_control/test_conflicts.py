"""What went wrong is told in the user's own names, the worst first, with amounts, and no longer than is read."""

import casadi as ca
import numpy as np
import pytest

from mpc import InputError
from mpc.optimal_control import (
    HermiteSimpson,
    MultipleShooting,
    OptimalControlProblem,
    OptimalControlStatus,
    Phase,
    Radau,
    Trapezoidal,
    build,
    solve,
)

INF = float("inf")


def block(**change):
    """A mass brought over 1 m in 1 s, from rest to rest."""
    given = {
        "dynamics": lambda x, u: ca.vertcat(x[1], u), "states": 2, "inputs": 1, "start": [0, 0], "end": [1, 0],
        "stage_cost": lambda u: u**2,
    }  # fmt: skip
    return Phase(**(given | change))


@pytest.mark.long
def test_conflicts_have_the_names_of_the_limits():
    walls = block(path=lambda x: ca.vertcat(x[0] - 3, 0.5 - x[0]), path_names=["right wall", "left wall"])
    found = solve(walls)
    assert found.status is OptimalControlStatus.INFEASIBLE
    assert any(conflict.startswith("left wall at t = ") for conflict in found.conflicts)
    assert not any("right wall" in conflict or "path" in conflict for conflict in found.conflicts)
    ends = solve(block(boundary=lambda x0, x: ca.vertcat(x0[0], x[0] - 2), boundary_names=["at home", "closed gap"]))
    assert ends.conflicts[0] == "closed gap at t = 1, by 1"
    shared = OptimalControlProblem(
        block(), p_bounds=([0, 0], [1, 1]), p_constraints=lambda p: ca.vertcat(p[0] - 0.5, 2 - p[1]),
        p_names=["stiffness", "damping"], p_constraint_names=["soft", "stiff"],
    )  # fmt: skip
    assert solve(shared).conflicts == ("stiff, by 1", "damping ≤ 1")


@pytest.mark.long
def test_every_limit_that_stands_in_the_way_is_named_though_limits_are_stated_together():
    # 0.5 m after 0.9 s, at no more than 0.4 m/s
    late = block(end=None, path_names=["there", "speed", "far"], path=lambda x, t: ca.vertcat(
        ca.if_else(t > 0.9, 0.5 - x[0], -1), x[1] - 0.4, x[0] - 10))  # fmt: skip
    named = "\n".join(solve(late).conflicts)
    assert "there at t = " in named
    assert "speed at t = " in named
    assert "far" not in named


@pytest.mark.parametrize("scheme", [Radau(3), Trapezoidal(), HermiteSimpson(), MultipleShooting()])
def test_the_limit_at_an_end_that_intervals_leave_out_has_its_own_name(scheme):
    # the first limit is of the input, which Radau does not have at the start; the second is broken there alone
    late = block(
        path=lambda x, u, t: ca.vertcat(u - 99, 0.3 - x[0] - 100 * t, x[0] - 9), path_names=["force", "late", "far"]
    )
    found = solve(build(late, scheme, 10))
    assert found.status is OptimalControlStatus.INFEASIBLE
    assert found.conflicts[0] == "late at t = 0, by 0.3"


def test_limits_passed_between_the_points_have_their_names():
    narrow = Phase(
        dynamics=lambda u: u, states=1, inputs=1, start=[0.0], end=[0.0], stage_cost=lambda u: u**2,
        path=lambda x, t: ca.exp(-(((t - 0.47) / 0.02) ** 2)) - 0.1 - x, path_names=["kerb"],
    )  # fmt: skip
    assert "mesh kerb is exceeded by" in solve(build(narrow, Trapezoidal(), 10)).advice


def test_a_stopped_solve_says_by_how_much_what_is_violated():
    fast = ([0, 0.5, 1], [[0, 0], [0.5, 5], [1, 0]], np.zeros((3, 1)))
    limited = block(path=lambda x: 9 * (x[1] ** 2 - 1.44), path_names=["speed limit"], guess=fast)
    stopped = solve(build(limited, Radau(3), 20), max_iterations=1)
    assert stopped.status is OptimalControlStatus.STOPPED
    (named,) = (conflict for conflict in stopped.conflicts if "speed limit" in conflict)
    said = float(named.split("by ")[1].split(" ")[0])
    beyond = 9 * (stopped.phases[0].stages.states[..., 1] ** 2 - 1.44)
    assert said == pytest.approx(beyond.max(), rel=1e-2)
    assert f"and at {(beyond > 1e-3).sum() - 1} more points" in named


def test_long_lists_are_cut_and_begin_with_the_worst():
    # scenario k needs 1 + k times the input that there is, and of the parameter eight limits ask for too much
    many = [block(end=[1 + k, 0], u_bounds=(-1, 1)) for k in range(30)]
    problem = OptimalControlProblem(
        many, linked=False, p_bounds=(0, 1), p_constraints=lambda p: ca.vertcat(*(2 + i - p for i in range(8)))
    )
    found = solve(build(problem, Trapezoidal(), 3))
    assert found.status is OptimalControlStatus.INFEASIBLE
    assert len(found.conflicts) <= 20
    assert found.conflicts[:5] == tuple(f"p_constraints {i}, by {i}" for i in (8, 7, 6, 5, 4))
    rest = [conflict for conflict in found.conflicts if conflict.startswith("and ")]
    assert {"constraints", "bounds"} == {conflict.split()[-1] for conflict in rest}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"dynamics": lambda x, u: ca.vertcat(x[1], u / x[0])}, r"in dynamics of x2 at t = 0, where x = \[0, 0\], u ="),
        ({"stage_cost": lambda u, t: u**2 + ca.sqrt(t - 0.5)}, r"nan in stage_cost at t = 0, where x = \[0, 0\]"),
        ({"path": lambda x: ca.vertcat(x[1], ca.log(x[0] - 2)), "path_names": ["a", "room"]}, "nan in room at t = 0"),
        ({"terminal_cost": lambda x: 1 / (x[0] - 1)}, r"inf in terminal_cost at t = 1, where x = \[1, 0\]"),
        ({"boundary": lambda x0, x: x[0] / x0[0]}, r"inf in boundary 1 at t = 1, where x0 = \[0, 0\], x = \[1, 0\]"),
    ],
)
def test_what_is_not_finite_at_the_guess_says_which_function_when_and_where(change, said):
    with pytest.raises(InputError, match=said) as caught:
        build(block(**change), Trapezoidal(), 8)
    assert caught.value.argument == "guess"


def test_what_is_not_finite_names_phase_signal_and_parameters():
    good = block()
    bad = block(
        start=None, end=None, dynamics=lambda x, u, w, p: ca.vertcat(x[1] * w[0], u / p[1]),
        signal=np.array([[2.0], [3.0]]), guess=([0, 1], [[1, 0], [1, 0]], [[0.5], [0.5]]),
    )  # fmt: skip
    problem = OptimalControlProblem([good, bad], p_bounds=([1, 0], [2, 1]), p_guess=[1, 0])
    where = r"inf in dynamics of x2 of phase 2 at t = 1, where x = \[1, 0\], u = \[0.5\], w = \[2\], p = \[1, 0\]"
    with pytest.raises(InputError, match=where):
        build(problem, Trapezoidal(), 4)
    with pytest.raises(InputError, match=r"in p_cost, where p = \[0\]"):
        build(OptimalControlProblem(good, p_bounds=(0, 1), p_guess=[0], p_cost=lambda p: 1 / p))


@pytest.mark.check
def test_functions_that_become_undefined_on_the_way_say_where():
    found = solve(block(stage_cost=lambda x, u: u**2 + 1e-3 * ca.log(1.2 - x[1]), end=[0.9, 0]))
    assert found.status in (OptimalControlStatus.UNDEFINED, OptimalControlStatus.SOLVED, OptimalControlStatus.STOPPED)
    if found.status is OptimalControlStatus.UNDEFINED:
        assert found.conflicts


def test_weakly_active_limits_have_the_names_of_states_and_inputs():
    # an input that is best held at 1, and may not be more
    steady = Phase(
        dynamics=lambda u: u, states=1, inputs=1, start=[0.0], stage_cost=lambda u: u**2, u_bounds=(-5, 1),
        terminal_cost=lambda x: -2 * x, input_names=["force"],
    )  # fmt: skip
    found = solve(build(steady, Radau(2), 4)).sensitivity()
    assert found.weakly_active
    assert all(name.startswith("bound of force at t = ") for name in found.weakly_active)
