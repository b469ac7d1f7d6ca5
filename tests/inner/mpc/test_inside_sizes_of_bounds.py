"""What test_sizes_of_bounds.py claims, seen from inside."""

import time

import numpy as np
import pytest
from random_problems import problem_of

from invariant_sets import Polytope
from mpc import MPQPStatus, solve_mpqp
from mpc.explicit import linear_programs, mpqp
from mpc.explicit.linear_programs import OnlineQP
from mpc.explicit.scaled_qp import scale_parameters, scale_qp

ONE = Polytope.from_bounds([-1.0], [1.0])


@pytest.mark.check
def test_the_first_regions_and_a_single_question_keep_the_time_limit(monkeypatch):
    """3400 rows on 200 variables: each linear program is given what is left of the time, and none comes after it."""
    n, limit = 200, 0.1
    rng = np.random.default_rng(0)
    slabs = np.repeat(np.eye(n), 2, axis=0) * np.tile([1.0, -1.0], n)[:, None]
    X = rng.normal(size=(3001, n))
    w = np.append(np.full(2 * n, 5e-8), np.full(3001, 4.0))
    S = np.append(np.zeros(2 * n), np.ones(3001))[:, None]
    problem = problem_of(np.eye(n), rng.normal(size=(n, 1)), np.zeros(n), np.vstack([slabs, X]), w, S)
    given, solve = [], linear_programs.linprog

    def watched(*args, options, **kept):
        given.append(options.get("time_limit", np.inf))
        return solve(*args, options=options, **kept)

    monkeypatch.setattr(linear_programs, "linprog", watched)
    assert solve_mpqp(problem, ONE, time_limit=limit).status is MPQPStatus.TIME_LIMIT
    assert max(given, default=0.0) <= limit
    assert sum(left <= 0.0 for left in given) <= 1
    online, given[:] = OnlineQP(scale_qp(problem, scale_parameters(ONE, 1))), []
    online._linear_program_finds_room(*np.ones((2, len(online.qp.M))), time.perf_counter() + limit)
    assert len(given) == 1
    assert given[0] <= limit


def test_a_law_of_nearly_dependent_rows_holds_them():
    """A Gram matrix squares the loss of digits: rows that 1e-7 tells apart need orthogonal directions."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        rows = rng.normal(size=(3, 4))
        rows[2] = rows[0] + rows[1] + 10.0 ** rng.uniform(-6.5, -5.5) * rng.normal(size=4)
        rows /= np.linalg.norm(rows, axis=1)[:, None]
        right = rows @ rng.normal(size=(4, 3))
        law = mpqp._law(rows[None], right[None], (rows @ rows.T)[None])[0][0]
        assert np.abs(rows @ law - right).max() < 1e-8
        np.testing.assert_allclose(law, np.linalg.lstsq(rows, right, rcond=1e-15)[0], atol=1e-6)
