"""Sets of states, inputs and disturbances may be given by their bounds (lower, upper)."""

import numpy as np
import pytest

from invariant_sets import (
    AdmissibleInputs,
    ParametricSet,
    Polytope,
    controllable_set,
    maximal_control_invariant_set,
    maximal_positively_invariant_set,
    minimal_robust_positively_invariant_set,
    predecessor_set,
    reachable_set,
)
from invariant_sets.exceptions import InputError

A = np.array([[0.8, 0.5], [0.5, 0.6]])
B = np.array([[0.5], [1.0]])
STABLE = A - B @ np.array([[0.4, 0.5]])
X = ([-10.0, -5.0], [5.0, 2.0])
U = (-1, 1)
W = (-0.01, 0.01)
TARGET = (-0.5, [0.5, 0.4])

CALLS = {
    "control invariant": (maximal_control_invariant_set, (A, B), {"X": X, "U": U, "W": W}),
    "positively invariant": (maximal_positively_invariant_set, (STABLE,), {"X": X, "W": W}),
    "positively invariant, of outputs": (
        maximal_positively_invariant_set,
        (STABLE,),
        {"C": np.array([[1.0, 1.0]]), "X": (-1, 2)},
    ),
    "minimal robust": (minimal_robust_positively_invariant_set, (STABLE,), {"W": W}),
    "predecessor": (predecessor_set, (A, B), {"S": TARGET, "U": U, "X": X, "W": W}),
    "controllable": (controllable_set, (A, B), {"X": X, "U": U, "target": TARGET, "steps": 3}),
    "reachable": (reachable_set, (A, B), {"start": TARGET, "U": U, "steps": 2, "X": X, "W": W}),
}
SETS = {"X": 2, "U": 1, "W": 2, "S": 2, "target": 2, "start": 2}


def box(bounds, n):
    """The box of bounds, each a number or one number a coordinate."""
    return Polytope.from_bounds(*(np.broadcast_to(np.asarray(side, float), (n,)) for side in bounds))


@pytest.mark.parametrize("name", CALLS)
def test_bounds_give_the_set_that_their_box_gives(name):
    function, plant, arguments = CALLS[name]
    sizes = SETS if "C" not in arguments else {"X": 1}
    boxes = {key: box(value, sizes[key]) if key in sizes else value for key, value in arguments.items()}
    by_bounds = function(*plant, **arguments)
    by_boxes = function(*plant, **boxes)
    assert by_bounds.status is by_boxes.status
    assert np.array_equal(by_bounds.set.A, by_boxes.set.A)
    assert np.array_equal(by_bounds.set.b, by_boxes.set.b)
    assert not by_bounds.set.is_empty


def test_a_filter_and_a_family_take_bounds():
    filtered = AdmissibleInputs(A, B, X, U, W=list(W))
    expected = AdmissibleInputs(A, B, box(X, 2), box(U, 1), W=box(W, 2))
    assert filtered.project([2.0, 1.0], [3.0]) == expected.project([2.0, 1.0], [3.0])
    family = ParametricSet(lambda p: (A, B * p), X, U)
    assert isinstance(family.X, Polytope)
    assert family.at([1.0]).equals(maximal_control_invariant_set(A, B, X, U).set)


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        ((1, -1), r"U\[0\]: got 1 above upper, -1, at index 0, expected lower <= upper"),
        ((-1, [1, 2]), r"U\[1\]: got shape \(2,\), expected a number"),
        ((-1, np.nan), r"U\[1\]: got nan at index .*, expected finite numbers"),
        ((np.inf, np.inf), r"U\[0\]: got an infinite bound that excludes every point"),
        ((-1, "one"), r"U\[1\]: got 'one', expected an array of real numbers"),
        ((-1, np.eye(2)), r"U\[1\]: got shape \(2, 2\), expected a number"),
        ((-1, 0, 1), r"U: got \(-1, 0, 1\), expected a Polytope or bounds \(lower, upper\)"),
        ((False, True), r"U\[0\]: got False, expected an array of real numbers, not True or False"),
        ((-1, [True]), r"U\[1\]: got \[True\], expected an array of real numbers, not True or False"),
        ((-1, np.array([True])), r"U\[1\]: got .*True.*, expected an array of real numbers, not True or False"),
        (1.0, r"U: got 1.0, expected a Polytope or bounds \(lower, upper\)"),
        (([], []), r"U\[0\]: got shape \(0,\), expected a number"),
    ],
)
def test_wrong_bounds_are_refused_by_name_and_side(bounds, message):
    with pytest.raises(InputError, match=message):
        maximal_control_invariant_set(A, B, X, bounds)


def test_bounds_of_a_family_say_how_many_coordinates_there_are():
    with pytest.raises(InputError, match=r"X: got a set of dimension 1, expected dimension 2"):
        ParametricSet(lambda p: (A, B), ([-1], [1]), U).at([1.0])
    with pytest.raises(InputError, match=r"X\[1\]: got shape \(2,\), expected a number or 3 numbers"):
        ParametricSet(lambda p: (A, B), ([-1, -1, -1], [1, 1]), U)
    with pytest.raises(InputError, match=r"X\[0\]: got no bounds"):
        ParametricSet(lambda p: (A, B), ([], []), U)


def test_a_number_holds_for_every_coordinate_of_a_family_as_of_a_single_set(rng):
    family = ParametricSet(lambda p: (A, B * p), (-1, 1), U, W=(-0.01, 0.01))
    single = maximal_control_invariant_set(A, B, (-1, 1), U, W=(-0.01, 0.01)).set
    assert family.at([1.0]).dim == 2
    assert family.at([1.0]).equals(single)
    assert family.contains(np.zeros((3, 2)), [1.0]).all()
    assert family.contains([0.0, 0.0], [1.0])
    assert family.sample([[1.0], [0.9]], 4, rng=rng).shape == (2, 4, 2)
    assert "nx=any" in repr(family)
    with pytest.raises(InputError, match=r"x: got shape \(3,\), expected \(2,\)"):
        family.contains([0.0, 0.0, 0.0], [1.0])
    with pytest.raises(InputError, match=r"p: got no designs"):
        family.contains([0.0, 0.0], np.zeros((0, 1)))
    with pytest.raises(InputError, match=r"X\[0\]: got 1 above upper"):
        ParametricSet(lambda p: (A, B), (1, -1), U)


def test_truths_are_no_bounds_of_a_box():
    with pytest.raises(InputError, match=r"lower: got False, expected an array of real numbers"):
        Polytope.from_bounds(False, True)
    with pytest.raises(InputError, match=r"upper: got \[1.0, True\], expected an array of real numbers"):
        Polytope.from_bounds([0.0, 0.0], [1.0, True])
