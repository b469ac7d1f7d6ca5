"""Studies of designs with constraints, fixed entries and whole numbers."""

import json
from dataclasses import replace
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest
import small_runs
from matplotlib.collections import QuadMesh
from matplotlib.contour import ContourSet
from typer.testing import CliRunner

from ccdtools import CoDesignProblem, DesignSpace, FixedStart, InputError
from ccdtools.cli import app
from ccdtools.co_design.landscape import Landscape
from ccdtools.co_design.result import History
from ccdtools.studies import preparation
from ccdtools.studies.preparation import jsonable_of
from ccdtools.studies.report.landscape import landscape
from ccdtools.studies.report.return_figures import history as history_figure
from ccdtools.studies.report.set_figure import feasible_set_figure
from ccdtools.studies.trust_region import within
from invariant_sets import Polytope, Status

SPACE = (
    'DesignSpace(["k", "n", "c"], [1, 1, 2], [4, 5, 2], constraints=lambda p: p[0] + p[1] - 6.0, '
    'constraint_names=["budget"], integer=["n"])'
)
SOURCE = (
    small_runs.SPRING.replace("-p * x[0] + u + w", "-p[0] * x[0] - p[2] * x[1] + p[1] * u + w")
    .replace('ca.SX.sym("p")', 'ca.SX.sym("p", 3)')
    .replace('DesignSpace(["k"], [1], [4])', SPACE)
)


def study(p0):
    """The study of a spring with that first design."""
    names = {}
    exec(SOURCE.replace("p0=[2]", f"p0={p0}"), names)
    return names["study"]


def problem(p0=(2, 2, 2)):
    """Its co-design problem."""
    own = study(list(p0))
    return CoDesignProblem(
        own.model, X=own.X, U=own.U, objective=own.objective, scenarios=FixedStart(own.x0, own.disturbance), steps=10
    )


@pytest.mark.parametrize(
    ("p0", "message"),
    [
        ([3, 5, 2], "p0: got k = 3, n = 5, c = 2 with budget = 2, expected constraints ≤ 0"),
        ([3, 2.5, 2], "p0: got n = 2.5, expected a whole number"),
        ([3, 2, 2.5], r"p0: got c = 2.5, expected a value in \[2, 2\]"),
    ],
)
def test_a_first_design_that_cannot_be_built_is_refused(p0, message):
    with pytest.raises(InputError, match=message):
        study(p0)


def test_a_trust_region_keeps_what_a_design_has_to_keep():
    whole = problem()
    near = within(whole, np.array([2.0, 4.0, 2.0]), 0.25).design
    np.testing.assert_allclose([near.lower, near.upper], [[1.25, 3, 2], [2.75, 5, 2]])
    assert near.integer == ("n",)
    assert near.constraint_names == ("budget",)
    np.testing.assert_allclose(near.project([2.75, 5, 2]), [2, 4, 2])  # five would leave a k of one


@pytest.mark.check
def test_a_network_observes_a_fixed_entry_as_zero():
    lower, upper = problem().observation_bounds
    assert (lower < upper).all()
    assert (lower + upper)[-1] / 2 == 2.0
    zero = DesignSpace(["a", "n", "c"], [1, 1, 0], [4, 5, 0])
    lower, upper = replace(problem(), model=problem().model.within(zero)).observation_bounds
    assert (lower[-1], upper[-1]) == (-1, 1)


def test_a_run_is_told_apart_by_its_constraints_and_an_older_one_is_continued():
    plain = DesignSpace(["a"], [1], [2])
    assert set(jsonable_of(plain)) == {"kind", "names", "lower", "upper", "units"}
    one, other = (jsonable_of(DesignSpace(["a"], [1], [2], constraints=lambda p, b=b: p[0] - b)) for b in (1.5, 1.6))
    assert one != other
    assert jsonable_of(DesignSpace(["a"], [1], [2], integer=["a"])) != jsonable_of(plain)


def test_the_course_of_a_design_is_drawn_without_its_fixed_entries():
    designs = np.array([[2.0, 2, 2], [3.0, 2, 2]])
    history = History(*(np.arange(2.0) for _ in range(2)), designs, *(np.zeros(2) for _ in range(3)))
    run = SimpleNamespace(
        problem=problem(), last=1, quick=True, histories=[history], chosen=[1],
        results={"generations": [{"model": "nominal"}]},
    )  # fmt: skip
    [figure] = history_figure(run)
    assert [ax.get_ylabel() for ax in figure.figure.axes] == ["return", "k", "n"]


@pytest.mark.parametrize("bounds", [(1.5, 2.4), (2.0 + 1e-12, 3.9)])
def test_a_landscape_is_drawn_over_what_can_be_chosen_where_only_one_whole_number_is_left(bounds):
    low, high = bounds
    space = DesignSpace(["k", "n", "c"], [1, low, 2], [4, high, 2], integer=["n"])
    whole = replace(problem(), model=problem().model.within(space))
    [figure] = landscape_of(whole, np.array([2.0, 2, 2]))
    assert "n = 2, c = 2" in figure.caption
    assert "constraint" not in figure.caption
    two = high > 3
    assert figure.figure.axes[0].get_ylabel() == ("n" if two else "return, nominal model")
    plt.close(figure.figure)


def landscape_of(whole, design):
    """The figure of the landscape of a run whose design never moved."""
    history = SimpleNamespace(design=design[None])
    run = SimpleNamespace(
        problem=whole, study=SimpleNamespace(model=whole.model, steps=5, objective=whole.objective), quick=True,
        results={"seed": 0}, histories=[history], chosen=[0], designs=[design, design], describe=whole.design.describe,
    )  # fmt: skip
    return landscape(run)


@pytest.mark.check
def test_a_report_names_what_a_design_keeps_and_what_holds_it(tmp_path, monkeypatch):
    """From the command to the page: a fixed entry, a whole number and a budget that is spent at the start."""
    monkeypatch.setattr(preparation, "configuration", small_runs.tiny_configuration)
    source = tmp_path / "constrained.py"
    source.write_text(SOURCE.replace("p0=[2]", "p0=[2, 4, 2]"))
    call = ["run", str(source), "--quick", "--generations", "1", "--output", str(tmp_path / "run")]
    done = CliRunner().invoke(app, call)
    assert done.exit_code == 0, done.output
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    assert results["design_space"]["constraints"] == ["budget"]
    assert results["design_space"]["integer"] == ["n"]
    first = [row for row in results["comparison"] if row["generation"] == 0]
    assert [row["active_constraints"] for row in first] == [{"budget": 0.0}] * len(first)
    design = results["generations"][0]["design"]
    assert design["n"] == round(design["n"])
    assert design["k"] + design["n"] <= 6.0
    assert design["c"] == 2.0
    page = (tmp_path / "run" / "report.html").read_text()
    assert "Constraints of the design, each to be ≤ 0: budget." in page
    assert "Whole numbers: n." in page
    assert "active constraints: budget" in page
    assert "start: k = 2, n = 4, c = 2; active bounds: none; active constraints: budget" in done.output


def whole_problem(**space):
    """Springs whose number is whole, behind a stiffness."""
    options = {"lower": [1, 2, 2], "upper": [4, 6, 2]} | space
    return replace(problem(), model=problem().model.within(DesignSpace(["k", "n", "c"], integer=["n"], **options)))


def test_nothing_is_drawn_between_whole_numbers():
    [figure] = landscape_of(whole_problem(), np.array([2.0, 3, 2]))
    ax = figure.figure.axes[0]
    assert ax.get_ylabel() == "n"
    [cells] = [one for one in ax.collections if isinstance(one, QuadMesh)]
    corners = cells.get_coordinates()[:, 0, 1]
    np.testing.assert_allclose(corners, np.arange(2, 8) - 0.5)
    assert not any(isinstance(one, ContourSet) for one in ax.collections)
    assert "nothing between" in figure.caption
    plt.close(figure.figure)
    [curve] = landscape_of(whole_problem(lower=[2, 2, 2], upper=[2, 600, 2]), np.array([2.0, 3, 2]))
    line = next(one for one in curve.figure.axes[0].lines if len(one.get_xdata()) > 5)
    shown = line.get_xdata()
    assert line.get_linestyle() == "None"
    np.testing.assert_array_equal(shown, np.round(shown))
    assert 3 in shown
    plt.close(curve.figure)


def test_a_landscape_has_no_height_between_whole_numbers():
    landscape = Landscape(whole_problem(), np.random.default_rng(0), runs=4)
    between, at = landscape.returns([[0.5, 0.4, 0.0], [0.5, 0.5, 0.0]])
    assert between == -np.inf
    assert np.isfinite(at)


def test_sets_are_drawn_for_designs_that_can_be_built():
    space = whole_problem(constraints=lambda p: p[0] + p[1] / 2 - 5.4).design
    asked = []

    def result(design):
        """A set of its own for each design that is asked for."""
        asked.append(design)
        size = 1.0 + design.sum() / 20
        return SimpleNamespace(set=Polytope.from_bounds([-size] * 2, [size] * 2), status=Status.CONVERGED)

    first = np.array([2.0, 3, 2])
    X = Polytope.from_bounds([-3, -3], [3, 3])
    plant = SimpleNamespace(nx=2, linear=True, state_names=["a", "b"])
    run = SimpleNamespace(
        problem=SimpleNamespace(design=space, state_limits=lambda p: X), designs=[first, first], last=1,
        describe=space.describe, quick=True, results={"configuration": {"sets": "auto"}},
        sets=SimpleNamespace(result=result), study=SimpleNamespace(plant=plant, X=X),
    )  # fmt: skip
    [figure] = feasible_set_figure(run)
    assert space.feasible(np.array(asked)).all()
    drawn = [text.get_text() for text in figure.figure.legends[0].get_texts()]
    assert any(label.startswith("near the upper corner") for label in drawn)
    assert "the nearest that can stands for it" in figure.caption
    plt.close(figure.figure)
