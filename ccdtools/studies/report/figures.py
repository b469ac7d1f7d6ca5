"""Figures of a report."""

from __future__ import annotations

from collections.abc import Iterator

from ccdtools import figure_style as style
from ccdtools.studies.report.finished_run import FinishedRun, ReportFigure
from ccdtools.studies.report.landscape import landscape
from ccdtools.studies.report.return_figures import changes, comparison, history
from ccdtools.studies.report.set_figure import feasible_set_figure
from ccdtools.studies.report.signal_figures import policy_surface, quantiles, trajectories


def figures(run: FinishedRun) -> Iterator[ReportFigure]:
    """Figures that the study can have."""
    for make in (changes, history, landscape, comparison, feasible_set_figure, policy_surface, trajectories, quantiles):
        with style.styled():
            made = make(run)
        yield from made
