"""Comparisons, and gains by source, where no generation has been."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.comparison.metrics import MetricChange, metric_changes
from ccdtools.controllers.controllers import Controller
from ccdtools.exceptions import InputError
from ccdtools.scenario import Scenario
from ccdtools.statistics import change_of_level
from ccdtools.studies.budgets import REAL_RUNS
from ccdtools.studies.names import SOURCES
from ccdtools.studies.redesign import same_design
from ccdtools.studies.stage_storage import Stage
from ccdtools.studies.trust_region import Trust
from ccdtools.twin.distributions import START

if TYPE_CHECKING:
    from ccdtools.studies.evaluation import Evaluation
    from ccdtools.studies.service import Deployed
    from ccdtools.twin.deployable import Deployable
    from ccdtools.twin.residuals import Residuals

Step: TypeAlias = tuple[str, Controller, Array]  # source of a change, the controller changed to, and its design


@dataclass(frozen=True, eq=False)
class GenerationRecord:
    """Generation as designed, what is deployed at its end, and what it hands on.

    The start counts as a generation: both are the first policy at the first design. `stayed` says whether what was
    deployed stayed.
    """

    designed: Deployable
    after: Deployable
    stayed: bool = True
    served: Deployed | None = None  # reference deployment of what is deployed
    trust: Trust = field(default_factory=Trust)
    stages: Mapping[str, Stage] = field(default_factory=dict)  # by kind


def gains_by_place(evaluation: Evaluation, history: Sequence[GenerationRecord]) -> Stage:
    """Gains by source in every place."""
    steps = steps_of(evaluation, history)
    places = places_of(evaluation)
    return Stage({"gains": [{"place": name} | gains_in(evaluation, one, steps) for name, one in places.items()]})


def compared(
    evaluation: Evaluation, rng: np.random.Generator, generation: int, designed: Deployable, deployed: Deployable,
    logs: Sequence[Residuals], known: Sequence[Residuals], held_out: bool,
) -> Stage:  # fmt: skip
    """Comparison at one design, and on held-out runs if asked.

    There, baselines know the logs of this deployment, too.
    """
    stage = evaluation.comparison(rng, generation, designed, deployed, logs)
    more = {"held_out": held_out_rows(evaluation, generation, deployed, known)} if held_out else {}
    return replace(stage, values=stage.values | more)


def places_of(evaluation: Evaluation) -> dict[str, Scenario]:
    """Places on the real plant where gains are measured.

    The deployment or runs like it, every held-out disturbance, and the study's start if the deployment has another.
    """
    deployed = evaluation.on_real()
    study = evaluation.study
    single = study.real.runs == 1
    own = {"deployed drive": deployed} if single else {"real plant": deployed.first(REAL_RUNS)}
    if study.starts is None and np.array_equal(study.real.x0, study.x0):
        return own | evaluation.held_out
    rng = evaluation.rng(START)
    x0, w = evaluation.problem.scenarios.sample(REAL_RUNS, study.steps, rng)
    return own | evaluation.held_out | {START: Scenario(study.real.plant, x0, w)}


def formerly_deployed(history: Sequence[GenerationRecord], current: Deployable) -> dict[str, Deployable]:
    """Formerly deployed by name, each once and without today's.

    What a deployment has shown to fall short is left out.
    """
    known = [current, *(record.designed for record in history if not record.stayed)]
    found: dict[str, Deployable] = {}
    for number, record in enumerate(history):
        if not any(record.after.same_as(one) for one in known):
            found[f"generation {number}" if number else "the start"] = record.after
            known.append(record.after)
    return found


def held_out_rows(
    evaluation: Evaluation, generation: int, service: Deployable, logs: Sequence[Residuals]
) -> list[dict[str, Any]]:
    """Comparison rows of one design on every held-out disturbance."""
    everyone = evaluation.baselines(service.design, logs) | {"learned": evaluation.deployed(service)}
    rows = []
    for name, scenario in list(places_of(evaluation).items())[1:]:
        place = {"plant": f"held out: {name}", "model": name, "generation": generation}
        rows += evaluation.rows(everyone, scenario, service.design, place, mpc_runs=2)
    return rows


def steps_of(evaluation: Evaluation, history: Sequence[GenerationRecord]) -> list[Step]:
    """Steps from LQR at the first design to the last deployed.

    The first generation brings a design (LQR there against LQR at the start) and a policy (against that LQR). A later
    one that stayed brings its redesign; updates while deployed come last. What was rolled back, or changed nothing,
    brings nothing.
    """
    start = history[0].after.design
    first = history[1]
    steps: list[Step] = [
        (source, saturated_lqr(evaluation.problem, design), design)
        for source, design in ((SOURCES[0], start), ("design", first.designed.design))
    ]
    changes = [("policy", first.designed), ("updates", first.after)]
    for former, generation in pairwise(history[1:]):
        if not generation.after.same_as(former.after):
            if same_design(evaluation.problem.design, generation.after.design, generation.designed.design):
                changes.append(("redesign", generation.designed))
            changes.append(("updates", generation.after))
    for (_, before), (source, after) in pairwise([("", history[0].after), *changes]):
        if source == "policy" or not after.same_as(before):
            steps.append((source, evaluation.deployed(after), after.design))
    return steps


def gains_in(evaluation: Evaluation, scenario: Scenario, steps: Sequence[Step]) -> dict[str, Any]:
    """Gains by source on the runs of a scenario; see `gains_by_source`."""
    limit = evaluation.problem.limit
    runs = [scenario.run(controller, design=design, limit=limit) for _, controller, design in steps]
    kept = ~np.any([run.diverged for run in runs], axis=0)
    rewards = [run.rewards(evaluation.study.objective)[kept] for run in runs]
    gains = gains_by_source([source for source, *_ in steps], rewards, runs=len(scenario.x0))
    paid = float(evaluation.study.objective.cost_of_design(runs[0].design, scenario.steps))
    metrics = evaluation.study.metrics
    changes: Sequence[MetricChange] = () if metrics is None else metric_changes(metrics, runs[0], runs[-1])
    of = {"runs": len(scenario.x0), "steps": scenario.steps, "left_out": 1 - kept.mean(), "design_cost": paid}
    return of | gains | {"metrics": [asdict(change) for change in changes]}


def gains_by_source(sources: Sequence[str], rewards: Sequence[Array], *, runs: int | None = None) -> dict[str, Any]:
    """Gains from the first to the last of several controllers, on the same runs.

    Under "start" stands the mean return of the first. Under each source stands what it has changed, with the interval
    at the level of these runs (`change_of_level`): divided by |start| it is that of a part of the first return. The
    means add up to that under "total", last minus first.

    Parameters
    ----------
    sources : sequence of str
        What the change to each of them is due to: "start" for the first, then "design", "policy", "updates" or
        "redesign", each as often as it occurs.
    rewards : sequence of (n, T) arrays
        Of each of them.
    runs : int, optional
        Runs that were begun, where some have been left out; see `summarise_returns`.

    Raises
    ------
    InputError
        If the sources are others, or not as many as the rewards.
    """
    if not sources or sources[0] != SOURCES[0] or not set(sources[1:]) <= set(SOURCES[1:]):
        raise InputError("sources", list(sources), f"{SOURCES[0]!r}, then any of {', '.join(SOURCES[1:])}")
    if len(sources) != len(rewards):
        raise InputError("rewards", f"{len(rewards)}", f"{len(sources)}, one per source")
    first = rewards[0]
    changes = dict.fromkeys(SOURCES[1:], np.zeros_like(first))
    for source, (before, after) in zip(sources[1:], pairwise(rewards), strict=True):
        changes[source] = changes[source] + (after - before)
    changes["total"] = rewards[-1] - first
    start = float(first.sum(axis=1).mean()) if len(first) else float("nan")
    return {"start": start} | {
        source: asdict(change_of_level(change, first, runs=runs)) for source, change in changes.items()
    }
