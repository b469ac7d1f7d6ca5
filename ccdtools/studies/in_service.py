"""What is in service after each generation, and where."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from ccdtools.arrays import Array, Mask
from ccdtools.scenario import Scenario
from ccdtools.statistics import change_of_level
from ccdtools.studies.held_out import GenerationRecord, places_of
from ccdtools.studies.report.gains import service_table
from ccdtools.studies.stage_storage import Stage
from ccdtools.twin.distributions import BOX

if TYPE_CHECKING:
    from ccdtools.studies.evaluation import Evaluation
    from ccdtools.twin.deployable import Deployable


class InService:
    """Returns of what was in service, where no policy is driven twice in one place."""

    def __init__(self) -> None:
        self._driven: dict[str, tuple[Evaluation, Array, list[tuple[Deployable, Mask, Array]]]] = {}

    def stage(self, evaluation: Evaluation, history: Sequence[GenerationRecord]) -> Stage:
        """Returns after each generation, and their changes on common runs.

        A row for each place, the real plant and the model, which is the nominal one or as identified last.
        """
        rows = []
        for name, scenario in _places(evaluation, history[-1].after.design):
            runs = [self._driven_in(evaluation, name, scenario, record.after) for record in history]
            kept = ~np.any([diverged for diverged, _ in runs], axis=0)
            rewards = [own[kept] for _, own in runs]
            paid = [float(evaluation.study.objective.cost_of_design(record.after.design, scenario.steps))
                    for record in history]  # fmt: skip
            changes = [change_of_level(after - before, before, runs=len(kept)) for before, after in pairwise(rewards)]
            rows.append({
                "place": name, "runs": len(kept), "steps": scenario.steps, "left_out": 1 - kept.mean(),
                "means": [one.sum(axis=1).mean() if len(one) else None for one in rewards], "design_costs": paid,
                "changes": [asdict(change) for change in changes],
            })  # fmt: skip
        table = [f"{heading}: {'; '.join(cells)}" for heading, *cells in service_table({"in_service": rows})]
        return Stage({"rows": rows, "report": table})

    def _driven_in(
        self, evaluation: Evaluation, name: str, scenario: Scenario, one: Deployable
    ) -> tuple[Mask, Array]:  # fmt: skip
        """Which runs diverged (n,), and rewards (n, T)."""
        known = self._driven.get(name)
        if known is None or known[0] is not evaluation or not np.array_equal(known[1], scenario.x0):
            known = self._driven[name] = (evaluation, scenario.x0, [])
        for other, diverged, rewards in known[2]:
            if other.same_as(one):
                return diverged, rewards
        run = scenario.run(evaluation.deployed(one), design=one.design, limit=evaluation.problem.limit)
        rewards = run.rewards(evaluation.study.objective)
        known[2].append((one, run.diverged, rewards))
        return run.diverged, rewards


def _places(evaluation: Evaluation, design: Array) -> Iterator[tuple[str, Scenario]]:
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
