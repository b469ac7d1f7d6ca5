"""One table of inputs × every public function: misuse raises and names the argument."""

import inspect

import numpy as np
import pytest
from set_plants import ILLUSTRATIVE_U, ILLUSTRATIVE_X, STABLE, A, B, U, W, X, illustrative

import invariant_sets
from invariant_sets import (
    AdmissibleInputFamily,
    AdmissibleInputs,
    InvariantSetsError,
    ParametricSet,
    Polytope,
    controllable_set,
    maximal_control_invariant_set,
    maximal_positively_invariant_set,
    minimal_robust_positively_invariant_set,
    plot_family,
    plot_polytope,
    predecessor_set,
    reachable_set,
)

box = Polytope.from_bounds
P = Polytope.from_vertices([[0, 0], [2, 0], [0, 1]])
RNG = np.random.default_rng(1)
FILTER = AdmissibleInputs(A, B, X, U)
FAMILY = ParametricSet(illustrative, ILLUSTRATIVE_X, ILLUSTRATIVE_U)

dynamics = {"A": A, "B": B}
robust = {"E": np.eye(2), "W": W}

# function, its good arguments; the name of an argument says what it is
CALLS = {
    "Polytope": (Polytope, {"A": np.eye(2), "b": np.ones(2), "A_eq": np.ones((1, 2)), "b_eq": np.ones(1)}),
    "from_bounds": (Polytope.from_bounds, {"lower": np.zeros(2), "upper": np.ones(2)}),
    "from_vertices": (Polytope.from_vertices, {"V": P.vertices}),
    "contains": (P.contains, {"x": np.zeros((3, 2)), "tol": 1e-9}),
    "support": (P.support, {"d": np.ones((3, 2))}),
    "is_subset": (P.is_subset, {"other": P, "tol": 1e-9}),
    "equals": (P.equals, {"other": P, "tol": 1e-9}),
    "intersection": (P.intersection, {"other": P}),
    "cartesian_product": (P.cartesian_product, {"other": P}),
    "minkowski_sum": (P.minkowski_sum, {"other": P}),
    "pontryagin_difference": (P.pontryagin_difference, {"other": P}),
    "affine_map": (P.affine_map, {"M": np.eye(2), "c": np.ones(2)}),
    "preimage": (P.preimage, {"M": np.eye(2), "c": np.ones(2)}),
    "projection": (P.projection, {"coordinates": [0]}),
    "slice": (P.slice, {"coordinates": [0], "values": [0.1]}),
    "scale": (P.scale, {"factor": 2.0}),
    "sample": (P.sample, {"n": 3, "rng": RNG}),
    "control invariant": (
        maximal_control_invariant_set,
        {**dynamics, "X": X, "U": U, **robust, "tol": 1e-7, "max_iterations": 9, "max_facets": 99, "time_limit": 60.0},
    ),
    "positively invariant": (
        maximal_positively_invariant_set,
        {
            "A": STABLE,
            "X": X,
            "C": np.eye(2),
            **robust,
            "tol": 1e-7,
            "max_iterations": 9,
            "max_facets": 99,
            "time_limit": 60.0,
        },
    ),
    "minimal robust": (
        minimal_robust_positively_invariant_set,
        {"A": STABLE, "W": W, "E": np.eye(2), "eps": 0.1, "max_iterations": 99, "max_facets": 99, "time_limit": 60.0},
    ),
    "predecessor": (predecessor_set, {**dynamics, "S": X, "U": U, "X": X, **robust, "time_limit": 60}),
    "controllable": (
        controllable_set,
        {**dynamics, "X": X, "U": U, "target": X, "steps": 2, **robust, "time_limit": 60},
    ),
    "reachable": (reachable_set, {**dynamics, "start": X, "U": U, "steps": 2, "X": X, **robust, "time_limit": 60}),
    "AdmissibleInputs": (AdmissibleInputs, {**dynamics, "S": X, "U": U, **robust}),
    "AdmissibleInputFamily": (AdmissibleInputFamily, {"filters": [FILTER, FILTER]}),
    "family project": (
        AdmissibleInputFamily([FILTER] * 3).project,
        {"x": np.zeros((3, 2)), "u_proposed": np.zeros((3, 1))},
    ),
    "project": (FILTER.project, {"x": np.zeros((3, 2)), "u_proposed": np.zeros((3, 1))}),
    "admissible at": (FILTER.at, {"x": np.zeros(2)}),
    "ParametricSet": (
        ParametricSet,
        {
            "matrices": illustrative,
            "X": X,
            "U": U,
            "W": W,
            "tol": 1e-7,
            "max_iterations": 9,
            "max_facets": 99,
            "time_limit": 60.0,
        },
    ),
    "family at": (FAMILY.at, {"p": np.ones(1)}),
    "family result": (FAMILY.result, {"p": np.ones(1)}),
    "family compute": (FAMILY.compute, {"designs": np.ones((2, 1)), "n_jobs": 1}),
    "family contains": (FAMILY.contains, {"x": np.zeros((3, 2)), "p": np.ones((3, 1)), "tol": 1e-9}),
    "family sample": (FAMILY.sample, {"p": np.ones(1), "n": 2, "rng": RNG}),
    "family volume": (FAMILY.volume, {"p": np.ones(1)}),
    "family gradient": (FAMILY.volume_gradient, {"p": np.ones(1), "step": 1e-3}),
}

MATRICES = {"A", "B", "E", "C", "M", "A_eq", "V", "designs"}
VECTORS = {"b", "b_eq", "c", "values", "lower", "upper"}
POINTS = {"x", "u_proposed", "d", "p"}
SETS = {"X", "U", "W", "S", "target", "start", "other"}
TOLERANCES = {"tol", "eps", "step"}
COUNTS = {"n", "steps", "max_iterations", "max_facets"}


def spoiled(value, number):
    array = np.array(value, float)
    array.flat[-1] = number
    return array


def bad_values(name, value, function):
    """Yield (what, bad value) for an argument of a function."""
    if name in MATRICES | VECTORS | POINTS:
        if not (name == "x" and "contains" in function):  # membership of NaN is False, not an error
            yield "NaN", spoiled(value, np.nan)
            if function != "from_bounds":
                yield "infinity", spoiled(value, np.inf)
        yield "text", "abc"
        yield "complex", np.array(value, float) * 1j
        yield "ragged", [[1.0, 2.0], [3.0]]
        yield "three axes", np.zeros((2, 2, 2))
        if not (
            name in {"p", "designs", "V"}
            or (name == "lower" and function == "from_bounds")
            or (name == "M" and function == "preimage")
        ):
            yield "one too many", np.concatenate([np.array(value, float)] * 2, axis=-1)
    elif name in SETS:
        yield "an array", np.eye(2)
        yield "None", None
        if function != "cartesian_product":
            yield "wrong dimension", box(-np.ones(5), np.ones(5))
    elif name in TOLERANCES:
        yield from (("negative", -1e-9), ("NaN", np.nan), ("text", "small"))
    elif name in COUNTS:
        yield from (("negative", -1), ("half", 1.5), ("text", "3"))
    elif name == "rng":
        yield from (("a seed", 3), ("None", None))
    elif name == "coordinates":
        yield from (("too large", [7]), ("negative", [-1]), ("twice", [0, 0]), ("half", [0.5]), ("none", []))
    elif name == "factor":
        yield from (("NaN", np.nan), ("text", "x"), ("matrix", np.eye(2)))
    elif name == "matrices":
        yield "no callable", np.eye(2)
    elif name == "filters":
        yield from (("none", []), ("sets", [U]))
    elif name == "time_limit":
        yield from (("negative", -1.0), ("zero", 0), ("NaN", np.nan), ("text", "soon"))
    elif name == "n_jobs":
        yield from (("zero", 0), ("text", "2"))


OPTIONAL = {"W", "X", "E", "C", "c", "A_eq", "b_eq"}
TABLE = [
    pytest.param(function, name, value, id=f"{function}-{name}-{what}")
    for function, (_, good) in CALLS.items()
    for name, right in good.items()
    for what, value in bad_values(name, right, function)
    if not (value is None and name in OPTIONAL)
    and not (function == "ParametricSet" and what == "wrong dimension")  # known only when matrices is called
]


@pytest.mark.parametrize("function", CALLS)
def test_the_good_arguments_are_accepted(function):
    call, good = CALLS[function]
    call(**good)


@pytest.mark.parametrize(("function", "name", "value"), TABLE)
def test_bad_input_raises_and_names_the_argument(function, name, value):
    call, good = CALLS[function]
    with pytest.raises(InvariantSetsError) as caught:
        call(**{**good, name: value})
    message = str(caught.value)
    related = {
        "B": "A|U",
        "A": "B|E|X|S|W|start|C",
        "C": "X",
        "E": "W",
        "x": "u_proposed",
        "p": "p|x|matrices",
        "A_eq": "A_eq|b_eq",
        "lower": "lower|upper",
        "V": "V",
        "b": "b",
    }.get(name, name)
    assert any(word in message for word in (name, *related.split("|")))
    assert len(message) > 20


def test_every_public_function_is_in_the_table():
    tested = {getattr(call, "__qualname__", "").split(".")[0] for call, _ in CALLS.values()} | {"Polytope"}
    tested |= {"plot_family", "plot_polytope"}  # below
    public = {name for name in invariant_sets.__all__ if callable(getattr(invariant_sets, name))}
    passive = {"Certificate", "InputError", "InvariantSetsError", "SetResult", "Status"}
    assert public - passive <= tested
    methods = {name for name, value in inspect.getmembers(Polytope) if not name.startswith("_") and callable(value)}
    assert methods - set(CALLS) <= {
        "from_bounds",
        "from_vertices",
        "bounding_box",
        "chebyshev_ball",
        "minimal",
        "plot",
        "empty",
    }
    assert len(invariant_sets.__all__) <= 17


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"A": np.ones((2, 3))}, r"A: got shape \(2, 3\), expected a square matrix"),
        ({"B": np.ones((3, 1))}, r"B: got shape \(3, 1\), expected \(2, n\)"),
        ({"B": np.ones((2, 0))}, "Use a zero column for no input"),
        ({"W": box([-1], [1])}, "W: got a set of dimension 1, expected dimension 2"),
        ({"W": box([0, 0], [np.inf, 1])}, "W: got an unbounded set, expected a bounded"),
        ({"W": Polytope.empty(2)}, "W: got an empty set, expected a bounded"),
        ({"W": None, "E": np.eye(2)}, "E: got a matrix without W"),
        ({"tol": -1.0}, r"tol: got -1.0, expected a finite number >= 0"),
    ],
)
def test_messages_say_what_was_got_and_expected(arguments, message):
    with pytest.raises(InvariantSetsError, match=message):
        maximal_control_invariant_set(**{**dynamics, "X": X, "U": U, **arguments})


def test_other_messages():
    for call, message in [
        (lambda: Polytope([[1, 0]], [1], A_eq=[[1, 0]]), "b_eq: got nothing, expected A_eq and b_eq together"),
        (lambda: box([np.inf], [np.inf]), "lower: got an infinite bound that excludes every point"),
        (lambda: box([0, 0], [np.inf, 1]).vertices, "Intersect it with a box"),
        (lambda: box([0, 0], [np.inf, 1]).volume, "Intersect it with a box"),
        (lambda: Polytope.empty(1).bounding_box(), "the set is empty"),
        (lambda: Polytope.empty(1).sample(1, rng=RNG), "the set is empty"),
        (lambda: Polytope.empty(1).chebyshev_ball(), "the set is empty"),
        (lambda: P.slice([0, 1], [0, 0]), "coordinates: got all 2 of them"),
        (lambda: AdmissibleInputs(A, B, X, Polytope.empty(1)), "no input can be admissible"),
        (lambda: AdmissibleInputs(A, B, X, box([0], [np.inf])), "U is unbounded"),
        (lambda: FILTER.project(np.zeros((2, 2)), np.zeros((3, 1))), "u_proposed: got 3 rows, expected 2"),
        (lambda: FAMILY.contains(np.zeros((2, 2)), np.ones((3, 1))), "p: got 3 rows, expected 2"),
        (lambda: ParametricSet(lambda p: A, X, U).at([1.0]), "expected a tuple"),
        (lambda: minimal_robust_positively_invariant_set(A, W), "spectral radius 1.2, expected less than 1"),
        (lambda: plot_polytope(Polytope.empty(1)), "nothing to draw"),
        (lambda: plot_polytope(box([0, 0], [np.inf, 1])), "unbounded"),
        (lambda: plot_polytope(np.eye(2)), "P: got ndarray, expected a Polytope"),
        (
            lambda: plot_polytope(box([0] * 4, [1] * 4), coordinates=[0, 1, 2, 3]),
            "coordinates: got 4 entries, expected one, two or three",
        ),
        (lambda: plot_family([P], values=[1, 2]), "values, labels: got 2 and 1 entries"),
        (
            lambda: box([1, 0], [0, 1]),
            "lower: got 1 above upper, 0, at index 0, expected lower <= upper. Exchange them",
        ),
        (lambda: Polytope(), "A: got neither A nor A_eq"),
        (lambda: [1.0] in P, r"x: got shape \(1,\), expected \(2,\)"),
        (lambda: P.contains([1.0, 2.0, 3.0]), r"x: got shape \(3,\), expected \(2,\)"),
    ]:
        with pytest.raises(InvariantSetsError, match=message):
            call()


def test_what_cannot_be_read_as_numbers_is_refused_whatever_it_raises():
    class Unreadable:
        def __array__(self, *args, **kwargs):
            raise RuntimeError("no array here")

    huge = 10**400
    for call in (
        lambda: Polytope(Unreadable(), [1.0]),
        lambda: Polytope([[huge, 1.0]], [1.0]),
        lambda: box([-huge], [1.0]),
        lambda: box([], []),
        lambda: box([None], [1.0]),
        lambda: X.contains(None),
        lambda: X.contains([0.0, 0.0], tol=huge),
        lambda: X.contains([0.0, 0.0], tol=True),
        lambda: maximal_control_invariant_set(A, B, X, U, tol=huge),
        lambda: X.minkowski_sum(X, time_limit=huge),
        lambda: plot_polytope(X, ax=3),
        lambda: plot_family(3),
        lambda: plot_family(X),
        lambda: plot_family([X], labels=3),
        lambda: plot_family([X, X], values=["low", "high"]),
        lambda: plot_family([X, X], values=[np.nan, 1.0]),
        lambda: plot_polytope(X, coordinates=[[0, 1], [1]]),
    ):
        with pytest.raises(InvariantSetsError, match=r"got .* expected"):
            call()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_sets_beyond_what_doubles_hold_are_refused_by_name():
    for call in (
        lambda: Polytope.from_vertices([[1e300, 0], [0, 1e300], [-1e300, -1e300]]).volume,
        lambda: X.scale(1e-320).volume,
        lambda: X.scale(1e305).volume,
    ):
        with pytest.raises(InvariantSetsError):
            call()
