"""Sets as functions of the design."""

import numpy as np
from set_plants import ILLUSTRATIVE_U, ILLUSTRATIVE_X, illustrative

from invariant_sets import ParametricSet, maximal_control_invariant_set


def test_family_agrees_with_the_single_computation_at_each_design():
    family = ParametricSet(illustrative, ILLUSTRATIVE_X, ILLUSTRATIVE_U)
    for p in (0.5, 1.7, 3.0):
        single = maximal_control_invariant_set(*illustrative(p), ILLUSTRATIVE_X, ILLUSTRATIVE_U).set
        np.testing.assert_array_equal(family.at([p]).A, single.A)


def test_membership_of_a_batch_uses_the_design_of_each_sample(rng):
    family = ParametricSet(illustrative, ILLUSTRATIVE_X, ILLUSTRATIVE_U)
    x = rng.uniform([-10, -5], [5, 2], (200, 2))
    p = rng.choice([0.5, 1.0, 2.0, 3.0], (200, 1))
    expected = [family.at(pi).contains(xi) for xi, pi in zip(x, p)]
    np.testing.assert_array_equal(family.contains(x, p), expected)
    assert 0 < sum(expected) < 200


def test_a_design_is_computed_once():
    calls = []

    def matrices(p):
        calls.append(float(p[0]))
        return illustrative(p)

    family = ParametricSet(matrices, ILLUSTRATIVE_X, ILLUSTRATIVE_U)
    family.contains(np.zeros((50, 2)), np.full((50, 1), 1.25))
    family.at([1.25])
    assert calls == [1.25]
