"""How far outside X, beside how often: claims about units, facets and pairs."""

import numpy as np
import pytest

from ccdtools import InputError, depth_outside, excursions
from invariant_sets import Polytope

BOX = Polytope.from_bounds([-1.0, -0.5], [3.0, 0.5])  # half-widths 2 and 0.5
ROTATED = Polytope([[1, 1], [-1, -1], [1, -1], [-1, 1.0]], [1, 1, 2, 2])


def test_depth_is_the_largest_violation_in_half_widths():
    np.testing.assert_allclose(depth_outside([[0, 0], [5, 0], [-2, 1.5], [3, -1.0]], BOX), [0, 1, 2, 1])


@pytest.mark.parametrize("X", [BOX, ROTATED])
def test_depth_does_not_depend_on_units(X, rng):
    x = rng.uniform(-4, 4, (50, 2))
    s = np.array([1e-6, 1e7])
    np.testing.assert_allclose(depth_outside(x * s, Polytope(X.A / s, X.b)), depth_outside(x, X), rtol=1e-9)


def test_depth_is_the_inflation_of_a_symmetric_set_that_reaches_the_state(rng):
    x = rng.uniform(-4, 4, (200, 2))
    gauge = np.abs(x @ ROTATED.A[::2].T / ROTATED.b[::2]).max(axis=1)  # x lies on the boundary of gauge · X
    np.testing.assert_allclose(depth_outside(x, ROTATED), np.maximum(gauge - 1, 0), atol=1e-12)


def test_depth_is_zero_wherever_X_says_it_contains_the_state():
    edge = np.array([[3.0 + 1e-10, 0.0], [3.0, 0.5 + 1e-11], [3.0 + 1e-6, 0.0]])
    np.testing.assert_array_equal(depth_outside(edge, BOX) > 0, ~BOX.contains(edge))


def test_redundant_and_scaled_rows_change_nothing(rng):
    x = rng.uniform(-4, 4, (50, 2))
    padded = Polytope(np.vstack([BOX.A * 7, [[1, 1], [1.0, 0]]]), np.r_[BOX.b * 7, 3.5, 9])
    np.testing.assert_allclose(depth_outside(x, padded), depth_outside(x, BOX), atol=1e-12)


def test_one_sided_limits_are_measured_by_their_distance_from_zero():
    np.testing.assert_allclose(depth_outside([[5.0, 100.0]], Polytope([[1.0, 0.0]], [2.0])), [1.5])


def test_a_state_that_is_no_number_is_infinitely_far_outside():
    assert depth_outside([np.nan, 0.0], BOX) == np.inf


def test_excursions_are_per_run_and_name_what_is_exceeded_most():
    states = np.array([[[0, 0], [4, 0], [0, 0.6], [0, 0]], [[0, 0.0]] * 4])
    found = excursions(states, BOX, names=["position [m]", "speed [m/s]"])
    np.testing.assert_allclose(found.fraction, [0.5, 0])
    np.testing.assert_allclose(found.peak, [0.5, 0])
    np.testing.assert_allclose(found.mean, [(0.5 + 0.2) / 4, 0])
    assert found.exceeded == "position [m] > 3"
    assert "25.00% of the states outside X" in repr(found)
    assert excursions([[0, -0.75]], BOX).exceeded == "x2 < -0.5"
    assert excursions([[2, -2.0]], ROTATED).exceeded == "x1 − x2 > 2"
    assert excursions([[0, 0.0]], BOX).exceeded == ""


def test_no_runs_have_no_excursions():
    assert len(excursions(np.zeros((0, 5, 2)), BOX).peak) == 0


@pytest.mark.parametrize(
    ("x", "X", "message"),
    [([0.0], BOX, r"x: got shape \(1,\), expected \(..., 2\), the states of X"),
     (["a", "b"], BOX, "x: got"),
     ([0.0, 0.0], Polytope([[1.0, 0], [-1, 0]], [-1, -1]), "X: got an empty set"),
     ([0.0, 0.0], "box", "X: got 'box', expected a Polytope")],
)  # fmt: skip
def test_wrong_arguments_are_named(x, X, message):
    with pytest.raises(InputError, match=message):
        depth_outside(x, X)
