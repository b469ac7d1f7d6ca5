"""Finished run folder, as the report needs it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.studies.budgets import SET_SECONDS
from ccdtools.studies.run_folder import RunFolder
from ccdtools.studies.study import Study
from invariant_sets import ParametricSet

if TYPE_CHECKING:
    from ccdtools.co_design.result import History
    from ccdtools.figure_style import Figure


@dataclass(frozen=True, eq=False)
class ReportFigure:
    """Figure with file name, title and caption."""

    name: str
    title: str
    caption: str
    figure: Figure


@dataclass(frozen=True, eq=False)
class FinishedRun:
    """Finished run folder, as the figures need it."""

    study: Study
    folder: RunFolder
    results: dict[str, Any]

    @property
    def last(self) -> int:
        """Number of generations."""
        return len(self.results["generations"])

    @property
    def quick(self) -> bool:
        """Whether the run took fewer samples."""
        return bool(self.results["quick"])

    @cached_property
    def problem(self) -> CoDesignProblem:
        """Co-design problem on the nominal model."""
        return self.study.problem()

    @cached_property
    def sets(self) -> ParametricSet:
        """Sets X_fea(p), each computed within `SET_SECONDS`."""
        from ccdtools.co_design.expert import feasible_sets  # loads torch

        return replace(feasible_sets(self.problem), time_limit=SET_SECONDS)

    @cached_property
    def designs(self) -> list[Array]:
        """Start design and those of every generation."""
        space = self.problem.design
        return [np.asarray(self.study.p0)] + [space.from_dict(g["design"]) for g in self.results["generations"]]

    @cached_property
    def histories(self) -> list[History]:
        """Histories of all co-designs."""
        from ccdtools.co_design.result import History  # loads torch

        names = History.__dataclass_fields__
        stages: list[Any] = [self.folder.read_stage(f"codesign-{g}").arrays for g in range(1, self.last + 1)]
        return [History(**{name: arrays[f"history_{name}"] for name in names}) for arrays in stages]

    @cached_property
    def chosen(self) -> list[int]:
        """Row of every history that its co-design returned: the best of those at the returned design."""
        rows = []
        for history, design in zip(self.histories, self.designs[1:]):
            unit = self.problem.design.to_unit
            away = np.abs(unit(history.design) - unit(design)).max(axis=1)
            score = np.where(np.isfinite(history.model_return), history.model_return, -np.inf)
            rows.append(int(np.where(away <= away.min() + 1e-6, score, -np.inf).argmax()))
        return rows

    def describe(self, design: Array) -> str:
        """Text of one design with its units."""
        return self.problem.design.describe(design)

    @property
    def time_label(self) -> str:
        """Label of a time axis."""
        return "time [s]" if self.study.plant.continuous else "sample"
