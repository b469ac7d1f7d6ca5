"""LQR by the logs of finished runs beside what they left in service: ``python -m gallery.by_logs FOLDER ...``.

From the folder ``benchmarks``; each FOLDER is one of `gallery.run`. The law is `identified_lqr` at the design in
service, by all logs of the run, by the last alone and by the first alone.
"""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ccdtools import Trajectory
from ccdtools.controllers import load_policy
from ccdtools.scenario import Scenario
from ccdtools.statistics import paired_difference
from ccdtools.studies import RunFolder
from ccdtools.twin import identified_lqr
from ccdtools.twin.limits_kept import violation
from gallery.measure import RUNS, SEED, study_of
from gallery.reference import STUDIES
from mpc import NotStabilisableError


def row(folder: Path) -> list[str]:
    """Cells of a run: gains over what is in service in per cent of its return, on common runs of the real plant."""
    study = study_of(next(name for name in STUDIES if folder.name.startswith(name + "-")))
    problem, real, kept = study.problem(), study.real, RunFolder(folder)
    service = load_policy(folder / "policy.safetensors")
    count = len(json.loads((folder / "results.json").read_text())["generations"])
    logs = [Trajectory(**kept.read_stage(f"deployment-{k}").arrays, dt=study.plant.dt) for k in range(1, count + 1)]
    x0, w = np.tile(real.x0, (RUNS, 1)), real.disturbance.sample(RUNS, real.steps, np.random.default_rng(SEED))
    scenario = Scenario(real.plant, x0, w)

    def run(law: Any) -> Trajectory:
        return scenario.run(law, design=service.design, limit=problem.limit)

    before = run(service)
    size = abs(before.returns(study.objective).mean())
    cells = [folder.name, f"{-size:.2f}"]
    for told in (logs, logs[-1:], logs[:1]):
        try:
            after = run(identified_lqr(problem, service.design, told))
        except NotStabilisableError:
            cells.append("no LQR")
            continue
        gain = paired_difference(after.returns(study.objective), before.returns(study.objective))
        percent = [100 * value / size for value in (gain.mean, *gain.ci95)]
        broken = violation(problem, scenario, after, before, problem.model)
        more = int(after.diverged.sum() - before.diverged.sum())
        cells.append("{:+.2f} [{:+.2f}, {:+.2f}]".format(*percent) + (f", {more} more runs lost" if more > 0 else "")
                     + ("" if broken is None else f", breaks a limit: {broken}"))  # fmt: skip
    return cells


def main(folders: Sequence[str]) -> None:
    """Print a row per run."""
    warnings.simplefilter("ignore")
    print("| run | in service | LQR by all logs | by the last | by the first |\n|" + "---|" * 5)
    for folder in folders:
        print(f"| {' | '.join(row(Path(folder)))} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
