"""After each generation stands what is in service, on the same runs as before, and no policy is driven twice there."""

from types import SimpleNamespace

import numpy as np
import pytest
from small_runs import tiny_configuration
from spring_run import run_spring

from ccdtools.scenario import Scenario
from ccdtools.studies import RunFolder, load_study
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.in_service import InService
from ccdtools.twin.deployable import Deployable


@pytest.mark.long
def test_a_run_has_the_table_after_each_generation(stored):
    folder = RunFolder(stored("spring", run_spring) / "run")
    first, second = (folder.read_stage(f"in-service-{g}").values for g in (1, 2))
    assert second["rows"] == folder.read_json("results.json")["in_service"]
    for row, after in zip(first["rows"], second["rows"]):
        assert (row["place"], len(row["means"]), len(after["means"])) == (after["place"], 2, 3)
    real = [row["place"].endswith("real plant") for row in first["rows"]]
    assert any(real)
    assert not all(real)
    assert len(first["report"]) == len(first["rows"])


@pytest.mark.check
def test_no_policy_is_driven_twice_in_one_place(stored, monkeypatch):
    place = stored("spring", run_spring)
    study = load_study(place / "spring.py")
    evaluation = Evaluation(study, tiny_configuration(study), 0)
    agent = RunFolder(place / "run").read_stage("codesign-1").networks["agent"]
    driven = []
    run = Scenario.run
    monkeypatch.setattr(Scenario, "run", lambda self, *a, **k: driven.append(self) or run(self, *a, **k))
    one, other = (SimpleNamespace(after=Deployable(agent, np.array(p))) for p in ([2.0], [3.0]))
    service = InService()
    rows = service.stage(evaluation, [one, one]).values["rows"]
    once, places = len(driven), len(rows)
    assert once == places + 1  # one run searches the box of starts
    assert rows[0]["changes"][0]["mean"] == 0.0
    again = service.stage(evaluation, [one, one, other]).values["rows"]
    assert len(driven) == once + places + 1  # the box of the other design is searched again, and is the same
    fresh = InService().stage(evaluation, [one, one, other]).values["rows"]
    assert again == fresh
    assert again[0]["means"][0] == pytest.approx(rows[0]["means"][0])


def test_another_box_of_starts_is_driven_in_by_all(stored, monkeypatch):
    place = stored("spring", run_spring)
    study = load_study(place / "spring.py")
    evaluation = Evaluation(study, tiny_configuration(study), 0)
    agent = RunFolder(place / "run").read_stage("codesign-1").networks["agent"]
    one, other = (SimpleNamespace(after=Deployable(agent, np.array([k]))) for k in (2.0, 3.0))
    own = evaluation.served.box
    monkeypatch.setattr(type(evaluation.served), "box", lambda _, design, rng: own(design, rng) / design)
    service = InService()
    service.stage(evaluation, [one])
    kept = service.stage(evaluation, [one, other]).values
    assert kept == InService().stage(evaluation, [one, other]).values
