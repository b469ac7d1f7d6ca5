"""Where a set becomes flat, a row redundant, a point outside: well below each threshold and well above it."""

import numpy as np
import pytest

from invariant_sets import AdmissibleInputs, Polytope, Status, maximal_control_invariant_set

SQUARE = np.vstack([np.eye(2), -np.eye(2)])
SLANTED = np.array([[1, 1], [-1, -1], [1, -1], [-1, 1]]) * np.sqrt(0.5)


@pytest.mark.parametrize(("half_width", "dimension"), [(2e-10, 1), (5e-9, 2)])
def test_a_slanted_strip_is_flat_below_1e_9_of_its_extent(half_width, dimension):
    assert Polytope(SLANTED, [half_width, half_width, 1, 1]).affine_dim == dimension


@pytest.mark.parametrize(("gap", "empty"), [(3e-13, False), (3e-12, True)])
def test_bounds_that_miss_one_another_by_rounding_leave_a_point(gap, empty):
    assert Polytope([[1.0], [-1.0]], [1.0, -1.0 - gap]).is_empty is empty


@pytest.mark.parametrize(("angle", "dimension"), [(3e-12, 1), (4e-11, 0)])
def test_an_equality_of_which_1e_11_is_left_depends_on_the_other(angle, dimension):
    P = Polytope(SQUARE, np.ones(4), [[1, 1], [1 + angle, 1]], [0, 0])
    assert P.affine_dim == dimension


@pytest.mark.parametrize(("depth", "rows"), [(4e-12, 4), (6e-11, 5)])
def test_a_row_that_cuts_off_less_than_1e_11_of_the_extent_is_redundant(depth, rows):
    P = Polytope(np.vstack([SQUARE, [[1, 1]]]), [1, 1, 1, 1, 2 - depth])
    assert len(P.minimal().b) == rows


@pytest.mark.parametrize(("beyond", "inside"), [(3e-10, True), (3e-9, False)])
def test_a_point_is_inside_up_to_1e_9_of_the_range_of_a_row(beyond, inside):
    P = Polytope.from_bounds([0, 0], [1, 1e3])
    assert P.contains([1 + beyond, 2.0]) == inside
    assert P.contains([0.5, 1e3 * (1 + beyond)]) == inside


def test_a_far_proposal_is_led_along_its_direction_to_a_million_half_widths():
    square = Polytope.from_bounds([-1, -1], [1, 1])
    allowed = AdmissibleInputs(np.zeros((1, 1)), np.zeros((1, 2)), Polytope.from_bounds([-1], [1]), square)
    np.testing.assert_allclose(allowed.project([0.0], [3e5, 0.3])[0], [1, 0.3], rtol=1e-6)
    np.testing.assert_allclose(allowed.project([0.0], [4e6, 0.4])[0], [1, 0.1], rtol=1e-6)


@pytest.mark.parametrize(("beyond", "unstable"), [(3e-7, False), (3e-6, True)])
def test_a_mode_that_hardly_grows_is_not_taken_for_unstable(beyond, unstable):
    wide = Polytope.from_bounds([-1e7], [1e7])
    found = maximal_control_invariant_set([[1 + beyond]], [[1.0]], X=wide, U=Polytope.from_bounds([-1.0], [1.0]))
    assert found.status is (Status.CONVERGED if unstable else Status.ITERATION_LIMIT)
    if unstable:  # at most 1/(λ − 1), which its bound says at once
        np.testing.assert_allclose(found.set.bounding_box()[1], 1 / beyond, rtol=1e-6)


@pytest.mark.parametrize(("left", "bounded"), [(2.7e-15, False), (2.4e-14, True)])
def test_a_slope_of_which_only_the_rounding_of_a_product_is_left_is_none(left, bounded):
    slab = Polytope([[1.0, 1.0], [-1.0, -1.0]], [1.0, 1.0])
    assert slab.preimage([[1.0], [left - 1.0]]).is_bounded is bounded


@pytest.mark.parametrize(("part", "rows"), [(3e-4, 4), (3e-3, 5)])
def test_a_set_that_shrinks_a_thousandfold_is_seen_anew_without_the_rows_that_are_now_far(part, rows):
    diamond = Polytope([[1, 1], [-1, 1], [1, -1], [-1, -1]], (1 - part) * np.ones(4))
    left = Polytope(np.vstack([SQUARE, [[1, 1]]]), [1, 1, 1, 1, 1.9]).pontryagin_difference(diamond)
    np.testing.assert_allclose(left.bounding_box()[1], part, rtol=1e-9)
    assert len(left.b) == rows


@pytest.mark.parametrize(("beyond", "kept"), [(3e-11, True), (3e-10, False)])
def test_a_filtered_input_leaves_its_set_by_no_more_than_1e_10_of_its_half_width(beyond, kept):
    inputs = AdmissibleInputs(
        np.zeros((1, 1)), np.zeros((1, 2)), Polytope.from_bounds([-1], [1]), Polytope(SQUARE, [1] * 4)
    )
    assert (inputs.project([0.0], [1 + beyond, 0.3])[0][0] > 1) == kept
