"""Constraints, fixed entries and whole numbers of a design space."""

import copy
import pickle

import casadi as ca
import numpy as np
import pytest

from ccdtools import DesignSpace, InputError, Plant, discretise


def budget(p):
    return p[0] + p[1] - 3.0


@pytest.fixture
def space():
    return DesignSpace(["m", "b"], [0, 0], [2, 3], ["kg", "kg"], constraints=budget, constraint_names=["mass budget"])


def unit_space(g, size=2, low=-1e4, high=3e4, by=1e5):
    """A space with constraints stated in the unit box, in large units."""
    return DesignSpace(
        [f"p{i}" for i in range(size)], [low] * size, [high] * size,
        constraints=lambda p: [by * value for value in g((p - low) / (high - low))],
    )  # fmt: skip


def test_values_and_feasibility_are_those_of_the_function_for_one_design_and_for_many(space):
    designs = np.array([[1.0, 1.5], [2.0, 3.0], [0.0, 3.0]])
    np.testing.assert_allclose(space.constraint_values(designs)[:, 0], designs.sum(axis=1) - 3)
    assert space.constraint_values([1, 1]) == pytest.approx([-1])
    assert space.feasible(designs).tolist() == [True, False, True]
    assert not space.feasible([1, 3.1])
    assert space.violation([1, 1]) == 0
    assert space.violation([2, 3]) > 0


@pytest.mark.parametrize("by", [1e-6, 1.0, 1e8])
def test_a_violation_is_the_same_in_every_unit_of_the_constraint(by):
    one, other = (
        DesignSpace(["a"], [1], [2], constraints=lambda p, size=size: size * (p[0] - 1.2)) for size in (1.0, by)
    )
    assert one.violation([1.7]) == pytest.approx(other.violation([1.7]), rel=1e-9)


def test_a_space_without_constraints_has_none_and_projects_to_itself():
    plain = DesignSpace(["a"], [1], [2])
    assert plain.constraint_values([1.5]).shape == (0,)
    assert plain.violation([1.5]) == 0
    np.testing.assert_array_equal(plain.project([1.5]), [1.5])
    assert plain.active_constraints([1.0]) == {}


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda space: pickle.loads(pickle.dumps(space))])
def test_copies_keep_their_constraints(space, copied):
    again = copied(space)
    assert repr(again) == repr(space)
    np.testing.assert_array_equal(again.project([2, 3]), space.project([2, 3]))
    assert not again.lower.flags.writeable


def test_a_casadi_function_of_two_outputs_serves_as_well():
    p = ca.SX.sym("p", 2)
    function = ca.Function("g", [p], [p[0] - 1, p[1] - p[0]])
    space = DesignSpace(["a", "b"], [0, 0], [2, 2], constraints=function)
    np.testing.assert_allclose(space.constraint_values([2, 1]), [1, -1])


def test_repr_tells_what_holds_a_design(space):
    assert repr(space) == "DesignSpace(m in [0, 2] kg, b in [0, 3] kg, mass budget <= 0)"
    mixed = DesignSpace(["a", "n", "c"], [0, 1, 5], [1, 9, 5], integer=[1])
    assert repr(mixed) == "DesignSpace(a in [0, 1], n whole in [1, 9], c = 5 fixed)"


SETS = {
    "a disc": (2, lambda v: [v[0] ** 2 + v[1] ** 2 - 0.5]),
    "around a disc": (2, lambda v: [0.15 - (v[0] - 0.5) ** 2 - (v[1] - 0.5) ** 2]),
    "a corner of a hyperbola": (2, lambda v: [v[0] * v[1] - 0.1, 0.02 - v[0]]),
    "islands": (2, lambda v: [ca.sin(12 * v[0]) * ca.sin(12 * v[1]) + 0.5]),
    "a wedge": (3, lambda v: [v[0] + v[1] + v[2] - 1, v[0] - v[1]]),
}


@pytest.mark.long
@pytest.mark.quick(3)
@pytest.mark.parametrize("name", SETS)
def test_no_point_of_a_dense_cloud_is_feasible_and_nearer_than_the_projection(name, rng):
    size, g = SETS[name]
    space = unit_space(g, size)
    cloud = rng.random((100_000, size))
    values = np.array(ca.Function("g", [x := ca.SX.sym("x", size)], [ca.vertcat(*g(x))])(cloud.T)).T
    inside = cloud[(values <= 0).all(axis=1)]
    for v in rng.random((12, size)):
        found = space.project(space.from_unit(v))
        assert space.violation(found) <= 1e-9
        assert space.check_feasible(found) is not None
        distance = np.linalg.norm(space.to_unit(found) - v)
        assert distance <= np.linalg.norm(inside - v, axis=1).min() + 1e-9


def test_two_constraints_that_leave_a_line_can_be_projected_on():
    line = unit_space(lambda v: [v[0] + v[1] - 1, 1 - v[0] - v[1]])
    found = line.to_unit(line.project(line.from_unit([0.9, 0.7])))
    np.testing.assert_allclose(found, [0.6, 0.4], atol=1e-8)


def test_a_given_design_that_breaks_a_constraint_is_refused_by_name_and_models_take_it(space):
    with pytest.raises(InputError, match=r"p0: got m = 2 kg, b = 2 kg with mass budget = 1, expected constraints ≤ 0"):
        space.check_feasible([2, 2], argument="p0")
    np.testing.assert_array_equal(space.check([2, 2]), [2, 2])
    x, u, w, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    model = discretise(Plant(x, u, w, p, -p[0] * x + p[1] * u + w, space, dt=0.1))
    assert np.isfinite(model.matrices([2, 2])[0]).all()


def test_rounding_on_an_edge_is_forgiven_and_corrected(space):
    given = [1.0, 2.0 + 1e-7]
    assert budget(np.array(given)) > 0
    assert budget(space.check_feasible(given)) <= 1e-12


def test_active_constraints_are_those_that_an_edge_is_near(space):
    assert space.active_constraints([1, 2]) == {"mass budget": 0.0}
    assert space.active_constraints([1, 1]) == {}


def test_fixed_entries_belong_to_the_plant_and_are_not_designed(rng):
    mixed = DesignSpace(["a", "c"], [1, 5], [3, 5])
    np.testing.assert_array_equal(mixed.to_unit([2, 5]), [0.5, 0])
    np.testing.assert_array_equal(mixed.from_unit([[0.5, 0.7]]), [[2, 5]])
    assert mixed.active_bounds([1, 5]) == {"a": "lower"}
    assert (mixed.latin_hypercube(9, rng)[:, 1] == 5).all()
    corners = mixed.spread()[:2]
    np.testing.assert_array_equal(corners, [[1, 5], [3, 5]])
    with pytest.raises(InputError, match=r"design: got c = 5.1, expected a value in \[5, 5\]"):
        mixed.check([2, 5.1])
    still = DesignSpace(["c"], [5], [5])
    np.testing.assert_array_equal(still.spread(), [[5.0]])


def test_whole_numbers_are_continuous_to_models_and_whole_to_those_who_build():
    gear = DesignSpace(["r", "teeth"], [0.1, 10], [1, 30], integer=["teeth"])
    np.testing.assert_array_equal(gear.from_unit([0, 0.51]), [0.1, 20.2])
    np.testing.assert_array_equal(gear.check([0.5, 17.4]), [0.5, 17.4])
    with pytest.raises(InputError, match=r"design: got teeth = 17.4, expected a whole number"):
        gear.check_feasible([0.5, 17.4])
    assert not gear.feasible([0.5, 17.4])
    assert gear.check_feasible([0.5, 17 + 1e-8])[1] == 17


def test_the_nearest_design_with_whole_numbers_is_that_of_trying_all():
    def g(p):
        return p[0] * p[1] - 12.3

    gear = DesignSpace(["r", "teeth"], [0, 10], [1, 30], constraints=g, integer=[1])
    for given in ([1.0, 30.0], [0.9, 11.2], [0.45, 29.0]):
        found = gear.project(given)
        unit = [min(given[0], 12.3 / n) for n in range(10, 31)]
        # of one number of teeth, the largest radius allowed is the nearest
        costs = [(given[0] - r) ** 2 + ((given[1] - n) / 20) ** 2 for r, n in zip(unit, range(10, 31))]
        best = int(np.argmin(costs))
        np.testing.assert_allclose(found, [unit[best], 10 + best], rtol=1e-7)


def test_of_many_whole_numbers_the_few_allowed_ones_are_found():
    wide = DesignSpace(["n", "m"], [0, 0], [5000, 5000], constraints=lambda p: p[0] + p[1] - 3.7, integer=[0, 1])
    assert wide.project([3000, 2000]).tolist() == [3, 0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"constraints": 3}, "constraints: got 3, expected a function of p"),
        ({"constraints": lambda p: p[5]}, r"constraints: got .* index 5 beyond a column of 2 .*p is \(a, b\)"),
        ({"constraints": lambda p: p[0] <= 3}, "constraints: got a comparison, .* Write a ≤ b as a - b"),
        ({"constraints": lambda p: []}, r"constraints: got expressions of shape \(0, 1\)"),
        ({"constraints": lambda p: p[0] + ca.SX.sym("q")}, r"constraints: got unknown symbols \['q'\]"),
        ({"constraints": lambda p: ca.log(p[0])}, "constraints: got a value that is not finite at a = 0"),
        ({"constraints": lambda p: 2.5 - p[0] - p[1], "constraint_names": ["strength"]},
         "constraints: got no design that keeps them: at best strength = 0.5 at a = 1, b = 1"),
        ({"constraints": lambda p: [p[0] - 0.4, 0.6 - p[0]]}, "constraints: got no design that keeps them: at best"),
        ({"constraints": lambda p: (p[0] - 0.5) ** 2 + (p[1] - 0.5) ** 2 + 1e-3}, "no design that keeps them"),
        ({"constraints": lambda p: [0.3 - p[0], p[0] - 0.7], "integer": [0]}, "no design that keeps them"),
        ({"constraints": budget, "constraint_names": ["a", "b"]}, r"constraint_names: got \['a', 'b'\], expected 1"),
        ({"constraint_names": ["a"]}, r"constraint_names: got \['a'\], expected none"),
        ({"integer": "a"}, "integer: got 'a', expected a list"),
        ({"integer": ["c"]}, "integer: got 'c', expected names among a, b"),
        ({"integer": [2]}, "integer: got 2, expected names"),
        ({"upper": [0.5, 1], "lower": [0.2, 0], "integer": ["a"]},
         r"integer: got a in \[0.2, 0.5\], expected bounds with a whole number"),
    ],
)  # fmt: skip
def test_what_cannot_be_kept_is_refused_at_once(arguments, message):
    with pytest.raises(InputError, match=message):
        DesignSpace(**{"names": ["a", "b"], "lower": [0, 0], "upper": [1, 1]} | arguments)


def test_a_feasible_set_that_no_sample_meets_is_found():
    needle = unit_space(lambda v: [(v[0] - 0.123) ** 2 + (v[1] - 0.877) ** 2 - 1e-6])
    np.testing.assert_allclose(needle.to_unit(needle.project(needle.centre)), [0.123, 0.877], atol=2e-3)


REWRITTEN = {
    "in large units": lambda g: 1e12 * g,
    "in small units": lambda g: 1e-12 * g,
    "cubed": lambda g: g**3,
    "steep beyond its edge": lambda g: ca.exp(40 * g) - 1,
    "steep within its edge": lambda g: 1 - ca.exp(-20 * g),
    "a logarithm": lambda g: ca.log(g + 2) - np.log(2),
}


@pytest.mark.long
@pytest.mark.quick(3)
@pytest.mark.parametrize("name", ["a disc", "around a disc", "a wedge"])
@pytest.mark.parametrize("rewritten", REWRITTEN)
def test_a_growing_function_of_a_constraint_leaves_the_same_designs(rewritten, name, rng):
    size, g = SETS[name]
    other = unit_space(lambda v: [REWRITTEN[rewritten](value) for value in g(v)], size, by=1.0)
    x = ca.SX.sym("x", size)
    plain = ca.Function("g", [x], [ca.vertcat(*g(x))])
    cloud = rng.random((100_000, size))
    values = np.array(plain(cloud.T)).max(axis=0)
    feasible = other.feasible(other.from_unit(cloud))
    assert feasible[values <= 0].all()
    assert values[feasible].max() <= 1e-5
    for v in rng.random((5, size)):
        found = other.to_unit(other.project(other.from_unit(v)))
        assert np.array(plain(found)).max() <= 1e-9
        nearest = np.linalg.norm(cloud[values <= 0] - v, axis=1).min()
        assert np.linalg.norm(found - v) <= nearest + 1e-9


@pytest.mark.parametrize("rate", [40.0, 400.0])
def test_an_exponential_keeps_its_edge_however_large_it_is_over_the_box(rate):
    space = DesignSpace(["a"], [0], [1], constraints=lambda p: ca.exp(rate * p[0]) - 2)
    edge = np.log(2) / rate
    assert space.feasible([0.9 * edge])
    assert not space.feasible([1.01 * edge])
    assert space.project([0.8])[0] == pytest.approx(edge, abs=1e-9)
    assert space.active_constraints([edge]) != {}
    with pytest.raises(InputError, match="no design that keeps them"):
        DesignSpace(["a"], [0], [1], constraints=lambda p: ca.exp(rate * p[0]) - 0.999)


LEVEL = {
    "a point": (lambda p: (p[0] - 0.3) ** 2 + (p[1] - 0.6) ** 2, [0.3, 0.6]),
    "a point, expanded": (lambda p: p[0] ** 2 - 0.6 * p[0] + 0.45 + p[1] ** 2 - 1.2 * p[1], [0.3, 0.6]),
    "a corner": (lambda p: p[0] ** 2 + p[1] ** 2, [0.0, 0.0]),
    "a line": (lambda p: (p[0] + p[1] - 1) ** 2, [0.6, 0.4]),
    "a line as two constraints": (lambda p: [ca.exp(9 * (p[0] + p[1] - 1)) - 1, 1 - p[0] - p[1]], [0.6, 0.4]),
    "a line of fourth powers": (lambda p: (p[0] + p[1] - 1) ** 4, [0.6, 0.4]),
    "a circle": (lambda p: (p[0] ** 2 + p[1] ** 2 - 0.5) ** 2, np.array([0.9, 0.7]) * np.sqrt(0.5 / 1.3)),
}


@pytest.mark.parametrize("name", LEVEL)
def test_constraints_that_leave_no_room_hold_designs_nonetheless(name):
    g, nearest = LEVEL[name]
    space = DesignSpace(["a", "b"], [0, 0], [1, 1], constraints=g)
    found = space.project([0.9, 0.7])
    np.testing.assert_allclose(found, nearest, atol=3e-6)
    np.testing.assert_array_equal(space.check_feasible(found), found)


def test_a_constraint_that_swings_widely_above_zero_leaves_nothing():
    with pytest.raises(InputError, match="no design that keeps them"):
        DesignSpace(["a"], [0], [1], constraints=lambda p: 2 + ca.sin(1e7 * p[0]))


def test_an_edge_of_infinite_slope_is_not_near_everything():
    space = DesignSpace(["a"], [0], [1], constraints=lambda p: 0.5 - ca.sqrt(p[0]))
    assert space.violation([0.0]) > 0.1
    assert space.project([0.0])[0] == pytest.approx(0.25)
    other = DesignSpace(["a"], [0], [1], constraints=lambda p: ca.sqrt(p[0]) - 0.5)
    assert other.active_constraints([0.0]) == {}


def test_a_constraint_on_no_parameters_is_refused():
    with pytest.raises(InputError, match=r"constraints: .*no parameters"):
        DesignSpace([], lower=[], upper=[], constraints=lambda p: -1.0)


def test_rounding_of_a_constraint_that_only_a_fixed_entry_enters_breaks_nothing():
    space = DesignSpace(["a", "b"], [0.3, 0], [0.3, 1], constraints=lambda p: 0.1 + 0.2 - p[0])
    assert space.project([0.3, 0.5]) == pytest.approx([0.3, 0.5])
