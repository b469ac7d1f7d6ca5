"""Rows that others imply are left out where multipliers prove it, and nothing is lost without them."""

import time
from dataclasses import replace
from types import SimpleNamespace

import daqp
import numpy as np
import pytest
from plants import box, double_integrator
from random_problems import hard_controller, random_plant
from scipy.optimize import linprog
from slow_exploration import solve_slowly

from mpc import ExplicitMPC, InfeasibleError, LinearMPC, MPQPStatus, solve_mpqp
from mpc.explicit import exploration
from mpc.explicit.exploration import explore_compiled, irredundant_rows, is_implied
from mpc.explicit.holes import Search
from mpc.explicit.kernels.data import KNOWN
from mpc.explicit.scaled_qp import scale_parameters, scale_qp


def scaled(mpc):
    return scale_qp(mpc.build(), scale_parameters(mpc.X, mpc.nx))


@pytest.fixture
def touched():
    """A problem with sums of rows that are active together: they touch the set, and several sets are optimal."""
    mpc = LinearMPC(*double_integrator(), Q=np.eye(2), R=[[0.1]], horizon=5, X=box([5, 5]), U=box([1]))
    problem = mpc.build()
    G, w, S = (
        np.vstack([a, *(a[[i]] + a[[j]] for i, j in ((0, 7), (25, 7), (6, 18)))])
        for a in (problem.G, problem.w[:, None], problem.S)
    )
    return replace(problem, G=G, w=w[:, 0], S=S, labels=(problem.labels[0],) * len(w)), mpc.X


@pytest.mark.parametrize(("seed", "kind"), [(1148, "degenerate"), (1151, "degenerate"), (12, "plain"), (5, "scaled")])
def test_every_row_left_out_is_implied_by_those_kept(seed, kind):
    mpc, _ = hard_controller(np.random.default_rng(seed), kind)
    qp = scaled(mpc)
    J, h = qp.joint
    kept = irredundant_rows(qp)
    rest = np.concatenate([kept, np.arange(len(qp.M), len(J))])
    dropped = np.setdiff1d(np.arange(len(qp.M)), kept)
    for i in dropped[:: max(1, len(dropped) // 30)]:
        N, b = np.vstack([J[rest], J[i]]), np.append(h[rest], h[i] + 1)
        farthest = linprog(-J[i], A_ub=N, b_ub=b, bounds=(None, None))
        assert farthest.status == 0
        assert -farthest.fun <= h[i] + 1e-6


def test_a_solver_that_says_redundant_without_multipliers_is_not_believed(monkeypatch):
    square = np.vstack([np.eye(2), -np.eye(2)])
    row = np.array([0.6, 0.8])
    corner = np.array([1.0, 1.0])
    assert is_implied(row, 1.4, square, np.ones(4))
    assert not is_implied(row, 1.3, square, np.ones(4))

    def claims(*_, **__):
        return 0.5 * corner, -0.7, 1, {"lam": np.zeros(5)}

    monkeypatch.setattr(daqp, "solve", claims)
    assert not is_implied(row, 1.4, square, np.ones(4))


def test_rows_not_looked_at_in_time_are_kept(touched):
    qp = scale_qp(touched[0], scale_parameters(touched[1], 2))
    rows = irredundant_rows(qp, time.perf_counter() - 1.0)
    np.testing.assert_array_equal(rows, np.arange(len(qp.M)))
    assert len(irredundant_rows(qp)) < len(qp.M)


@pytest.mark.parametrize("solve", [solve_mpqp, solve_slowly])
def test_at_a_time_limit_the_regions_found_are_handed_back(touched, solve):
    partition = solve(*touched, time_limit=1e-6)
    assert partition.status is MPQPStatus.TIME_LIMIT
    assert len(partition) > 0
    assert len(ExplicitMPC.from_partition(partition, method="sequential")) == len(partition)


@pytest.mark.check
def test_the_slow_exploration_keeps_what_it_found_when_its_restart_is_late(touched, monkeypatch):
    import slow_exploration as reference

    qp = scale_qp(touched[0], scale_parameters(touched[1], 2))
    whole = reference.explore_all(qp, 1000, np.inf)
    first = reference._explore

    def late_again(problem, most, deadline, feasible=None):
        return first(problem, most, deadline if len(problem.M) == len(qp.M) else 0.0)

    monkeypatch.setattr(reference, "_explore", late_again)
    found = reference.explore_all(qp, 1000, np.inf)
    assert found.status is MPQPStatus.TIME_LIMIT
    assert len(found.active_sets) >= len(whole.active_sets)


def test_where_fewer_rows_lead_to_no_region_all_are_explored(touched, monkeypatch):
    qp = scale_qp(touched[0], scale_parameters(touched[1], 2))
    begin = Search.begin
    tried = []

    def begin_once(search, known, deadline):
        return begin(search) if len(search.qp.M) == len(qp.M) else tried.append(search)

    monkeypatch.setattr(Search, "begin", begin_once)
    found = explore_compiled(qp, 1000, np.inf)
    assert found.status is MPQPStatus.COMPLETE
    assert len(tried) == 1
    assert len(found.active_sets) >= 31


def test_a_law_without_regions_is_refused_for_the_true_reason():
    mpc = random_plant(3)
    far = box(np.ones(mpc.nx))
    far.b = far.b + 1e3 * far.A[:, 0]
    nothing = solve_mpqp(mpc.build(), far)
    for status, reason in ((MPQPStatus.INFEASIBLE, "explain"), (MPQPStatus.TIME_LIMIT, "Stopped at `time_limit`")):
        with pytest.raises(InfeasibleError, match=reason):
            ExplicitMPC.from_partition(replace(nothing, status=status))


def test_the_second_look_takes_place_when_memory_is_nearly_full():
    mpc = LinearMPC(*double_integrator(), Q=np.eye(2), R=[[0.1]], horizon=5, X=box([5, 5]), U=box([1]))
    search = Search(scaled(mpc))
    search.begin()
    while search.done < search.queued:
        search.advance(1000)
    graph = search.graph
    full = int(graph.counts[KNOWN]) + 1
    search.graph = graph._replace(masks=graph.masks[:full], kinds=graph.kinds[:full], queue=graph.queue[:full])
    asked = []
    seed = search.seed
    search.seed = lambda targets: asked.append(len(targets)) or seed(targets)
    assert not search.look_around(np.inf)
    assert asked == [4 + search.done // 8]
    assert len(search.graph.masks) > full


def test_a_search_that_is_late_before_the_second_look_is_not_complete(monkeypatch):
    clock = iter([0.0] * 2 + [1e9] * 10_000)  # the first portion begins in time and ends late
    monkeypatch.setattr(exploration, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    mpc = LinearMPC(*double_integrator(), Q=np.eye(2), R=[[0.1]], horizon=2, X=box([5, 5]), U=box([1]))
    found = explore_compiled(scaled(mpc), 1000, 1.0)
    assert found.status is MPQPStatus.TIME_LIMIT
    assert len(found.active_sets) == 9
