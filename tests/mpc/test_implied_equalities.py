"""Rows that hold with equality everywhere: found together, in time, and only where that is certain."""

import time

import numpy as np
import pytest
from plants import box
from random_problems import problem_of

from invariant_sets import Polytope
from mpc import LinearMPC, MPQPStatus, solve_mpqp
from mpc.explicit import equality_elimination
from mpc.explicit.equality_elimination import implied_equalities
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
    assert implied_equalities(scaled(G, right, S)).status is MPQPStatus.INACCURATE
    right[:3] = [0, 0, 0]
    assert implied_equalities(scaled(G, right, S)).rows.tolist() == [0, 1, 2]


def test_no_feasible_point_is_infeasible():
    qp = scaled([[1.0], [-1.0]], [-1.0, 0.0], np.zeros((2, 1)))
    assert implied_equalities(qp).status is MPQPStatus.INFEASIBLE


def test_time_is_looked_at_before_every_program():
    problem, X = corner(4)
    qp = scale_qp(problem, scale_parameters(X, 2))
    assert implied_equalities(qp, time.perf_counter()).status is MPQPStatus.TIME_LIMIT


def test_a_solver_that_fails_settles_nothing(monkeypatch):
    class Failed:
        status = 4

    monkeypatch.setattr(equality_elimination, "solve_exactly", lambda *_: Failed)
    qp = scaled([[1.0], [-1.0]], [1.0, 1.0], np.zeros((2, 1)))
    assert implied_equalities(qp).status is MPQPStatus.INACCURATE


@pytest.mark.parametrize("limit", [0.3, 3.0])
def test_the_time_limit_of_a_law_holds_for_its_equalities(limit):
    problem, X = corner(60)
    start = time.perf_counter()
    partition = solve_mpqp(problem, X, time_limit=limit)
    assert time.perf_counter() - start < limit + 5.0  # one program a row took over ten seconds
    assert partition.status in (MPQPStatus.TIME_LIMIT, MPQPStatus.COMPLETE)
