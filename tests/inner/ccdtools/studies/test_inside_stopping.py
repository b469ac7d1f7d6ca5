"""A run that stops by itself, and says so in its report."""

import re
from dataclasses import replace

import pytest

from ccdtools import Gaussian
from ccdtools.studies import Generations, RedesignCost, RunFolder, configuration
from ccdtools.studies.report.report import write_report


@pytest.mark.check
def test_a_run_stops_by_itself_where_no_redesign_is_worth_its_cost(illustrative, tmp_path):
    gusts = {"gusts": Gaussian([0.2, 0.2])}
    real = replace(illustrative.real, plant=illustrative.plant, disturbance=illustrative.disturbance, held_out=gusts)
    terms = RedesignCost(cost=200.0, serves=500, unit="EUR", worth=1.0)
    study = replace(illustrative, real=real, redesign_cost=terms)
    said = []
    run = Generations(study, configuration(study, quick=True), RunFolder(tmp_path / "run"), generations=4, seed=0,
                      progress=False, echo=said.append)  # fmt: skip
    results = run.run()
    assert len(results["generations"]) == 1
    assert {row["generation"] for row in results["held_out"]} == {0, 1}
    assert results["stopped"]["status"] == "stop"
    assert any(line.startswith("Generation 2: ") and ": stop, worth 0 EUR" in line for line in said), said
    page = write_report(study, RunFolder(tmp_path / "run")).read_text(encoding="utf-8")
    assert re.search(r"The run stopped by itself: [a-z ]+: stop, worth 0 EUR", page)
