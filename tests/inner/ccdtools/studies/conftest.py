"""Runs of which reports are written."""

from dataclasses import replace

import pytest
from small_runs import tiny
from spring_run import run_spring
from two_masses import two_masses

from ccdtools.studies import Generations, RunFolder, Study, configuration
from ccdtools.studies.report.report import write_report


def finished(study: Study, path):
    """Make a run of hardly any iterations that is not called quick, and its report."""
    config = replace(tiny(configuration(study, quick=True)), quick=False, sets_time_limit=2.0)
    folder = RunFolder.create(path)
    Generations(study, config, folder, generations=1, seed=3, echo=lambda line: None, progress=False).run()
    write_report(study, folder)


def read(path):
    """The folder of a finished run and its results."""
    folder = RunFolder(path / "run")
    return folder, folder.read_json("results.json")


@pytest.fixture(scope="module")
def spring(stored):
    """A quick run of two generations on two states."""
    return read(stored("spring", run_spring))


@pytest.fixture(scope="module")
def masses(stored):
    """A run that is not quick, of a study that is in no file of the package."""
    return read(stored("masses", lambda place: finished(two_masses(), place / "run")))
