"""What is in service after each generation, and where."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from ccdtools.scenario import Scenario
from ccdtools.statistics import change_of_level
from ccdtools.studies.held_out import GenerationRecord, places_of
from ccdtools.twin.distributions import BOX

if TYPE_CHECKING:
    from ccdtools.studies.evaluation import Evaluation


def service_rows(evaluation: Evaluation, history: Sequence[GenerationRecord]) -> list[dict[str, Any]]:
    """Returns after each generation, and their changes on common runs.

    A row for each place, the real plant and the model, which is the nominal one or as identified last.
    """
    served = [record.after for record in history]
    limit, objective = evaluation.problem.limit, evaluation.study.objective
    rows = []
    for name, scenario in _places(evaluation, served[-1].design):
        runs = [scenario.run(evaluation.deployed(one), design=one.design, limit=limit) for one in served]
        kept = ~np.any([run.diverged for run in runs], axis=0)
        rewards = [run.rewards(objective)[kept] for run in runs]
        paid = [float(objective.cost_of_design(one.design, scenario.steps)) for one in served]
        changes = [change_of_level(after - before, before, runs=len(kept)) for before, after in pairwise(rewards)]
        rows.append({
            "place": name, "runs": len(kept), "steps": scenario.steps, "left_out": 1 - kept.mean(),
            "means": [one.sum(axis=1).mean() if len(one) else None for one in rewards], "design_costs": paid,
            "changes": [asdict(change) for change in changes],
        })  # fmt: skip
    return rows


def _places(evaluation: Evaluation, design: np.ndarray) -> Iterator[tuple[str, Scenario]]:
    """Places on the real plant, and on the model."""
    study, rng = evaluation.study, evaluation.rng(BOX)
    places = places_of(evaluation)
    x0 = evaluation.served.box(design, rng)
    if len(x0):
        w = study.real.disturbance.sample(len(x0), study.steps, rng)
        places = places | {BOX: Scenario(study.real.plant, x0, w)}
    for name, scenario in places.items():
        name = "as deployed" if name == "real plant" else name
        yield f"{name}, real plant", scenario
        if study.real.plant.nw == study.model.nw:
            yield f"{name}, model", Scenario(study.model, scenario.x0, scenario.disturbance)
