"""Budget of a reproduction, and the two studies that it is of."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

from ccdtools.disturbances.disturbance import Recorded
from ccdtools.disturbances.recordings import read_disturbance
from ccdtools.studies.loading import load_study
from ccdtools.studies.study import Study

CASES = ("illustrative", "suspension")
ROAD = "dz_dt_mild_driver1.csv"  # ż₀ that the authors released, which is not part of this project
EPOCHS = 100  # of the preset paper, of its 10 000
UPDATES = 2  # of the policy while it is deployed


@dataclass(frozen=True)
class Budget:
    """How much is computed, and on which road.

    Attributes
    ----------
    quick : bool
        Few samples and two seeds: every row, for tests.
    paper : bool
        All of the paper's 10 000 epochs for the preset ``paper``, and four updates of a deployed policy.
    road : str
        File of the recorded road; empty where it is not at hand.
    """

    quick: bool = False
    paper: bool = False
    road: str = ""

    @property
    def seeds(self) -> int:
        """Number of seeds of every co-design."""
        return 2 if self.quick else 5

    @property
    def runs(self) -> int:
        """Rollouts of a measurement; the paper has as many."""
        return 100 if self.quick else 1000

    def study(self, case: str) -> Study:
        """Case study, of the suspension on the recorded road if there is one."""
        study = load_study(case)
        if case != "suspension" or not self.road:
            return study
        recorded = Recorded(read_disturbance(self.road, dt=study.plant.dt))
        return replace(study, real=replace(study.real, disturbance=recorded))


def recorded_road() -> str:
    """File of the released road; empty if there is none.

    It is looked for in the folder CCDTOOLS_DATA, or beside the repository.
    """
    folder = os.environ.get("CCDTOOLS_DATA") or Path(__file__).parents[4] / "shared" / "data"
    path = Path(folder, ROAD)
    return str(path.resolve()) if path.is_file() else ""
