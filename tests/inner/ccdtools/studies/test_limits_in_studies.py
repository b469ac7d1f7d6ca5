"""State limits and the filter, from the command line to the page."""

from dataclasses import replace

import numpy as np
import pytest
from spring_run import run_spring

from ccdtools import InputError, load_study
from ccdtools.cli import Options
from ccdtools.studies import RunFolder


@pytest.fixture(scope="module")
def filtered(stored):
    """A finished run with a filter and a tolerance of nothing."""
    return RunFolder(stored("spring", run_spring) / "run")


def test_the_deployed_filter_stands_beside_the_policy_without_it(filtered):
    results = filtered.read_json("results.json")
    where = {(r["plant"], r["generation"]) for r in results["comparison"] if r["controller"] == "learned, no filter"}
    assert where == {("real", 0), ("real", 1), ("real", 2)}
    assert "learned, no filter" in (filtered.path / "report.html").read_text(encoding="utf-8")


def test_the_results_say_how_the_limits_were_kept(filtered):
    generation = filtered.read_json("results.json")["generations"][-1]
    limits = generation["limits"]
    assert limits["tolerance"] == {"fraction": 0.0, "depth": 0.0}
    assert limits["source"] == "asked for"
    assert limits["kept"] == (limits["achieved"]["fraction"] == 0)
    page = (filtered.path / "report.html").read_text(encoding="utf-8")
    assert limits["kept"] or limits["text"].split(":")[0] in page


def test_a_study_states_its_tolerance_and_its_filter(illustrative):
    study = replace(illustrative, limit_tolerance=(0.1, 0.2))
    assert study.problem().limit_tolerance == (0.1, 0.2)
    assert load_study("illustrative").problem().limit_tolerance == "mpc"
    for changes, message in (({"filter": "safe"}, "filter: got 'safe'"), ({"limit_tolerance": 3}, "limit_tolerance: ")):
        with pytest.raises(InputError, match=message):
            replace(illustrative, **changes)


def test_options_read_the_tolerance():
    assert Options("illustrative", limits="0.01,0.05").limit_tolerance() == (0.01, 0.05)
    assert Options("illustrative", limits="off").limit_tolerance() == "off"
    assert Options("illustrative").limit_tolerance() is None
    assert np.isfinite(Options("illustrative", limits="1, 0").limit_tolerance()).all()
