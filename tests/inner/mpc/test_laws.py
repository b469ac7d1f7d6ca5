"""No law is handed out that does not hold where it is used: nearly dependent rows, and the check of every law."""

from dataclasses import replace

import numpy as np
import pytest
from partitions import membership
from plants import box, double_integrator
from scipy.optimize import linprog

from invariant_sets import Polytope
from mpc import Constraint, ExplicitMPC, LinearMPC, MPQPStatus, ParametricQP, solve_mpqp
from mpc.explicit.exploration import explore_compiled
from mpc.explicit.holes import Search
from mpc.explicit.kernels.data import DEPENDENT, FULL, QPData
from mpc.explicit.mpqp import _is_thin, _without_wrong_laws, checked_laws, in_units
from mpc.explicit.scaled_qp import scale_parameters, scale_qp

UNLIMITED = 10_000, np.inf


def uneven_controller(seed):
    """Weights of the inputs, and units, that differ by up to ten powers of ten: nearly dependent active rows."""
    rng = np.random.default_rng(seed)
    nx, nu, N = int(rng.integers(2, 4)), int(rng.integers(1, 4)), int(rng.integers(2, 8))
    A = rng.normal(size=(nx, nx))
    A *= rng.uniform(0.6, 1.3) / np.abs(np.linalg.eigvals(A)).max()
    B = rng.normal(size=(nx, nu))
    R = np.diag(10.0 ** rng.uniform(-9, 1, nu))
    u = 10.0 ** rng.uniform(-2, 3, nu)
    x = 5 * 10.0 ** rng.uniform(-2, 3, nx)
    Q = np.diag(1 / x**2) * 10 ** rng.uniform(-3, 3)
    return LinearMPC(A, B, Q=Q, R=R / u**2, horizon=N, X=box(x), U=box(u))


def with_sum_of_active_rows(problem, partition):
    """The problem and one row more, the sum of two that are active together: it changes nothing."""
    i, j = next(act for act in partition.active_sets if len(act) >= 2)[:2]
    G, w, S = (
        np.concatenate([a, a[[i]] / problem.w[i] + a[[j]] / problem.w[j]]) for a in (problem.G, problem.w, problem.S)
    )
    return replace(problem, G=G, w=w, S=S, labels=(*problem.labels, problem.labels[0]))


def is_feasible(problem, theta):
    size = 1 / np.abs(problem.G).max(axis=0)
    rows = problem.G * size / problem.w[:, None]
    bounds = problem.at(theta)[1] / problem.w
    return linprog(np.zeros(problem.nz), A_ub=rows, b_ub=bounds, bounds=(None, None)).status == 0


@pytest.mark.parametrize("added", [False, True])
@pytest.mark.parametrize("seed", [5707, 5662, 7405, 5536, 9001, 9002])
def test_every_law_of_uneven_weights_keeps_the_limits_in_its_region(seed, added):
    mpc = uneven_controller(seed)
    problem = mpc.build()
    partition = solve_mpqp(problem, mpc.X)
    if added:
        problem = with_sum_of_active_rows(problem, partition)
        partition = solve_mpqp(problem, mpc.X)
    assert partition.status is MPQPStatus.COMPLETE
    theta = partition.centre + partition.half * np.random.default_rng(0).uniform(-1, 1, size=(60, problem.nt))
    for t, row in zip(theta, membership(partition, theta)):
        if row.min() <= 1e-7:
            z = partition.law[row.argmin()] @ np.append(t, 1.0)
            assert ((problem.G @ z - problem.at(t)[1]) / problem.w).max() <= 1e-6
        elif row.min() > 1e-5:
            assert not is_feasible(problem, t)


def kahan(n, cosine):
    """Unit rows, triangular, with large pivots and a tiny singular value (Kahan, 1966)."""
    sine = np.sqrt(1 - cosine**2)
    return ((np.eye(n) - cosine * np.triu(np.ones((n, n)), 1)) * sine ** np.arange(n)[:, None]).T


@pytest.mark.parametrize(("size", "kind"), [(40, DEPENDENT), (10, FULL)])
def test_dependent_rows_are_seen_in_any_order_where_no_pivot_is_small(size, kind):
    from mpc.explicit.kernels.region import region_rows

    M = kahan(size, 0.436)
    assert np.linalg.qr(M.T)[1].diagonal().__abs__().min() > 1e-2  # no pivot is small
    assert (np.linalg.svd(M)[1][-1] < 1e-6) == (kind == DEPENDENT)
    D = np.hstack([np.ones((size, 1)), -10 * np.ones((size, 1))])
    order = np.random.default_rng(0).permutation(size)
    for rows in (np.arange(size), order, order[::-1].copy()):
        data = QPData(M[rows], D, np.ones(size), M[rows] @ M[rows].T, np.array([[1.0], [-1.0]]), np.ones(2))
        A, b = np.empty((size + 2, 1)), np.empty(size + 2)
        found = region_rows(data, np.arange(size), size, A, b)
        assert (found == DEPENDENT) == (kind == DEPENDENT)


@pytest.mark.parametrize(("apart", "kind"), [(3e-13, DEPENDENT), (3e-12, FULL)])
def test_two_rows_depend_on_each_other_where_their_distance_is_rounding(apart, kind):
    from mpc.explicit.kernels.region import region_rows

    M = np.array([[1.0, 0.0], [np.sqrt(1 - apart), np.sqrt(apart)]])  # apart is the squared distance
    D = np.array([[1.0, -10.0], [2.0, -10.0]])
    data = QPData(M, D, np.ones(2), M @ M.T, np.array([[1.0], [-1.0]]), np.ones(2))
    found = region_rows(data, np.arange(2), 2, np.empty((4, 1)), np.empty(4))
    assert (found == DEPENDENT) == (kind == DEPENDENT)


@pytest.fixture(scope="module")
def explored():
    mpc = LinearMPC(*double_integrator(), Q=np.eye(2), R=[[0.1]], horizon=5, X=box([5, 5]), U=box([1]))
    qp = scale_qp(mpc.build(), scale_parameters(mpc.X, 2))
    found = explore_compiled(qp, *UNLIMITED)
    return found.qp, found


def test_a_law_is_accepted_in_its_own_region_only(explored):
    qp, found = explored
    assert checked_laws(qp, found.active_sets, found.centres)[1].all()
    elsewhere = np.roll(found.centres, 1, axis=0)
    assert not checked_laws(qp, found.active_sets, elsewhere)[1].any()


def test_a_law_meets_its_rows_although_their_gram_matrix_is_nearly_singular(explored):
    qp, _ = explored
    tilt = 3e-5  # of two rows: their gram matrix loses nine digits
    n = qp.M.shape[1]
    M = np.vstack([np.eye(n)[0], np.cos(tilt) * np.eye(n)[0] + np.sin(tilt) * np.eye(n)[1]])
    D = np.array([[0.3, 0.1, 0.7], [0.3, 0.1, 0.7 + 1e-5]])
    pair = replace(qp, M=M, D=D, gram=M @ M.T, origin=np.arange(2))
    law = checked_laws(pair, [(0, 1)], np.zeros((1, 2)))[0][0]
    np.testing.assert_allclose(M @ law, D, atol=1e-14)


def test_a_region_whose_law_does_not_hold_is_left_out_and_the_status_says_so(explored):
    qp, found = explored
    centres = found.centres.copy()
    centres[3] = found.centres[4]
    kept, law = _without_wrong_laws(qp, found._replace(centres=centres))
    assert kept.status is MPQPStatus.INACCURATE
    assert kept.active_sets == [act for r, act in enumerate(found.active_sets) if r != 3]
    assert len(law) == len(kept.centres) == len(kept.offsets) - 1 == len(found.active_sets) - 1
    facets = [found.rows[a:b] for r, (a, b) in enumerate(zip(found.offsets[:-1], found.offsets[1:])) if r != 3]
    np.testing.assert_array_equal(kept.rows, np.vstack(facets))
    assert in_units(qp, law).shape == (len(law), qp.back.shape[0], 3)


def test_only_a_region_that_holds_a_small_ball_alone_is_thin(explored):
    _, found = explored
    assert not any(_is_thin(found, r) for r in range(len(found.active_sets)))
    narrow = found.rows.copy()
    own = slice(found.offsets[3], found.offsets[4])
    for room, thin in ((5e-7, True), (2e-6, False), (-1e-3, False)):
        narrow[own, -1] = narrow[own, :-1] @ found.centres[3] + room
        assert _is_thin(found._replace(rows=narrow), 3) is thin


def test_a_feasible_parameter_in_no_region_is_reported(explored):
    qp, found = explored
    search = Search(qp)
    search.begin()
    while search.done < search.queued:
        search.advance(10_000)
    search.feasible = np.vstack([found.centres[7], [0.99, 0.99]])
    assert search.uncovered == 1


def test_a_row_that_gives_up_its_slack_for_others_is_no_implied_equality():
    """z1 = z2 = 0 is implied; 0 <= z3 is not, but two other rows gain more slack at z3 = 0 than it loses there."""
    G = np.array([[1, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, -1], [1, 0, 1], [0, 1, 1]], dtype=float)
    problem = ParametricQP(
        H=np.eye(3), F=np.array([[0.0], [0.0], [-1.0]]), f=np.zeros(3), Y=np.zeros((1, 1)), y=np.zeros(1), c=0.0, G=G,
        w=np.array([0, 0, 0, 0, 0.01, 0.01]), S=np.zeros((6, 1)), Lz=np.eye(3), Lt=np.zeros((3, 1)), l=np.zeros(3),
        Xz=np.zeros((1, 3)), Xt=np.eye(1), x=np.zeros(1), nu=3, parameters=(("x", 1),),
        labels=tuple(Constraint("input", 0, i) for i in range(6)),
    )  # fmt: skip
    partition = solve_mpqp(problem, Polytope.from_bounds([-0.2], [0.2]))
    assert partition.status is MPQPStatus.COMPLETE
    explicit = ExplicitMPC.from_partition(partition, method="sequential")
    for theta in np.linspace(-0.19, 0.19, 20):
        law = partition.law[int(explicit.locate([theta]))]
        np.testing.assert_allclose(law @ [theta, 1.0], [0.0, 0.0, np.clip(theta, 0.0, 0.01)], atol=1e-9)
