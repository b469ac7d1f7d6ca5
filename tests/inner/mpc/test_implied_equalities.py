"""Rows that hold with equality everywhere: found together, in time, and only where that is certain."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
from plants import box
from random_problems import problem_of

from invariant_sets import Polytope
from mpc import LinearMPC, MPQPStatus, solve_mpqp
from mpc.explicit import equality_elimination, linear_programs
from mpc.explicit.equality_elimination import ImpliedEqualities, implied_equalities
from mpc.explicit.scaled_qp import scale_parameters, scale_qp


def scaled(G, w, S, nt=1):
    """The least-norm problem over G z <= w + S t, |t| <= 1."""
    nz = len(G[0])
    problem = problem_of(np.eye(nz), np.zeros((nz, nt)), np.zeros(nz), np.array(G), np.array(w), np.array(S))
    return scale_qp(problem, scale_parameters(Polytope.from_bounds(-np.ones(nt), np.ones(nt)), nt))


def corner(horizon):
    """Inputs with u1 + u2 <= 1 and both at least a half: two equalities in every step, none of them stated."""
    U = Polytope([[1, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], [1, -0.5, -0.5, 1, 1])
    A, B = np.array([[1, 0.1], [0, 1]]), np.array([[0, 0, 0], [0.1, 0.05, 0.1]])
    mpc = LinearMPC(A, B, Q=np.eye(2), R=np.eye(3), horizon=horizon, X=box([5, 5]), U=U)
    return mpc.build(), mpc.X


def test_all_rows_of_a_corner_are_found_and_no_other():
    problem, X = corner(4)
    qp = scale_qp(problem, scale_parameters(X, 2))
    implied = implied_equalities(qp)
    assert implied.status is MPQPStatus.COMPLETE
    inputs = [i for i, row in enumerate(qp.origin) if problem.labels[row].kind == "input"]
    fixed = [i for i in inputs if problem.G[qp.origin[i]] @ np.tile([0.5, 0.5, 0.0], 4) == problem.w[qp.origin[i]]]
    assert sorted(implied.rows.tolist()) == fixed
    assert len(fixed) == 12


def test_a_row_that_gave_its_slack_to_others_is_not_forced():
    # z1 = 0 by two rows; the slack of z2 <= 0 and of -z1 - z2 <= 1e-3 cannot both be large
    qp = scaled([[1, 0], [-1, 0], [0, 1], [-1, -1]], [0, 0, 0, 1e-3], np.zeros((4, 1)))
    assert implied_equalities(qp).rows.tolist() == [0, 1]


def test_slack_that_is_less_than_rounding_settles_nothing_where_rows_are_nearly_parallel():
    close = 1e-4
    G = [[1, 0], [-1, close], [-1, -close], *[[0, 1], [0, -1], [1, 1], [1, -1]]]
    right = [1e-9, 1e-9, 1e-9, 2, 2, 2, 2]
    S = np.array([0, 0, 0, 1, 1, 1, 1])[:, None]
    assert not implied_equalities(scaled(G, right, S)).exact
    right[:3] = [0, 0, 0]
    known = implied_equalities(scaled(G, right, S))
    assert known.exact
    assert known.rows.tolist() == [0, 1, 2]


def test_no_feasible_point_is_infeasible():
    qp = scaled([[1.0], [-1.0]], [-1.0, 0.0], np.zeros((2, 1)))
    assert implied_equalities(qp).status is MPQPStatus.INFEASIBLE


def test_time_is_looked_at_before_every_program():
    problem, X = corner(4)
    qp = scale_qp(problem, scale_parameters(X, 2))
    assert implied_equalities(qp, time.perf_counter()).status is MPQPStatus.TIME_LIMIT


def test_a_solver_that_fails_settles_nothing(monkeypatch):
    failed = SimpleNamespace(status=4)
    monkeypatch.setattr(equality_elimination, "solve_exactly", lambda *_: failed)
    qp = scaled([[1.0], [-1.0]], [1.0, 1.0], np.zeros((2, 1)))
    assert implied_equalities(qp).status is MPQPStatus.INACCURATE


@pytest.mark.parametrize("status", [MPQPStatus.TIME_LIMIT, MPQPStatus.INACCURATE, MPQPStatus.INFEASIBLE])
def test_a_law_says_what_its_equalities_say(monkeypatch, status):
    monkeypatch.setattr("mpc.explicit.mpqp.implied_equalities", lambda *_: ImpliedEqualities(status))
    problem, X = corner(4)
    assert solve_mpqp(problem, X).status is status


def test_one_row_whose_program_fails_leaves_all_unsettled(monkeypatch):
    # slabs 2e-9 thick: together they have slack, each alone has to be asked
    slabs = np.repeat(np.eye(4), 2, axis=0) * np.tile([1.0, -1.0], 4)[:, None]
    G = np.vstack([slabs, np.ones((9, 4))])
    qp = scaled(G, [*[1e-9] * 8, *[4.0] * 9], np.append(np.zeros(8), np.ones(9))[:, None])
    solve = equality_elimination._most_slack

    def failing_alone(J, h, counted, *rest):
        found = solve(J, h, counted, *rest)
        if len(counted) == 1:
            found.status = 4
        return found

    assert implied_equalities(qp).status is MPQPStatus.COMPLETE
    monkeypatch.setattr(equality_elimination, "_most_slack", failing_alone)
    assert implied_equalities(qp).status is MPQPStatus.INACCURATE


@pytest.mark.parametrize("seed", range(12))
def test_parameters_far_outside_are_infeasible_by_proof(seed, monkeypatch):
    """No linear program is needed, and HiGHS does not end on some of these."""
    monkeypatch.setattr(equality_elimination, "solve_exactly", lambda *_: pytest.fail("asked though it is proven"))
    rng = np.random.default_rng(seed)
    n, N = int(rng.integers(2, 5)), int(rng.integers(5, 15))
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.8, 1.2) / np.abs(np.linalg.eigvals(A)).max()
    mpc = LinearMPC(A, rng.normal(size=(n, 1)), Q=np.eye(n), R=[[0.1]], horizon=N, X=box(5 * np.ones(n)), U=box([1]))
    centre = rng.choice([-1.0, 1.0], n) * rng.uniform(8, 100, n)
    assert solve_mpqp(mpc.build(), Polytope.from_bounds(centre - 1, centre + 1)).status is MPQPStatus.INFEASIBLE


@pytest.mark.parametrize("cost", [1e-20, 1.0, 1e14, 1e20])
@pytest.mark.parametrize("low", [-1.0, -1e-6, -1e-9, 0.0])
def test_neither_the_unit_of_the_cost_nor_a_bound_near_zero_makes_a_linear_program(cost, low):
    A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
    U = Polytope.from_bounds([low], [1.0])
    mpc = LinearMPC(A, B, Q=cost * np.eye(2), R=[[0.1 * cost]], horizon=5, U=U)
    problem = mpc.build()
    far = scale_qp(problem, scale_parameters(box([5, 5]), 2)).far
    assert 1.0 < far < 100.0
    assert solve_mpqp(problem, box([5, 5])).status is MPQPStatus.COMPLETE


@pytest.mark.check
@pytest.mark.parametrize("limit", [0.3, 3.0])
def test_the_time_limit_of_a_law_holds_for_its_equalities(limit, monkeypatch):
    given, solve = [], linear_programs.linprog

    def watched(*args, options, **kept):
        given.append(options.get("time_limit", np.inf))
        return solve(*args, options=options, **kept)

    monkeypatch.setattr(linear_programs, "linprog", watched)
    problem, X = corner(60)
    partition = solve_mpqp(problem, X, time_limit=limit)
    assert partition.status in (MPQPStatus.TIME_LIMIT, MPQPStatus.COMPLETE)
    assert all(left <= limit for left in given)
    assert sum(left <= 0.0 for left in given) <= 1  # one program a row took over ten seconds
