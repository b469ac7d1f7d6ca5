"""What test_library_studies.py claims, seen from inside."""

import csv
import json
import warnings
from dataclasses import replace

import pytest
from small_runs import tiny_configuration

from ccdtools.studies import Generations, RunFolder, load_study
from ccdtools.studies.report.report import write_report


@pytest.mark.slow
def test_two_generations_of_a_vehicle_come_to_a_report_that_shows_how_it_rides(tmp_path):
    """Episodes of 20 steps, and hardly any iterations."""
    study = load_study("quarter_car")
    real = replace(study.real, runs=1, steps=500, held_out={"other": study.disturbance})
    study = replace(study, steps=20, real=real)
    config = replace(tiny_configuration(study, sets="none"), held_out_runs=2, held_out_steps=50)
    folder = RunFolder.create(tmp_path / "quarter_car")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Generations(study, config, folder, echo=lambda line: None, progress=False).run()
        page = write_report(study, folder).read_text(encoding="utf-8")
    results = json.loads((folder.path / "results.json").read_text(encoding="utf-8"))
    assert len(results["generations"]) == 2
    rows = [*results["comparison"], *results["held_out"]]
    assert all(0 < row["metrics"]["weighted body acceleration [m/s²]"] < 5 for row in rows)
    with (folder.path / "comparison.csv").open(encoding="utf-8") as file:
        assert "actuator power [W]" in next(csv.reader(file))
    blocks = {(row["generation"], row["plant"]) for row in rows}
    assert page.count("<th>weighted body acceleration [m/s²]</th>") == len(blocks)
