"""The first co-design alone, for many seeds: ``python -m gallery.first`` from the folder ``benchmarks``.

The stages are those of a whole run with the same seed, and give the same numbers; both starts share an initialisation.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from joblib import Parallel, delayed

from ccdtools.studies import configuration
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.stages import LoopStages
from ccdtools.studies.trust_region import Trust
from ccdtools.twin.deployable import Deployable
from ccdtools.twin.twin import DigitalTwin
from gallery.measure import Measured, measured_first, study_of
from gallery.reference import STUDIES, reference
from gallery.run import STARTS, Run
from gallery.table import table_of


def first_codesigns(name: str, seed: int, root: Path, starts: Sequence[str] = STARTS) -> None:
    """Initialise once, co-design from every start, and keep what was measured."""
    runs = [Run(name, start, seed, 1, False, root) for start in starts]
    missing = [run for run in runs if not _kept(run).is_file()]
    if not missing:
        return
    torch.set_num_threads(1)
    study = study_of(name)
    evaluation = Evaluation(study, configuration(study), seed)
    stages = LoopStages(evaluation, progress=False)
    begun = time.perf_counter()
    initial = stages.initialise(evaluation.rng("initialisation"))
    initialised = time.perf_counter() - begun
    for run in missing:
        design = np.array(reference(name)["worst_corner"]) if run.start == "corner" else study.p0
        begun = time.perf_counter()
        twin = DigitalTwin(study.model, scale=evaluation.problem.state_scale)
        service = Deployable(initial.networks["agent"], design, "the start")
        found = stages.co_design(evaluation.rng("codesign-1"), 1, service, twin, Trust())
        seconds = initialised + time.perf_counter() - begun
        note = {"measured": asdict(measured_first(name, found)), "seconds": seconds, "peak_bytes": 0}
        _kept(run).write_text(json.dumps(note, default=float))
        print(f"{run.folder.name}: {note['measured']['shortfall']:+.3f} %, {seconds:.0f} s", flush=True)


def _kept(run: Run) -> Path:
    """Where the measurements of a first co-design are kept."""
    return run.folder.with_suffix(".first.json")


def table(runs: Sequence[Run]) -> str:
    """The table of the first co-designs that are finished."""
    rows = []
    for run in runs:
        if _kept(run).is_file():
            note = json.loads(_kept(run).read_text())
            rows.append((run, Measured(**note["measured"]), note))
    return table_of(rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Carry out what was asked for, and print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studies", nargs="*", help=f"default: all of {', '.join(STUDIES)}")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--output", type=Path, default=Path("runs/gallery"))
    given = parser.parse_args(arguments)
    given.output.mkdir(parents=True, exist_ok=True)
    asked = [(study, seed) for seed in given.seeds for study in given.studies or STUDIES]
    Parallel(n_jobs=given.jobs)(delayed(first_codesigns)(study, seed, given.output) for study, seed in asked)
    text = table([Run(study, start, seed, 1, False, given.output) for study, seed in asked for start in STARTS])
    (given.output / "first.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
