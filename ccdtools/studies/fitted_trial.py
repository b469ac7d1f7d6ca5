"""Comparison at the end of a run on sensors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.co_design.objective import Objective
from ccdtools.co_design.output_filter import estimator_at
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.comparison.metrics import Metrics, metric_changes, metrics_of
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.controllers.observed import Observed
from ccdtools.disturbances.combinations import is_recorded
from ccdtools.evidence.percent import nothing_done
from ccdtools.scenario import Scenario
from ccdtools.studies.by_fit import FittedGeneration
from ccdtools.studies.on_sensors import LQG, OnSensors
from ccdtools.studies.side_by_side import START
from ccdtools.studies.side_by_side_run import Place, Trial
from ccdtools.studies.stage_storage import Stage, log_of
from ccdtools.trajectory import Trajectory
from ccdtools.twin.unknown_plant import stated_plant
from mpc import MPCError

NESTED = "nested LQR"  # a design
TOLD = ", of the fit"  # ends the name of a law that knows what the log told
COST = "cost of a sample"


@dataclass(frozen=True, eq=False)
class DriveTrial:
    """Comparison on one drive.

    Beside it the first output (T,) of a run by who drove it, and what is to be known of them.
    """

    trial: Trial
    signals: dict[str, Array]
    notes: tuple[str, ...]


def generation_of(study: OnSensors, kept: Stage) -> FittedGeneration:
    """Generation of a stage, without its fit."""
    design, agent = kept.arrays["design"], kept.networks["agent"]
    log = log_of(kept, study.plant.dt)
    estimator = estimator_at(problem_of(study, kept.arrays["known"]), design)
    return FittedGeneration(design, Observed(LearnedPolicy(agent, design), estimator), log, agent=agent)


def law_runs(
    study: OnSensors, scenarios: Mapping[str, Scenario], designs: Mapping[str, Array], known: Sequence[float] | Array,
    names: Sequence[str],
) -> dict[str, dict[Place, Trajectory]]:  # fmt: skip
    """Runs by drive of laws at each design.

    They are made for what is known, and stand behind its filter: the nominal plant, or one of unknown entries (m,). A
    law that cannot be made at a design is left out.
    """
    sensed = problem_of(study, known)
    state = replace(sensed, measurement=None)
    found: dict[str, dict[Place, Trajectory]] = {use: {} for use in scenarios}
    for at, p in designs.items():
        estimator = estimator_at(sensed, p)
        for name in names:
            try:
                law = Observed(saturated_lqr(state, p) if name == LQG else study.law(name, state, p), estimator)
            except MPCError:
                continue
            for use, scenario in scenarios.items():
                run = scenario.run(law, design=p, limit=sensed.limit)
                found[use][at, f"{name}{TOLD if len(known) else ''}"] = run
    return found


def service_runs(
    study: OnSensors, scenarios: Mapping[str, Scenario], stages: Mapping[str, Stage]
) -> dict[str, dict[Place, Trajectory]]:  # fmt: skip
    """Runs by drive of what was in service.

    Of a redesign also of what was before it, behind the filter that came with it.
    """
    tried, before = dict[Place, Any](), None
    for name, stage in stages.items():
        if before is not None and stage.values["by"] == "redesign":
            p = before.arrays["design"]
            estimator = estimator_at(problem_of(study, stage.arrays["known"]), p)
            tried[name, "former policy"] = p, Observed(LearnedPolicy(before.networks["agent"], p), estimator)
        one = generation_of(study, stage)
        tried[name, "learned"] = one.design, one.controller
        before = stage
    limit = study.sensed.limit
    return {
        use: {at: scenario.run(law, design=p, limit=limit) for at, (p, law) in tried.items()}
        for use, scenario in scenarios.items()
    }


def compared(
    study: OnSensors, expert: str, drive: Any, stages: Mapping[str, Stage], driven: Mapping[Place, Trajectory]
) -> DriveTrial:  # fmt: skip
    """Comparison on common runs of one drive.

    What was in service stands step by step, and beside every law at its best.
    """
    first, *later = stages
    last, base = [first, *later][-1], expert if expert in study.laws else LQG
    begun = START, base
    places: dict[str, Place] = {"start": begun, "design": (first, base), "policy": (first, "learned")}
    before = stages[first]
    for name in later:
        stage, by = stages[name], stages[name].values["by"]
        if by == "redesign":  # the filter that came with it has a step of its own
            places[f"{name}: filter of the fit"] = name, "former policy"
            same = np.array_equal(before.arrays["design"], stage.arrays["design"])
            places[f"{name}: {'policy that went on learning' if same else 'redesign'}"] = name, "learned"
        elif by:
            places[f"{name}: filter of the fit"] = name, "learned"
        before = stage
    metrics = _Measured(study.objective, study.metrics)
    pairs = dict(zip([*places][1:], pairwise(places.values())))
    pairs |= {f"all up to {what}": (begun, at) for what, at in [*places.items()][2:]}
    best = {f"{law[1]} at its best: {law[0]}": law for law in _at_their_best(study, driven)}
    pairs |= {f"all, for {name}": (law, (last, "learned")) for name, law in best.items()}
    changes = {
        what: metric_changes(metrics, driven[one], driven[two]) if one in driven and two in driven else ()
        for what, (one, two) in pairs.items()
    }
    values = {at: (metrics_of(metrics, run), int(run.diverged.sum())) for at, run in driven.items()}
    ends = {f"{base} at the start": begun, "in service at the end": (last, "learned")}
    shown = {who: np.asarray(driven[at].outputs)[0, :, 0] for who, at in ends.items() if at in driven}
    named = {**ends, **{f"{what}, what it ends with,": at for what, at in places.items()}, **best}
    told = {at: who for who, at in reversed(named.items()) if at in driven}  # once each
    notes = _notes(drive, {who: driven[at] for at, who in reversed(told.items())})
    return DriveTrial((values, changes), shown, (*notes, *_not_made(study, [first, last], driven)))


def _at_their_best(study: OnSensors, driven: Mapping[Place, Trajectory]) -> Iterator[Place]:
    """Best place of each law.

    It loses least, and of those that do costs least on the runs that all of them keep.
    """
    for law in (LQG, *study.laws):
        places = [at for at in driven if at[1] in (law, law + TOLD)]
        fewest = min((int(driven[at].diverged.sum()) for at in places), default=0)
        best = [at for at in places if int(driven[at].diverged.sum()) == fewest]
        if best:
            kept = ~np.any([driven[at].diverged for at in best], axis=0)
            returns = [float(driven[at].returns(study.objective)[kept].sum()) for at in best]
            yield best[int(np.argmax(returns))]


def _notes(drive: Any, ends: Mapping[str, Trajectory]) -> Iterator[str]:
    """Notes on the runs of a drive."""
    if is_recorded(drive):
        yield "It is a recording, which generations may have met: its intervals hold the noise of the sensors alone."
    for who, run in ends.items():
        if run.diverged.any():
            runs = len(run.diverged)
            yield f"{who} lost {int(run.diverged.sum())} of {runs} runs: changes are of runs that neither of both lost."
        if not run.inputs.any():
            yield f"{who} {nothing_done('these drives')}."


def _not_made(study: OnSensors, ends: Sequence[str], driven: Mapping[Place, Trajectory]) -> Iterator[str]:
    """Notes on laws that are missing at a design."""
    first, last = ends
    told = any(law.endswith(TOLD) for _, law in driven)
    for at, of in ((START, ""), (NESTED, ""), (first, ""), *([(last, TOLD)] if told else [])):
        missing = [law + of for law in (LQG, *study.laws) if (at, law + of) not in driven]
        if missing:
            yield f"At {at} there is no {', no '.join(missing)}: it cannot be made there, or the design was not found."


def problem_of(study: OnSensors, known: Sequence[float] | Array) -> CoDesignProblem:
    """Problem on the plant that is known.

    It is nominal, or has these unknown entries (m,).
    """
    if not len(known):
        return study.sensed
    assert study.unknown is not None
    return stated_plant(study.sensed, study.unknown).known(study.sensed, np.asarray(known))


@dataclass(frozen=True)
class _Measured:
    """Cost of a sample, and metrics of a study."""

    objective: Objective
    metrics: Metrics | None

    def __call__(self, run: Trajectory) -> Mapping[str, float]:
        """Metrics by name."""
        cost = {COST: float(-run.returns(self.objective).mean() / run.inputs.shape[1])}
        return cost | dict({} if self.metrics is None else self.metrics(run)) | cost

    @property
    def larger_is_better(self) -> Sequence[str]:
        """Names of such metrics."""
        return tuple(getattr(self.metrics, "larger_is_better", ()))
