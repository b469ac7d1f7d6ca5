"""What the report of a run says and draws of its sets."""

from types import SimpleNamespace

import numpy as np
import pytest
from two_masses import two_masses

from ccdtools import Plant
from ccdtools.studies.report import set_figure
from ccdtools.studies.report.finished_run import FinishedRun
from ccdtools.studies.report.report import render
from ccdtools.studies.report.set_figure import feasible_set_figure
from invariant_sets import Certificate, Polytope, SetResult, Status


def test_the_page_and_the_results_say_which_sets_the_samples_came_from(spring, masses):
    for folder, results in (spring, masses):
        sets = results["initialisation"]["sets"]
        assert sets["X_fea"] + sets["lqr"] + sets["X"] > 0
        assert f"Sets: {sets['text']}." in (folder.path / "report.html").read_text(encoding="utf-8")


def asked_for_no_sets(folder, results):
    """The same run, had it been asked for no sets."""
    return FinishedRun(two_masses(), folder, results | {"configuration": results["configuration"] | {"sets": "none"}})


def test_a_run_without_sets_draws_none_and_says_why(masses, monkeypatch):
    run = asked_for_no_sets(*masses)
    monkeypatch.setattr(FinishedRun, "sets", property(lambda self: pytest.fail("a set was asked for")))
    assert feasible_set_figure(run) == []
    assert "No figure of X_fea(p): the run was asked for sets = &#34;none&#34;." in render(run, [])


def test_a_figure_of_inner_sets_says_so(masses, monkeypatch):
    box = Polytope.from_bounds([-1.0] * 4, [1.0] * 4)
    inner = SetResult(box, box, Status.TIME_LIMIT, 1, Certificate(0.0, 1.0, 16))
    monkeypatch.setattr(FinishedRun, "sets", property(lambda self: SimpleNamespace(result=lambda design: inner)))
    (figure,) = feasible_set_figure(FinishedRun(two_masses(), *masses))
    assert "Not the largest, but a part of it" in figure.caption


def test_sets_of_a_plant_that_is_not_linear_are_called_those_of_its_linearisation(masses, monkeypatch):
    box = Polytope.from_bounds([-1.0] * 4, [1.0] * 4)
    found = SetResult(box, box, Status.CONVERGED, 1, Certificate(0.0, 0.0, 16))
    monkeypatch.setattr(FinishedRun, "sets", property(lambda self: SimpleNamespace(result=lambda design: found)))
    for linear, title in ((True, "Feasible sets"), (False, "Feasible sets of the linearisation")):
        monkeypatch.setattr(Plant, "linear", linear)
        (figure,) = feasible_set_figure(FinishedRun(two_masses(), *masses))
        assert figure.title == title
        assert ("which the plant itself may leave" in figure.caption) is not linear


def test_no_projection_is_drawn_of_sets_in_many_dimensions():
    assert [title for _, title in set_figure._cuts(2)] == [""]
    assert [title for _, title in set_figure._cuts(4)] == ["projection", "slice, other states 0"]
    assert [title for _, title in set_figure._cuts(8)] == ["slice, other states 0"]


@pytest.mark.parametrize(("nx", "pairs"), [(3, [(0, 2), (1, 2)]), (6, [(0, 1), (4, 5)])])
def test_sets_are_drawn_on_the_states_in_which_they_differ_most(nx, pairs):
    wider = np.ones(nx)
    wider[-1], wider[0] = 3.0, 1.5
    sets = {name: Polytope.from_bounds(-half, half) for name, half in (("one", np.ones(nx)), ("other", wider))}
    assert sorted(set_figure._most_different_pairs(sets, nx)) == pairs
