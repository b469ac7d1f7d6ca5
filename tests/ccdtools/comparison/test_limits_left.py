"""Limits that are left: of states, inputs and outputs, each beside the baseline's own."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scalar_experiment import OBJECTIVE, A, drawn, found

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    LinearFeedback,
    OutputLimits,
    Plant,
    QuadraticObjective,
    compare,
    discretise,
    excursions,
    experiment,
    plant_from_matrices,
)
from invariant_sets import Polytope


@pytest.mark.parametrize(("U", "word"), [(None, "better"), (([-0.2], [0.2]), "better in return only")])
def test_a_law_that_asks_for_what_actuators_have_not_is_not_better(U, word):
    gain = 0.6
    laws = {"LQR": LinearFeedback([[gain]], -0.2, 0.2), "gain": LinearFeedback([[gain]])}
    result = found({name: lambda design, rng, law=law: law for name, law in laws.items()}, U=U)
    assert result["gain"].word == word
    assert ("any input counts" in str(result.header)) == (U is None)
    scores = compare(laws, drawn(np.random.default_rng(5)), objective=OBJECTIVE, X=([-50.0], [50.0]), U=U)
    assert scores.limits == ("X" if U is None else "the limits")
    assert (scores["gain"].violations > 0.1) == (U is not None)
    assert scores["LQR"].violations == 0
    assert scores["gain"].further_outside_than == (() if U is None else ("LQR",))


@pytest.mark.parametrize("U", [([-0.2], [0.2]), (-np.inf, [0.2])])
@pytest.mark.parametrize(("beyond", "counts"), [(2e-6, False), (5e-5, True)])
def test_inputs_at_their_limits_in_single_precision_are_within(U, beyond, counts):
    at = 0.2 * (1 + beyond)
    laws = {"LQR": LinearFeedback([[0.6]], -0.2, 0.2), "rounded": LinearFeedback([[0.6]], -at, at)}
    scores = compare(laws, drawn(np.random.default_rng(5)), objective=OBJECTIVE, X=([-50.0], [50.0]), U=U)
    assert (scores["rounded"].violations > 0.1) == counts
    assert scores["rounded"].further_outside_than == (("LQR",) if counts else ())


@pytest.mark.parametrize(
    ("X", "U", "word"),
    [(np.inf, ([-0.2], [0.2]), "better in return only"), (np.inf, None, "better"), (50.0, (-np.inf, np.inf), "better")],
)
def test_states_or_inputs_without_limits_are_never_outside(X, U, word):
    laws = {"LQR": LinearFeedback([[0.6]], -0.2, 0.2), "gain": LinearFeedback([[0.6]])}
    limits = {"X": ([-X], [X]), "U": U}
    assert found({name: lambda d, rng, law=law: law for name, law in laws.items()}, **limits)["gain"].word == word
    scores = compare(laws, drawn(np.random.default_rng(5)), objective=OBJECTIVE, **limits)
    assert scores["LQR"].violations == 0
    assert scores["LQR"].exceeded == ""
    assert excursions([[1e9], [0.0]], Polytope.from_bounds([-np.inf], [np.inf])).exceeded == ""
    one = replace(drawn(np.random.default_rng(5)), x0=[[1.0]], disturbance=np.zeros((1, 40, 1)))  # cut into stretches
    assert compare(laws, one, objective=OBJECTIVE, **limits)["LQR"].violations == 0


def test_rows_of_U_are_named_after_it():
    four = plant_from_matrices([[A]], [[1.0] * 4], [[1.0]], dt=1.0, continuous=False)
    scenario = replace(drawn(np.random.default_rng(5)), plant=four)
    options = {"objective": QuadraticObjective(Q=[[1.0]], R=np.eye(4)), "X": ([-50.0], [50.0])}
    laws = {"LQR": LinearFeedback(np.full((4, 1), 0.2))}
    sides = np.vstack([np.eye(4), -np.eye(4), np.ones((1, 4))])
    for most, exceeded in (([9.0] * 8 + [0.1], "row 9 of U"), ([9.0] * 4 + [0.0] + [9.0] * 4, "u1 < 0")):
        scores = compare(laws, scenario, U=Polytope(sides, np.array(most)), **options)
        assert scores["LQR"].exceeded == exceeded
    with pytest.raises(InputError, match=r"^U: got an empty set"):
        compare(laws, scenario, U=Polytope.empty(4), **options)


def test_limits_of_inputs_of_another_size_are_refused():
    with pytest.raises(InputError, match="U"):
        found(U=([-1.0, -1.0], [1.0, 1.0]))


@pytest.mark.parametrize("X", [([-50.0], [50.0]), ([-0.3], [0.3]), ([-0.05], [0.05])])
@pytest.mark.parametrize(
    "limits", [{"U": ([-0.8], [0.8])}, {"output_limits": OutputLimits(lambda x, u, p: u, -0.8, 0.8)}]
)
def test_limits_that_the_baseline_leaves_often_do_not_hide_others_that_it_keeps(X, limits):
    laws = {"LQR": LinearFeedback([[0.6]], -0.8, 0.8), "gain": LinearFeedback([[0.6]])}
    result = found({n: lambda d, rng, law=law: law for n, law in laws.items()}, X=X, seeds=10, **limits)["gain"]
    assert result.evidence.gain.ci95[0] > 0
    assert result.word == "better in return only"
    assert "u1" in result.evidence.violation.exceeded or "y1" in result.evidence.violation.exceeded
    assert result.evidence.violation.tolerance == (0.0, 0.0)  # the baseline keeps these
    scores = compare(laws, drawn(np.random.default_rng(5)), objective=OBJECTIVE, X=X, **limits)
    assert "LQR" in scores["gain"].further_outside_than


@pytest.mark.parametrize("seeds", [1, 10])
def test_violations_are_told_of_the_runs_that_neither_lost(seeds):
    x, u, w = (ca.SX.sym(name) for name in "xuw")
    blows_up = ca.if_else(ca.fabs(x) > 9, 1e9, A * x + u + w)
    plant = Plant(x, u, w, None, [blows_up], DesignSpace([], [], []), 1.0, continuous=False)

    def scenario(rng):
        """Runs of which the first is lost; with many seeds all of some."""
        given = drawn(rng)
        lost = np.arange(7)[:, None] < (1 if seeds == 1 else 7 * rng.integers(2))
        return replace(given, plant=plant, x0=np.where(lost, 10.0, 1.0), disturbance=0.0 * given.disturbance)

    laws = {"LQR": LinearFeedback([[0.6]], -0.2, 0.2), "gain": LinearFeedback([[0.6]])}
    given = {n: lambda d, rng, law=law: law for n, law in laws.items()}
    result = found(given, scenario, U=([-0.2], [0.2]), seeds=seeds)["gain"]
    assert result.evidence.lost[0] == result.evidence.lost[1] > 0
    assert result.evidence.violation.achieved == pytest.approx((1 / 15, 2.0))  # 0.6 once, of the runs that are kept
    assert result.evidence.violation.before == (0.0, 0.0)


def test_limits_that_move_with_the_design_are_shown_of_each():
    space = DesignSpace(["reach"], [0.1], [1.0])
    x, u, w, p = (ca.SX.sym(name) for name in "xuwp")
    plant = Plant(x, u, w, p, [A * x + u + w], space, dt=1.0, continuous=False)
    starts = FixedStart([1.0], Gaussian([0.1]))
    U = CoDesignProblem(
        discretise(plant), X=(-50.0, 50.0), U=lambda p: (-p, p), objective=OBJECTIVE, scenarios=starts
    ).U
    scenario = replace(drawn(np.random.default_rng(5)), plant=plant)
    laws = {"LQR": lambda design, rng: LinearFeedback([[0.6]], -design, design)}
    designs = {"small": [0.2], "large": [0.8]}
    told = experiment(laws, scenario, objective=OBJECTIVE, X=([-50.0], [50.0]), U=U, designs=designs, seeds=1).header
    lines = [line for line in told.lines if line[0] in "XU"]
    assert lines == [
        ("X", "", "[-50.0] to [50.0]"), ("U", "small", "[-0.2] to [0.2]"), ("U", "large", "[-0.8] to [0.8]")
    ]  # fmt: skip
    with pytest.raises(InputError, match=r"design: got nothing, expected the design whose limits U\(p\) count"):
        found(U=U)


def test_one_run_beside_many_tells_nothing_of_limits():
    laws = {"LQR": LinearFeedback([[0.6]], -0.2, 0.2), "gain": LinearFeedback([[0.6]])}
    limits = {"X": ([-50.0], [50.0]), "U": ([-0.2], [0.2])}
    rng = np.random.default_rng(5)
    scenario = replace(drawn(rng), x0=np.zeros((40, 1)), disturbance=rng.standard_normal((40, 400, 1)))
    for few, further in (({}, ("LQR",)), ({"gain": 1}, ())):
        scores = compare(laws, scenario, objective=OBJECTIVE, few=few, **limits)
        assert scores["gain"].further_outside_than == further


def test_the_row_that_is_named_was_left_by_a_run_that_did_not_diverge():
    two = plant_from_matrices(np.diag([A, 3.0]), [[1.0], [0.0]], [[1.0], [0.0]], dt=1.0, continuous=False)

    def starts(rng):
        one = drawn(rng)
        return replace(one, plant=two, x0=np.c_[one.x0, np.arange(len(one.x0)) == 0])

    laws = {"LQR": LinearFeedback([[0.6, 0.0]]), "gain": LinearFeedback([[0.1, 0.0]])}
    options = {"objective": QuadraticObjective(Q=np.eye(2), R=[[0.5]]), "X": ([-0.3, -50.0], [0.3, 50.0])}
    result = found({n: lambda d, rng, law=law: law for n, law in laws.items()}, starts, **options)["gain"]
    assert result.evidence.lost == (4, 4)
    assert "x1" in result.evidence.violation.exceeded


@pytest.mark.parametrize("seeds", [1, 10])
def test_a_law_that_saves_a_run_by_more_than_U_is_judged_on_the_runs_that_the_baseline_saves_too(seeds):
    x, u, w = (ca.SX.sym(name) for name in "xuw")
    after = ca.if_else(ca.fabs(x) > 3, 1e9, A * x + u + w)
    plant = Plant(x, u, w, None, [after], DesignSpace([], [], []), 1.0, continuous=False)

    def kicked(rng):
        w = np.clip(0.2 * rng.standard_normal((7, 15, 1)), -0.4, 0.4)
        w[0, 0] = -1.5 - 0.05 * rng.random()
        start = np.where(np.arange(7) == 0, -2.9, 0.5)[:, None]
        return replace(drawn(rng), plant=plant, x0=start, disturbance=w)

    for least, row in ((-0.8, None), (-0.25, "u1 < -0.25")):  # the saved run is beyond the other limit, and deeper
        laws = {"LQR": LinearFeedback([[0.2]], least, 0.8), "gain": LinearFeedback([[0.6]])}
        options = {"U": ([least], [0.8]), "seeds": seeds}
        result = found({n: lambda d, rng, law=law: law for n, law in laws.items()}, kicked, **options)["gain"]
        assert result.evidence.lost == (0, seeds)
        violation = result.evidence.violation
        assert (None if violation is None else violation.exceeded) == row


def test_the_row_that_is_named_is_that_of_the_seed_that_leaves_it_deepest():
    """Of one seed in ten the inputs are beyond the other limit, by ten times as much."""
    laws = {"LQR": lambda d, rng: LinearFeedback([[0.6]], -0.2, 0.2)}
    for first in (0, 6):
        seeds = [first, *(seed for seed in range(10) if seed != first)]
        laws["gain"] = lambda d, rng: LinearFeedback([[0.6]], -0.3, 0.2 if rng.random() < 0.9 else 1.2)
        result = found(laws, U=([-0.2], [0.2]), seeds=seeds)["gain"]
        assert result.evidence.violation.exceeded == "u1 > 0.2"
