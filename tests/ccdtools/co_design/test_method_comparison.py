"""The table of methods: rows, pairs, refusals, verdicts, files."""

import csv
import os
import signal
import time
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from constrained_plants import CASES
from small_plants import best_design, clone_of, exact_return, mass, two_valleys

from ccdtools import (
    CoDesignConfig,
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    Learned,
    LinearFeedback,
    Nested,
    Plant,
    QuadraticObjective,
    Search,
    Sequential,
    compare_methods,
    discretise,
    simulate,
)
from ccdtools.cli import insisting
from ccdtools.co_design import closed_loop_returns

QUICK = {
    "plant first": Sequential(starts=1), "nested": Nested(starts=1, runs=100),
    "search": Search(evaluations=120, runs=64),
}  # fmt: skip


class Refusing:
    """A method that treats nothing."""

    name = "none"

    def run(self, problem, design, rng, *, progress=False):
        raise InputError("problem", "this one", "another")


@pytest.fixture(scope="module")
def problem():
    return mass()


@pytest.fixture(scope="module")
def found(problem):
    return compare_methods(problem, {**QUICK, "refusing": Refusing()}, seed=3, reference="nested")


@pytest.mark.long
def test_every_method_is_a_row_and_a_refusal_says_why(found):
    assert [row.name for row in found] == ["plant first", "nested", "search", "refusing"]
    assert found["refusing"].result is None
    assert "another" in found["refusing"].refused
    assert any(line.startswith("refusing refused:") for line in found.verdict)
    assert "refused: " in str(found)


@pytest.mark.check
def test_a_method_with_a_judge_of_its_own_is_measured_on_the_problem_as_the_others_are(problem):
    louder = replace(problem, scenarios=FixedStart([3.0, -3.0], Gaussian([0.5])))
    config = CoDesignConfig(iterations=2, runs=16, pathwise_runs=16, evaluation_runs=20, evaluate_every=1, starts=1)
    agent = clone_of(problem)
    learned = {name: Learned(agent=agent, config=config, judge=judge) for name, judge in
               {"alone": None, "judged": louder}.items()}  # fmt: skip
    table = compare_methods(problem, {"nested": Nested(starts=1, runs=50), **learned}, reference="nested")
    alone, judged = (table[name].closed_loop.summary.mean for name in learned)
    assert judged == pytest.approx(alone, rel=0.1)  # louder starts cost nine times as much


@pytest.mark.long
def test_nested_and_search_reach_the_exact_optimum(found, problem):
    best, _ = best_design(problem)
    for name in ("nested", "search"):
        assert found[name].result.design == pytest.approx(best, abs=0.02)


def test_the_paired_difference_is_that_of_the_same_runs(found, problem):
    # the loops once more, by `simulate`, which shares no code with the differentiable model
    scenarios = np.random.default_rng(3).spawn(1)[0]
    runs = len(found["nested"].closed_loop.values)
    x0, w = (part.astype(np.float32).astype(float) for part in problem.scenarios.sample(runs, problem.steps, scenarios))
    values = {}
    for name in ("plant first", "nested"):
        result = found[name].result
        loop = simulate(
            problem.model, result.controller, x0=x0, steps=problem.steps, disturbance=w, design=result.design
        )
        values[name] = loop.returns(problem.objective)
    gap = values["plant first"] - values["nested"]
    assert found["plant first"].difference.mean == pytest.approx(gap.mean(), rel=1e-6)


def test_the_plant_that_is_designed_first_loses_by_its_design_alone(found, problem):
    row = found["plant first"]
    exact = exact_return(problem, row.result.design) - exact_return(problem, found["nested"].result.design)
    assert exact < -0.01 * found.size
    low, high = row.from_design.ci95
    assert low - 0.02 * abs(exact) < exact < high + 0.02 * abs(exact)
    assert row.from_control.mean == pytest.approx(0.0, abs=1e-9 * found.size)
    assert row.difference.mean == pytest.approx(row.from_design.mean + row.from_control.mean)
    assert found.best.name in ("nested", "search")
    said = next(line for line in found.verdict if line.startswith("plant first:"))
    assert "by its design" in said
    assert "passive plant" in said


def test_equal_methods_are_said_to_be_equal(found):
    assert found.verdict[0].startswith("Equal within 0.5 %")
    assert "nested, search" in found.verdict[0]


def test_the_table_is_written_and_read_back(found, tmp_path):
    with found.to_csv(tmp_path / "methods.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["method"] for row in rows] == [row.name for row in found]
    assert float(rows[1]["m"]) == found["nested"].result.design[0]
    assert rows[3]["status"] == "refused"
    percent = 100 * found["plant first"].difference.mean / found.size
    assert float(rows[0]["difference_percent"]) == pytest.approx(percent)


@pytest.mark.long
def test_the_picture_is_drawn_for_any_number_of_parameters(found, tmp_path):
    found.plot().savefig(tmp_path / "shown.png")
    assert (tmp_path / "shown.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
def test_a_notebook_shows_the_picture_that_pyplot_knows_nothing_of(found):
    formatters = pytest.importorskip("IPython.core.formatters")
    assert formatters.PNGFormatter()(found.plot()).startswith(b"\x89PNG")


@pytest.mark.check
def test_processes_change_nothing(problem, found):
    names = {name: QUICK[name] for name in ("nested", "plant first")}
    beside = compare_methods(problem, names, seed=3, jobs=2)
    for name in names:
        np.testing.assert_array_equal(beside[name].result.design, found[name].result.design)
        np.testing.assert_array_equal(beside[name].closed_loop.values, found[name].closed_loop.values)


class Swallowing:
    """A method whose library makes an error of its own of Ctrl-C."""

    name = "swallowing"

    def run(self, problem, design, rng, *, progress=False):
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1.0)
        except KeyboardInterrupt:
            raise NotImplementedError("wrong number or type of arguments") from None


def test_an_interruption_is_not_taken_for_a_refusal(problem):
    with pytest.raises(KeyboardInterrupt), insisting():
        compare_methods(problem, {"swallowing": Swallowing(), "refusing": Refusing()})


@pytest.mark.long
def test_what_is_there_is_told_after_every_method(problem, found):
    told = []
    chosen = {name: QUICK[name] for name in ("plant first", "nested")}
    last = compare_methods(problem, chosen, seed=3, reference="nested", each=told.append)
    assert [[row.name for row in one] for one in told] == [["plant first"], ["plant first", "nested"]]
    assert told[0].reference == "plant first"  # the reference is not there yet
    assert told[1] is last
    assert last["plant first"].difference.mean == found["plant first"].difference.mean


@pytest.mark.long
def test_other_units_change_neither_order_nor_per_cent(problem, found):
    # costs in cents instead of euros: all that is relative stays
    priced = replace(problem, objective=QuadraticObjective(100 * problem.objective.Q, 100 * problem.objective.R))
    cents = compare_methods(priced, {"nested": QUICK["nested"], "plant first": QUICK["plant first"]}, seed=3)
    own = found.percent(found["plant first"].difference.mean)
    assert cents["nested"].closed_loop.summary.mean == pytest.approx(100 * found["nested"].closed_loop.summary.mean)
    assert cents.percent(cents["plant first"].difference.mean) == pytest.approx(own, rel=0.02)


def test_the_reference_is_nested_lqr_or_the_first():
    pair = compare_methods(two_valleys(), {"b": Nested(starts=1, runs=32), "a": Nested(starts=1, runs=32)})
    assert pair.reference == "b"
    assert pair["b"].difference.mean == 0.0
    assert pair["a"].difference.mean == 0.0


@pytest.mark.parametrize(
    ("methods", "word"),
    [(["magic"], "magic"), ([], "none"), (["nested LQR", "nested-lqr"], "every method once"), (3, "names"),
     ({1: "ppo"}, "names")],
)  # fmt: skip
def test_wrong_methods_are_refused_by_name(problem, methods, word):
    with pytest.raises(InputError, match=word) as error:
        compare_methods(problem, methods)
    assert error.value.argument == "methods"


@pytest.mark.parametrize(
    ("change", "argument"),
    [
        ({"seed": -1}, "seed"),
        ({"jobs": 0}, "jobs"),
        ({"reference": "x"}, "reference"),
        ({"design": [99.0]}, "design"),
        ({"each": 3}, "each"),
    ],
)
def test_wrong_arguments_are_refused_before_anything_runs(problem, change, argument):
    with pytest.raises(InputError) as error:
        compare_methods(problem, {"refusing": Refusing()}, **change)
    assert error.value.argument == argument


class Careless:
    """Saturated LQR that is cheap because it does not keep the limits."""

    name = "careless"

    def run(self, problem, design, rng, *, progress=False):
        unlimited = replace(problem, limit_tolerance="off")
        return Nested(starts=1, runs=64).run(unlimited, design, rng)


class Careful:
    """A controller that stays far from them, and pays for it."""

    name = "careful"

    def run(self, problem, design, rng, *, progress=False):
        found = Nested(starts=1, runs=64, evaluations=1).run(replace(problem, limit_tolerance="off"), design, rng)
        return replace(found, controller=LinearFeedback(found.controller.K + np.array([0.0, 4.0])))


def test_a_method_that_leaves_the_limits_does_not_win():
    own = mass()
    narrow = replace(own, X=([-0.1, -9], [2, 9]), scenarios=FixedStart([1.5, 0.0], own.scenarios.disturbance),
                     limit_tolerance=(1e-3, 1e-2))  # fmt: skip
    pair = compare_methods(narrow, {"careful": Careful(), "careless": Careless()}, reference="careful")
    assert pair["careful"].closed_loop.outside < 1e-3
    assert pair["careless"].closed_loop.outside > 0.01
    assert pair["careless"].difference.mean > 0.01 * pair.size  # cheaper, and yet
    assert pair.best.name == "careful"
    said = [line for line in pair.verdict if line.startswith("careless")]
    assert any("in return only" in line for line in said)
    assert any("half-widths deep" in line for line in said)
    assert not any("wins" in line for line in pair.verdict)
    assert "No method that keeps the limits is better than careful by more than 0.5 %." in pair.verdict
    assert "half-widths deep" in "\n".join(pair["careless"].result.describe())


def test_one_method_alone_is_not_compared_with_nobody(problem):
    alone = compare_methods(problem, {"nested": QUICK["nested"]})
    assert alone.verdict == []


class HalfGain:
    """LQR of the given design with half of its gain."""

    name = "half"

    def run(self, problem, design, rng, *, progress=False):
        found = Nested(starts=1, runs=32, evaluations=1).run(problem, design, rng)
        return replace(found, controller=LinearFeedback(found.controller.K / 2))


@pytest.mark.long
def test_a_method_that_wins_is_said_to_win_and_by_what(problem):
    design = best_design(problem)[0]
    pair = compare_methods(problem, {"half": HalfGain(), "nested": QUICK["nested"]}, design=design, reference="half")
    assert pair.best.name == "nested"
    assert pair["nested"].from_control.ci95[0] > 0
    assert abs(pair["nested"].from_design.mean) < 0.01 * pair["nested"].from_control.mean
    said = next(line for line in pair.verdict if line.startswith("nested wins: "))
    assert "better than half" in said
    assert "by its controller" in said
    for cause in ("plans with", "knows nothing", "fitted to", "would need", "because"):  # none of them was measured
        assert cause not in said


class Push:
    """A disturbance that is the same in every run."""

    nw = 1

    def sample(self, runs, steps, rng):
        return np.tile(np.sin(np.arange(steps))[:, None], (runs, 1, 1))


def test_equal_runs_are_simulated_once(problem):
    sizes = []

    def law(x):
        sizes.append(len(x))
        return -0.5 * x[:, :1]

    pushed = replace(problem, scenarios=FixedStart([1.0, 0.0], Push()))
    found = closed_loop_returns(pushed, law, [1.0], np.random.default_rng(0), runs=40)
    assert set(sizes) == {1}
    run = simulate(
        problem.model, law, x0=[1.0, 0.0], steps=problem.steps, design=[1.0],
        disturbance=np.sin(np.arange(problem.steps))[:, None],
    )  # fmt: skip
    assert found.values == pytest.approx(np.full(40, run.returns(problem.objective)[0]), rel=1e-6)


def test_a_comparison_says_which_method_it_is_at(problem, capsys):
    chosen = {"refusing": Refusing(), "again": Refusing()}
    compare_methods(problem, chosen)
    assert "methods" in capsys.readouterr().err
    compare_methods(problem, chosen, progress=False)
    compare_methods(problem, chosen, each=lambda _: None)
    assert not capsys.readouterr().err


FEW = {"few": Nested(starts=1, runs=8, evaluations=2), "more": Nested(starts=1, runs=8, evaluations=4)}


def marks(figure, comparison):
    """Where the right picture has the marker of every method, (n, 2)."""
    ax = figure.axes[1]
    drawn = [line.get_xydata() for line in ax.lines if line.get_marker() not in ("None", "", None)]
    return np.concatenate(drawn)[-len(comparison) :], ax


@pytest.mark.long
def test_designs_of_two_parameters_are_drawn_on_a_map():
    table = compare_methods(CASES["a mass budget"].problem(), FEW, seed=0)
    drawn, ax = marks(table.plot(), table)
    np.testing.assert_allclose(drawn, [row.result.design for row in table])
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("p0", "p1")


def test_designs_of_three_parameters_are_drawn_each_in_its_range():
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 3)
    space = DesignSpace(["k", "c", "m"], [1.0, 0.1, 1.0], [3.0, 1.0, 2.0], ["N/m", "-", "kg"])
    plant = Plant(x, u, w, p, ca.vertcat(x[1], (-p[0] * x[0] - p[1] * x[1] + u + w) / p[2]), space, dt=0.1)
    body = CoDesignProblem(
        discretise(plant), X=(-10.0, 10.0), U=(-20.0, 20.0), objective=QuadraticObjective(np.eye(2), [[0.1]]),
        scenarios=FixedStart([1.0, 0.0], Gaussian([0.3])), steps=30,
    )  # fmt: skip
    table = compare_methods(body, FEW, seed=0)
    ax = table.plot().axes[1]
    assert [label.get_text() for label in ax.get_yticklabels()] == ["k [N/m]", "c", "m [kg]"]
    drawn = [line.get_xydata()[0] for line in ax.lines if line.get_marker() not in ("None", "", None)]
    expected = np.array([space.to_unit(row.result.design) for row in table]).T
    np.testing.assert_allclose(np.array(drawn)[:, 0].reshape(3, 2), expected, atol=1e-12)
    assert len(table) == 2
    assert "MethodComparison(few, more" in repr(table)
    assert table.markdown().splitlines()[0].startswith("| method")
