"""Facets that led to no region are looked across: what lies beyond is found, or the status says that it is not."""

from types import SimpleNamespace

import numpy as np
import pytest
from partitions import membership
from plants import box, double_integrator
from random_problems import closing_slab, hard_controller, nearly_parallel_rows, problem_of
from scipy.optimize import linprog

from invariant_sets import Polytope
from mpc import LinearMPC, MPQPStatus, solve_mpqp
from mpc.dense_qp import DenseQP, QPResult
from mpc.explicit import holes
from mpc.explicit.holes import Search, points_beyond
from mpc.explicit.kernels.active_sets import rehash
from mpc.explicit.kernels.data import DONE, FLAT, FULL, KNOWN, QUEUED, ROWS
from mpc.explicit.linear_programs import OnlineQP
from mpc.explicit.scaled_qp import scale_parameters, scale_qp
from mpc.plan import Residuals
from mpc.tolerances import CROSSING, THIN


@pytest.fixture
def search():
    """A search that knows every region of the double integrator."""
    mpc = LinearMPC(*double_integrator(), Q=np.eye(2), R=[[0.1]], horizon=5, X=box([5, 5]), U=box([1]))
    found = Search(scale_qp(mpc.build(), scale_parameters(mpc.X, 2)))
    found.begin()
    explore(found)
    return found


def explore(search):
    while search.done < search.queued:
        search.advance(10_000)


def forget_all_but_the_first(search):
    """Keep one region, with all its facets open, and no other active set."""
    graph, counts = search.graph, search.graph.counts
    graph.masks[0] = graph.masks[graph.queue[0]]
    graph.kinds[0], graph.queue[0], graph.table[:] = FULL, 0, -1
    counts[[KNOWN, QUEUED, DONE]] = 1
    counts[ROWS] = search.facets.offsets[1]
    search.facets.behind[: counts[ROWS]] = FLAT
    rehash(graph.masks, graph.table, 1)


def test_points_beyond_a_facet_lie_above_it_and_behind_no_other_side(search):
    rows, offsets = search.facets.rows, search.facets.offsets
    for r in range(search.done):
        own = rows[offsets[r] : offsets[r + 1]]
        for facet, (a, b) in enumerate(zip(own[:, :-1], own[:, -1])):
            for point in points_beyond(own, facet, search.qp):
                height = a @ point - b
                assert height >= 0.99 * CROSSING
                foot = point - height * a
                assert (own[:, :-1] @ foot <= own[:, -1] + 1e-12).all()


def test_every_region_is_found_from_the_open_facets_of_one(search):
    regions = set(search.found(MPQPStatus.COMPLETE).active_sets)
    forget_all_but_the_first(search)
    while search.look_across(np.inf):
        explore(search)
    assert set(search.found(MPQPStatus.COMPLETE).active_sets) == regions
    assert search.uncovered == 0


def test_facets_beyond_which_nothing_is_found_are_counted(search, monkeypatch):
    forget_all_but_the_first(search)
    monkeypatch.setattr(search, "consider", lambda act: None)
    assert not search.look_across(np.inf)
    # it borders on regions all round, and two points are looked at beyond each facet
    count = 2 * search.graph.counts[ROWS]
    assert search.found(MPQPStatus.INACCURATE).uncovered == search.uncovered == count


def test_looking_across_stops_at_the_deadline(search):
    forget_all_but_the_first(search)
    assert search.look_across(-np.inf)
    assert search.done == search.queued
    assert (search.facets.behind[: search.graph.counts[ROWS]] == FLAT).all()


def test_points_behind_facets_that_led_somewhere_lie_above_one_of_them(search):
    rows, offsets = search.facets.rows, search.facets.offsets
    points = search.behind_facets(1000)
    assert len(points) == 1000
    for point in points:
        feet = []
        for r in range(search.done):
            own = rows[offsets[r] : offsets[r + 1]]
            height = own[:, :-1] @ point - own[:, -1]
            for facet in np.flatnonzero((height >= 0.999 * CROSSING) & (height <= 0.01001)):
                foot = point - height[facet] * own[facet, :-1]
                feet.append((own[:, :-1] @ foot - own[:, -1]).max())
        assert min(feet) <= 1e-9


def hollow(search):
    """Take away a region in the middle, so that all facets around it have led to a region that is not there."""
    first, last = search.facets.offsets[:2]
    search.facets.rows[first:last, -1] = -10.0
    assert np.abs(search.facets.centres[0]).max() < 0.5


@pytest.mark.parametrize("source", ["POINTS_ANYWHERE", "POINTS_BETWEEN", "POINTS_BEHIND"])
def test_a_hole_is_seen_by_each_way_of_looking(search, monkeypatch, source):
    hollow(search)
    assert search.uncovered == 0
    for name in ("POINTS_ANYWHERE", "POINTS_BETWEEN", "POINTS_BEHIND"):
        monkeypatch.setattr(holes, name, 300 if name == source else 0)
    monkeypatch.setattr(holes, "REGIONS_PER_POINT", 10**9)
    assert not search.look_around(np.inf)
    assert search.uncovered > 0


def test_points_between_facets_are_feasible_whatever_the_compiled_solver_says(search, monkeypatch):
    hollow(search)
    monkeypatch.setattr("mpc.explicit.kernels.places.look_at", lambda qp, graph, t: np.zeros(len(t), dtype=bool))
    assert not search.look_around(np.inf)
    assert search.uncovered > 0


def test_what_is_pending_is_asked_about_the_next_time(search, monkeypatch):
    hollow(search)
    for name in ("POINTS_ANYWHERE", "POINTS_BETWEEN", "POINTS_BEHIND"):
        monkeypatch.setattr(holes, name, 0)
    monkeypatch.setattr(holes, "REGIONS_PER_POINT", 10**9)
    search.pending = np.tile(search.facets.centres[0], (40, 1))
    assert not search.look_around(np.inf)
    assert search.uncovered == 40
    assert not len(search.pending)


def test_the_second_look_keeps_its_deadline(search):
    assert search.look_around(-np.inf)
    assert search.queued == search.done


def test_a_thin_gap_is_no_hole(search):
    forget_all_but_the_first(search)
    hit, row = search.facets.hits[0], search.facets.rows[0]
    for distance, count in ((0.5 * THIN, 0), (2 * THIN, 1)):
        search.feasible = (hit + (distance + row[-1] - row[:-1] @ hit) * row[:-1])[None]
        assert search.uncovered == count


def test_a_solver_that_fails_does_not_make_a_parameter_infeasible(search, monkeypatch):
    online = OnlineQP(search.qp)
    far = QPResult(np.full(5, 1e3), np.zeros(20), Residuals(1.0, 1.0, 1.0, 1.0), False, "none")
    monkeypatch.setattr(online.solver, "solve", lambda *_, **__: far)
    assert online.at(np.zeros(2)) == ([], True)
    assert online.at(np.ones(2)) == ([], False)


def test_a_region_is_found_though_every_facet_claims_to_have_led_somewhere(search):
    regions = set(search.found(MPQPStatus.COMPLETE).active_sets)
    forget_all_but_the_first(search)
    search.facets.behind[: search.graph.counts[ROWS]] = FULL
    while search.look_around(np.inf):
        explore(search)
    assert set(search.found(MPQPStatus.COMPLETE).active_sets) == regions


def test_two_solvers_that_call_it_infeasible_without_a_proof_are_not_believed(search, monkeypatch):
    online = OnlineQP(search.qp)
    rows = len(search.qp.M)
    verdict = QPResult(np.full(5, 1e3), np.ones(rows), Residuals(1.0, 1.0, 1.0, 1.0), True, "none")
    monkeypatch.setattr(online.solver, "solve", lambda *_, **__: verdict)
    assert online.at(np.zeros(2)) == ([], True)
    assert online.at(np.ones(2)) == ([], False)


def test_a_proof_of_infeasibility_is_believed_and_costs_no_linear_program(search, monkeypatch):
    online = OnlineQP(search.qp)
    monkeypatch.setattr(online, "_has_room", lambda bounds: pytest.fail("asked though it is proven"))
    corners = np.random.default_rng(0).uniform(0.9, 1.0, size=(20, 2))
    assert all(online.at(t) == ([], False) for t in corners)


def test_no_point_is_asked_about_when_time_is_up(search):
    hollow(search)
    points = np.tile(search.facets.centres[0], (3, 1))
    search.ask_at(points, -np.inf)
    assert not len(search.feasible)
    search.ask_at(points, np.inf)
    assert len(search.feasible) == 3


def test_pending_points_are_asked_about_one_by_one_while_there_is_time(search, monkeypatch):
    hollow(search)
    ticks = iter(range(1000))
    monkeypatch.setattr(holes, "time", SimpleNamespace(perf_counter=lambda: next(ticks)))
    search.pending = np.tile(search.facets.centres[0], (100, 1))
    assert search._ask(10)  # time for one look before all of them, and for one before each of ten
    assert len(search.feasible) == 10


def test_many_rows_are_looked_at_in_portions(search):
    rows = len(search.qp.M)
    portions = list(search.portions(np.zeros((3 * (20_000 // rows) + 1, 2))))
    assert [len(part) for part in portions] == [20_000 // rows] * 3 + [1]
    assert not list(search.portions(np.zeros((0, 2))))


def test_memory_that_grows_does_not_change_the_portion(search, monkeypatch):
    portion = search.portion
    monkeypatch.setattr(search, "explore", lambda regions: None)
    search.advance(10_000)
    assert search.portion == portion


def test_the_active_sets_at_a_parameter_carry_its_optimum(search):
    online = OnlineQP(search.qp)
    for t in np.random.default_rng(0).uniform(-1, 1, size=(50, 2)):
        candidates, feasible = online.at(t)
        for act in map(list, candidates):
            d = search.qp.D @ np.append(t, 1.0)
            pull = np.linalg.solve(search.qp.gram[np.ix_(act, act)], d[act])
            assert (pull <= 1e-9).all()
            assert (search.qp.M @ (search.qp.M[act].T @ pull) <= d + 1e-7).all()
        assert bool(candidates) == feasible


@pytest.mark.parametrize("seed", [3392])  # an input almost without weight: Gram eigenvalues of 1e-10 to 1e-14
def test_a_partition_with_a_hole_does_not_call_itself_complete(seed):
    mpc, _ = hard_controller(np.random.default_rng(seed), "degenerate")
    problem = mpc.build()
    partition = solve_mpqp(problem, mpc.X)
    theta = np.random.default_rng(1).uniform(-1, 1, size=(300, problem.nt)) * partition.half + partition.centre
    online = DenseQP(problem.H, problem.G)
    feasible = np.array([not online.solve(*problem.at(t)).infeasible for t in theta])
    hole = feasible & (membership(partition, theta).min(axis=1) > 1e-6)
    assert hole.mean() < 0.01  # what is left are slivers
    assert partition.uncovered > 0 or not hole.any()
    assert partition.status is (MPQPStatus.INACCURATE if partition.uncovered else MPQPStatus.COMPLETE)


@pytest.mark.parametrize("gap", [1e-5, 1e-6, 1e-7])
@pytest.mark.parametrize("reach", [1.0, 10.0, 100.0])
def test_a_slab_that_opens_far_away_leaves_no_hole_unsaid(gap, reach):
    """z1 <= gap reach θ and z1 + gap z2 >= 0: every θ is feasible, with z2 <= 1000 it needs z2 >= -reach θ."""
    G = np.array([[1.0, 0.0], [-1.0, -gap], [0.0, 1.0], [0.0, -1.0]])
    S = np.array([[gap * reach], [0.0], [0.0], [0.0]])
    problem = problem_of(np.eye(2), np.zeros((2, 1)), np.zeros(2), G, np.array([0.0, 0.0, 1e3, 1e3]), S)
    partition = solve_mpqp(problem, Polytope.from_bounds([-1.0], [1.0]))
    inside = membership(partition, np.linspace(-1, 1, 41)[:, None]).min(axis=1) <= THIN
    assert partition.status is (MPQPStatus.COMPLETE if inside.all() else MPQPStatus.INACCURATE)


@pytest.mark.long
@pytest.mark.quick(10)
@pytest.mark.parametrize("seed", [17, 30, 89, 96, 115, 162, 174, 194, 0, 1, 2, 3])
def test_slabs_that_close_with_the_parameter_leave_no_hole_unsaid(seed):
    problem = closing_slab(seed)
    ones = np.ones(problem.nt)
    partition = solve_mpqp(problem, Polytope.from_bounds(-2 * ones, 2 * ones))
    theta = np.random.default_rng(seed).uniform(-2, 2, size=(200, problem.nt))
    apart = theta if not len(partition) else theta[membership(partition, theta).min(axis=1) > THIN]
    if partition.status is not MPQPStatus.INACCURATE:
        assert not online_feasible(problem, apart).any()


@pytest.mark.parametrize(("weight", "status"), [(1e-6, MPQPStatus.COMPLETE), (1e-9, MPQPStatus.INACCURATE)])
def test_a_linear_program_but_for_its_last_digits_says_so(weight, status):
    one = np.ones((1, 1))
    problem = problem_of(weight * one, one, np.zeros(1), np.array([[1.0], [-1.0]]), np.ones(2), np.zeros((2, 1)))
    partition = solve_mpqp(problem, Polytope.from_bounds([-1.0], [1.0]))
    assert partition.status is status
    assert "Raise the smallest weights" in MPQPStatus.INACCURATE.advice


def online_feasible(problem, theta):
    """Which parameters are feasible with room, by linear programs, with variables of at most a thousand."""
    cost = np.zeros(problem.nz)
    room = [linprog(cost, problem.G, problem.w + problem.S @ t - 1e-5, bounds=(-1e3, 1e3)) for t in theta]
    return np.array([program.status == 0 for program in room])


@pytest.mark.long
@pytest.mark.quick(10)
@pytest.mark.parametrize(
    ("seed", "opposite"),
    [*((seed, False) for seed in (73, 357, 1134, 1569, 1721, 1781, 3156, 3773, 580, 3660)),
     *((seed, True) for seed in (53, 166, 226, 401, 590, 805, 867, 994, 9280))],
)  # fmt: skip
def test_nearly_parallel_rows_leave_no_hole_unsaid(seed, opposite):
    problem = nearly_parallel_rows(seed, opposite=opposite)
    ones = np.ones(problem.nt)
    partition = solve_mpqp(problem, Polytope.from_bounds(-2 * ones, 2 * ones))
    theta = np.random.default_rng(seed).uniform(-2, 2, size=(200, problem.nt))
    apart = theta if not len(partition) else theta[membership(partition, theta).min(axis=1) > THIN]
    hole = online_feasible(problem, apart).any()
    assert (partition.uncovered > 0) is (partition.status is MPQPStatus.INACCURATE)
    assert partition.status is (MPQPStatus.INACCURATE if hole else MPQPStatus.COMPLETE)
