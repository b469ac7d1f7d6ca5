"""What test_polytope.py claims, seen from inside."""

import pickle

import numpy as np
import pytest

from invariant_sets import Polytope, linear_programs
from invariant_sets.hulls import extreme_points, hull_volume


def test_both_ways_to_a_volume_agree(rng):
    for _ in range(5):
        A = rng.standard_normal((15, 5))
        P = Polytope(np.vstack([A, np.eye(5), -np.eye(5)]), np.concatenate([np.ones(15), np.full(10, 2.0)]))
        assert P.volume == pytest.approx(hull_volume(P.vertices), rel=1e-9)


def test_points_that_are_one_within_their_doubt_keep_one_vertex():
    square = np.vstack([np.eye(2), -np.eye(2)])
    near = np.array([[0.0, 0.0], [1e-7, 0.0], [0.0, 1e-7]])
    assert len(extreme_points(near, square, np.ones(4), 1e-6)) == 1  # SciPy's nnls without columns ends the process


@pytest.mark.parametrize("closed", [True, False], ids=["bounded", "unbounded"])
def test_a_tightening_that_leaves_room_needs_the_support_alone_and_says_the_rest_when_asked(closed, rng, monkeypatch):
    programs = []
    solve = linear_programs.daqp.solve
    monkeypatch.setattr(linear_programs.daqp, "solve", lambda *a, **k: programs.append(a) or solve(*a, **k))
    A = np.vstack([rng.standard_normal((8, 3)), np.eye(3), -np.eye(3)])
    A = A if closed else A[A[:, 2] >= 0]
    P = Polytope(A, np.ones(len(A))).affine_map(np.eye(3), [1e6, -1e6, 1e6])
    Q = Polytope.from_vertices(0.1 * rng.standard_normal((6, 3)))
    assert P.is_bounded is closed
    programs.clear()
    D = P.pontryagin_difference(Q)
    tightening = len(programs)
    assert tightening <= (0 if closed else len(A))
    twin = pickle.loads(pickle.dumps(D))
    X = np.array([1e6, -1e6, 1e6]) + rng.uniform(-1.0, 1.0, (200, 3))
    inside = np.all([P.contains(X + v) for v in Q.vertices], axis=0)
    assert inside.any()
    assert np.array_equal(D.contains(X), inside)
    assert len(programs) > tightening
    assert twin.equals(D, 1e-12)
