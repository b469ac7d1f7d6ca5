"""The box of designs."""

import numpy as np
import pytest

from ccdtools import CCDError, DesignSpace, InputError


@pytest.fixture
def space():
    return DesignSpace(["k", "c"], [1e4, 500], [4e4, 3000], ["N/m", "N·s/m"])


def test_the_unit_box_and_back_is_the_identity(space, rng):
    p = space.latin_hypercube(50, rng)
    np.testing.assert_allclose(space.from_unit(space.to_unit(p)), p, rtol=1e-14)
    np.testing.assert_array_equal(space.to_unit([1e4, 3000]), [0, 1])


def test_points_outside_the_unit_box_are_clipped_to_the_bounds(space):
    np.testing.assert_array_equal(space.from_unit([[-1, 2], [1 + 1e-16, 0]]), [[1e4, 3000], [4e4, 500]])


def test_a_latin_hypercube_has_one_sample_in_every_slice(space, rng):
    v = space.to_unit(space.latin_hypercube(20, rng))
    for column in v.T:
        np.testing.assert_array_equal(np.sort(np.floor(column * 20)), np.arange(20))


def test_rounding_at_a_bound_is_forgiven_and_clipped(space):
    p = space.check([1e4 - 1e-6, 3000 + 1e-8])
    np.testing.assert_array_equal(p, [1e4, 3000])


def test_checking_copies(space):
    p = np.array([2e4, 1000.0])
    space.check(p)[0] = 0
    assert p[0] == 2e4


def test_bounds_cannot_be_changed(space):
    with pytest.raises(ValueError, match="read-only"):
        space.lower[0] = 0


def test_a_single_parameter_may_be_given_as_a_number():
    np.testing.assert_array_equal(DesignSpace(["p"], 0.5, 3).check(1.0), [1.0])


def test_active_bounds_name_the_side(space):
    assert space.active_bounds([1e4, 3000]) == {"k": "lower", "c": "upper"}
    assert space.active_bounds([1e4 + 20, 2000]) == {"k": "lower"}
    assert space.active_bounds([2e4, 2000]) == {}


def test_a_design_as_names_and_back(space):
    values = space.as_dict([2e4, 1000])
    assert values == {"k": 2e4, "c": 1000.0}
    np.testing.assert_array_equal(space.from_dict(values), [2e4, 1000])
    assert space.describe([2e4, 1000]) == "k = 20000 N/m, c = 1000 N·s/m"


def test_units_default_to_none():
    assert DesignSpace(["p"], [0], [1]).units == ("-",)
    assert DesignSpace(["p"], [0], [1]).describe([0.5]) == "p = 0.5"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: s.check([5e3, 1000]), r"design: got k = 5000, expected a value in \[10000, 40000\] N/m"),
        (lambda s: s.check([[2e4, 1000], [2e4, 9999]]), r"design: got c = 9999, expected a value in \[500, 3000\]"),
        (lambda s: s.check([2e4, np.nan], argument="p0"), "p0: got c = nan, expected a value in"),
        (lambda s: s.check([2e4]), r"design: got shape \(1,\), expected 2 values \(k, c\)"),
        (lambda s: s.check(2e4), r"design: got shape \(1,\), expected 2 values"),
        (lambda s: s.check(np.ones((2, 2, 2))), r"design: got shape \(2, 2, 2\)"),
        (lambda s: s.from_dict({"k": 2e4}), r"values: got \['k'\], expected \['c', 'k'\]"),
        (lambda s: s.from_dict({"k": 2e4, "c": 0}), "values: got c = 0"),
        (lambda s: DesignSpace(["a"], [0, 1], [1]), r"names: got \['a'\], expected 2 names"),
        (lambda s: DesignSpace(["a"], [2], [1]), r"lower, upper: got \[2, 1\] for a, expected finite lower < upper"),
        (lambda s: DesignSpace(["a"], [0], [np.inf]), "upper: got (nan|-?inf) at index"),
        (lambda s: DesignSpace(["a"], [np.nan], [1]), "lower: got (nan|-?inf) at index"),
    ],
)
def test_bad_designs_are_refused_in_one_line(space, call, message):
    with pytest.raises(InputError, match=message) as caught:
        call(space)
    assert isinstance(caught.value, CCDError)
    assert isinstance(caught.value, ValueError)
    assert "\n" not in str(caught.value)
