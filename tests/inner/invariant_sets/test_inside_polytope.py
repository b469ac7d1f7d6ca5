"""What test_polytope.py claims, seen from inside."""


import numpy as np
import pytest

from invariant_sets import Polytope
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
