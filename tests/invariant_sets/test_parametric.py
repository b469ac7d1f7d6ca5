"""Sets as functions of the design."""

import numpy as np
import pytest
from set_plants import ILLUSTRATIVE_U, ILLUSTRATIVE_X, SUSPENSION_U, SUSPENSION_X, illustrative, suspension

from invariant_sets import InputError, ParametricSet, Polytope, maximal_control_invariant_set

box = Polytope.from_bounds


@pytest.fixture
def family():
    return ParametricSet(illustrative, ILLUSTRATIVE_X, ILLUSTRATIVE_U)


def slow(p):
    """Two unstable modes against tight constraints: dozens of steps each."""
    return np.array([[1.2, 0], [0, p[0]]]), np.array([[1.0], [1.0]])


def test_family_agrees_with_the_single_computation_at_each_design(family):
    for p in (0.5, 1.7, 3.0):
        single = maximal_control_invariant_set(*illustrative(p), ILLUSTRATIVE_X, ILLUSTRATIVE_U).set
        np.testing.assert_array_equal(family.at([p]).A, single.A)


def test_membership_of_a_batch_uses_the_design_of_each_sample(family, rng):
    x = rng.uniform([-10, -5], [5, 2], (200, 2))
    p = rng.choice([0.5, 1.0, 2.0, 3.0], (200, 1))
    expected = [family.at(pi).contains(xi) for xi, pi in zip(x, p)]
    np.testing.assert_array_equal(family.contains(x, p), expected)
    assert 0 < sum(expected) < 200


def test_membership_of_one_state_one_design_and_no_states(family):
    assert family.contains([0.0, 0.0], [1.0]) is True
    assert family.contains([[0.0, 0.0], [np.nan, 0.0]], [1.0]).tolist() == [True, False]
    assert family.contains(np.zeros((0, 2)), np.zeros((0, 1))).shape == (0,)


def test_a_design_is_computed_once():
    calls = []

    def matrices(p):
        calls.append(float(p[0]))
        return illustrative(p)

    family = ParametricSet(matrices, ILLUSTRATIVE_X, ILLUSTRATIVE_U)
    family.contains(np.zeros((50, 2)), np.full((50, 1), 1.25))
    family.at([1.25])
    assert calls == [1.25]


def test_warm_start_takes_fewer_steps_to_the_same_set():
    X, U = box([-1, -1], [1, 1]), box([-1], [1])
    warm, cold = (ParametricSet(slow, X, U, warm_start=flag) for flag in (True, False))
    for p in (1.5, 1.501, 1.4995, 1.52):
        assert warm.at([p]).equals(cold.at([p]), 1e-8)
        assert warm.result([p]).certificate.holds
    steps = [[family.result([p]).iterations for p in (1.501, 1.4995)] for family in (warm, cold)]
    assert max(steps[0]) < min(steps[1])


@pytest.mark.long
def test_parallel_results_are_the_same(family):
    designs = np.linspace(0.6, 2.9, 6)[:, None]
    alone = [result.set.volume for result in family.compute(designs)]
    together = ParametricSet(illustrative, ILLUSTRATIVE_X, ILLUSTRATIVE_U).compute(designs, n_jobs=2)
    assert [result.set.volume for result in together] == alone


def test_samples_lie_in_the_set_of_their_design(family, rng):
    designs = np.array([[0.5], [1.0], [3.0]])
    x = family.sample(designs, 40, rng=rng)
    assert x.shape == (3, 40, 2)
    assert family.contains(x.reshape(-1, 2), np.repeat(designs, 40, axis=0)).all()
    assert family.sample([1.0], 5, rng=rng).shape == (5, 2)


def test_volume_gradient_of_one_mode_is_the_closed_form():
    """x+ = λx + pu, |u| <= 1: the set is |x| <= p/(λ − 1), its length 2p/(λ − 1)."""
    family = ParametricSet(lambda p: ([[p[1]]], [[p[0]]]), box([-99], [99]), box([-1], [1]))
    gradient = family.volume_gradient([2.0, 1.5])
    np.testing.assert_allclose(gradient, [2 / 0.5, -2 * 2.0 / 0.25], rtol=1e-6)


def test_volume_gradient_converges_and_predicts_the_volume(family):
    gradient = family.volume_gradient([1.3])
    assert gradient[0] == pytest.approx(family.volume_gradient([1.3], step=3e-4)[0], rel=1e-6)
    change = family.volume([1.3 + 1e-4]) - family.volume([1.3])
    assert gradient[0] == pytest.approx(change / 1e-4, rel=1e-3)
    np.testing.assert_array_equal(family.volume([[1.3], [2.0]]), [family.volume([1.3]), family.volume([2.0])])


def test_suspension_gradient_has_one_entry_a_parameter():
    family = ParametricSet(suspension, SUSPENSION_X, SUSPENSION_U)
    p = np.array([27692.0, 1906.5])
    gradient = family.volume_gradient(p)
    step = np.array([3.0, -1.0])
    assert gradient @ step == pytest.approx(family.volume(p + step) - family.volume(p), rel=1e-2)


def test_robust_family_uses_the_third_matrix():
    W = box([-0.1], [0.1])
    family = ParametricSet(lambda p: (*illustrative(p), np.array([[0.0], [p[0]]])), ILLUSTRATIVE_X, ILLUSTRATIVE_U, W=W)
    expected = maximal_control_invariant_set(*illustrative(2.0), ILLUSTRATIVE_X, ILLUSTRATIVE_U, E=[[0.0], [2.0]], W=W)
    assert family.volume([2.0]) == pytest.approx(expected.set.volume, rel=1e-12)
    assert family.volume([2.0]) < ParametricSet(illustrative, ILLUSTRATIVE_X, ILLUSTRATIVE_U).volume([2.0])


def test_a_function_that_returns_no_disturbance_set_is_not_taken_for_one_without_disturbances():
    family = ParametricSet(illustrative, ILLUSTRATIVE_X, ILLUSTRATIVE_U, W=lambda p: None)
    with pytest.raises(InputError, match="W: got NoneType"):
        family.at([2.0])


def limits_of_slow(p):
    """A box that shrinks with the design."""
    return box([-4 / p[0]] * 2, [3 / p[0]] * 2)


@pytest.mark.long
def test_constraints_that_depend_on_the_design_are_those_of_each_design():
    family = ParametricSet(slow, limits_of_slow, lambda p: ([-1.0], [0.5 * p[0]]))
    for p in (1.05, 1.3, 1.3001, 1.05001):  # neighbours may start from each other
        own = maximal_control_invariant_set(*slow([p]), limits_of_slow([p]), box([-1.0], [0.5 * p])).set
        assert family.at([p]).equals(own)
    assert family.contains([0.0, 0.0], [1.3])
    assert family.sample([1.3], 5, rng=np.random.default_rng(0)).shape == (5, 2)
    assert "any" in repr(family)


def test_two_numbers_from_a_function_bound_every_coordinate():
    family = ParametricSet(slow, lambda p: (-2.0, 2.0), lambda p: (-1.0, 1.0))
    assert family.at([1.1]).equals(ParametricSet(slow, (-2.0, 2.0), (-1.0, 1.0)).at([1.1]))
