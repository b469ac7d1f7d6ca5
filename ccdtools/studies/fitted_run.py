"""Run of a study on sensors: generations by fits, then all that was in service on fresh drives."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.codesign import codesign
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.co_design.methods.learned import Learned
from ccdtools.co_design.objective import Objective
from ccdtools.co_design.output_filter import estimator_at
from ccdtools.comparison.metrics import Metrics, metric_changes, metrics_of
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.controllers.observed import Observed
from ccdtools.exceptions import InputError
from ccdtools.jobs import Begun, beside
from ccdtools.scenario import Scenario
from ccdtools.studies.budgets import TRIAL_RUNS
from ccdtools.studies.by_fit import FittedGeneration, FittedLoop
from ccdtools.studies.first_policy import imitated_at
from ccdtools.studies.on_sensors import OnSensors
from ccdtools.studies.presets import StudyConfig
from ccdtools.studies.run_folder import RunFolder
from ccdtools.studies.side_by_side import START
from ccdtools.studies.side_by_side_run import Place, Trial
from ccdtools.studies.stage_storage import Stage
from ccdtools.trajectory import Trajectory
from ccdtools.twin.plant_fit import PlantFit
from ccdtools.twin.unknown_plant import stated_plant

LOG = ("states", "inputs", "disturbances", "diverged_at", "design", "outputs")
NESTED = "nested LQR"  # a design
BY = {"redesign": "redesign", "update": "filter of the fit"}  # what a generation brought into service
Signals = dict[str, Array]  # first output (T,) of a run, by who drove it


@dataclass(frozen=True, eq=False)
class FittedRun:
    """Run of such a study in a folder; what is finished there is read."""

    study: OnSensors
    config: StudyConfig
    folder: RunFolder
    seed: int
    echo: Callable[[str], None]
    progress: bool = False
    generations: int = 2
    jobs: int = 1

    def run(self) -> tuple[dict[str, Stage], dict[str, tuple[Trial, Signals]]]:
        """Generations by number, and trials by drive."""
        study, real = self.study, self.study.real
        drives = real.fresh or {"as deployed": real.disturbance}
        scenarios = {use: self._fresh(use, drive) for use, drive in drives.items()}
        with beside(self.jobs, 1 + len(drives)) as begun:
            nested = None if self.folder.has("nested-lqr") else begun(_nested, study, self.seed)
            laws = dict[str, Begun]()
            stages = dict[str, Stage]()
            for name, stage in self._generations():
                if not stages:
                    if nested is not None:
                        self._stage("nested-lqr", "Nested LQR of the model, as a baseline", nested[1])
                    best = self.folder.read_stage("nested-lqr").arrays["design"]
                    designs = {START: study.p0, NESTED: best, name: stage.arrays["design"]}
                    laws = {use: begun(_driven, study, one, designs, stage) for use, one in scenarios.items()}
                stages[name] = stage
            self.echo("Comparison on drives that no generation has met")
            return stages, {use: _tried(study, one, stages, laws[use][1]()) for use, one in scenarios.items()}

    def _fresh(self, use: str, drive: Any) -> Scenario:
        """Runs of one drive that no generation meets."""
        rng, real = np.random.default_rng([self.seed, 1, *use.encode()]), self.study.real
        x0, w = np.tile(real.x0, (self._runs, 1)), drive.sample(self._runs, real.steps, rng)
        return Scenario(real.plant, x0, w, output=self._loop.sensors, seed=int(rng.integers(2**31)))

    @property
    def _loop(self) -> FittedLoop:
        """Generations on the real plant."""
        return FittedLoop(self.study.sensed, self.study.real, self.study.unknown, trial_runs=self._runs)

    def _generations(self) -> Iterator[tuple[str, Stage]]:
        """Generations by name, until one is lost."""
        study, config = self.study, self.config
        loop = self._loop
        agent = self._stage("initialisation", "Step 0: expert and imitation", self._initialised).networks["agent"]
        by = Learned(by=config.method, agent=agent, history=0, config=config.codesign)
        stage, found = Stage(), list[FittedGeneration]()
        for number in range(1, self.generations + 1):
            rng = np.random.default_rng([self.seed, number])
            following = partial(loop.following, replace(by, config=config.redesign), found)
            computed = following if found else partial(loop.first, by, study.p0)
            name = f"generation {number}"
            known = np.zeros(0) if not found else stage.arrays["known"]
            stage = self._stage(name.replace(" ", "-"), name.capitalize(), partial(_stage_of, computed, rng, known))
            self.echo("\n".join(f"  {line}" for line in stage.values["report"]))
            yield name, stage
            found.append(_generation(study, stage))
            if found[-1].log.diverged.all():
                break
        notes = {"study": study.name, "mode": "QUICK" if config.quick else "full"}
        try:
            self.folder.save_policy(found[-1].controller, notes)
        except InputError:  # its filter is no expression
            self.folder.save_policy(found[-1].controller.controller, notes)

    @property
    def _runs(self) -> int:
        """Runs of each drive in a trial."""
        return min(self.config.real_runs, TRIAL_RUNS // 5 if self.config.quick else TRIAL_RUNS)

    def _stage(self, name: str, label: str, compute: Callable[[], Stage]) -> Stage:
        """Stage as kept, computed where it is not."""
        if not self.folder.has(name):
            self.echo(label)
            self.folder.keep_stage(name, compute())
        return self.folder.read_stage(name)

    def _initialised(self) -> Stage:
        """Policy that imitates the expert of the study on the state."""
        rng = np.random.default_rng([self.seed, 0])
        found = imitated_at(self.study.problem(), self.study, self.config, rng, progress=self.progress)
        return Stage(networks={"agent": found.agent})


def _stage_of(
    computed: Callable[[np.random.Generator], FittedGeneration], rng: np.random.Generator, known: Array
) -> Stage:  # fmt: skip
    """Generation as it is kept; its filter is that of the unknown entries in `known`, or the nominal one."""
    one = computed(rng)
    by = None if one.fit is None else "redesign" if one.accepted else "update" if one.update else ""
    fit = one.fit if isinstance(one.fit, PlantFit) else None
    report, told = [str(one)], None
    if fit is not None:
        known = fit.values[: len(fit.unknown.free)] if by else known
        told = {"names": fit.names, "values": fit.values, "deviations": fit.deviations, "status": fit.status.name}
        report.append(repr(fit))
    log = {name: getattr(one.log, name) for name in LOG}
    return Stage({"report": report, "by": by, "fit": told}, {**log, "known": known}, {"agent": one.agent})


def _generation(study: OnSensors, kept: Stage) -> FittedGeneration:
    """Generation of a stage, without its fit."""
    design, agent = kept.arrays["design"], kept.networks["agent"]
    log = Trajectory(**{name: kept.arrays[name] for name in LOG}, dt=study.plant.dt)  # type: ignore[arg-type]
    policy = LearnedPolicy(agent, design)
    return FittedGeneration(design, _behind(study, policy, design, kept.arrays["known"]), log, agent=agent)


def _behind(study: OnSensors, law: Any, p: Array, known: Array) -> Observed:
    """Law of the state behind the filter of unknown entries (m,), or of the nominal plant (0,)."""
    problem = study.sensed
    if len(known):
        assert study.unknown is not None
        problem = stated_plant(problem, study.unknown).known(problem, known)
    return Observed(law, estimator_at(problem, p))


@dataclass(frozen=True)
class _Measured:
    """Metrics of a study, after the cost of a sample."""

    objective: Objective
    metrics: Metrics | None

    def __call__(self, run: Trajectory) -> Mapping[str, float]:
        """Metrics by name."""
        cost = {"cost": float(-run.returns(self.objective).mean() / run.inputs.shape[1])}
        return cost | dict({} if self.metrics is None else self.metrics(run))

    @property
    def larger_is_better(self) -> Sequence[str]:
        """Names of such metrics."""
        return tuple(getattr(self.metrics, "larger_is_better", ()))


def _nested(study: OnSensors, seed: int) -> Stage:
    """Design of nested LQR."""
    found = codesign(study.problem(), method="nested", design=study.p0, rng=np.random.default_rng([seed, 2]))
    return Stage(arrays={"design": found.design})


def _driven(
    study: OnSensors, scenario: Scenario, designs: Mapping[str, Array], first: Stage
) -> dict[Place, Trajectory]:  # fmt: skip
    """Runs of laws of the field at each design, behind the nominal filter, and of the first generation."""
    problem = study.sensed
    state, first_name = replace(problem, measurement=None), list(designs)[-1]
    laws: dict[str, Any] = {"LQG": saturated_lqr, **study.laws}
    tried = {(at, law): (p, _behind(study, make(state, p), p, np.zeros(0)))
             for at, p in designs.items() for law, make in laws.items()}  # fmt: skip
    tried[first_name, "learned"] = designs[first_name], _generation(study, first).controller
    return {at: scenario.run(law, design=p, limit=problem.limit) for at, (p, law) in tried.items()}


def _tried(
    study: OnSensors, scenario: Scenario, stages: Mapping[str, Stage], driven: dict[Place, Trajectory]
) -> tuple[Trial, Signals]:  # fmt: skip
    """What was in service, and laws of the field, on common fresh runs of one drive."""
    names = list(stages)
    for name in names[1:]:
        one = _generation(study, stages[name])
        driven[name, "learned"] = scenario.run(one.controller, design=one.design, limit=study.problem().limit)
    begun, last = (START, "LQG"), (names[-1], "learned")
    later = {
        f"{name}: {BY[stage.values['by']]}": (name, "learned") for name, stage in stages.items() if stage.values["by"]
    }
    places = {"start": begun, "design": (names[0], "LQG"), "policy": (names[0], "learned"), **later}
    pairs = {what: pair for what, pair in zip(list(places)[1:], pairwise(places.values()))}
    pairs |= {f"all up to {what}": (begun, at) for what, at in list(places.items())[2:]}
    metrics = _Measured(study.objective, study.metrics)
    values = {at: (metrics_of(metrics, run), int(run.diverged.sum())) for at, run in driven.items()}
    for law in ("LQG", *study.laws):  # at the best design for it on these very drives
        least = min((at for at in values if at[1] == law), key=lambda at: (values[at][1], values[at][0]["cost"]))
        pairs[f"all, for {law} at its best: {least[0]}"] = least, last
    changes = {what: metric_changes(metrics, driven[one], driven[two]) for what, (one, two) in pairs.items()}
    shown = {who: driven[at].outputs for who, at in {"LQG at the start": begun, "in service at the end": last}.items()}
    return (values, changes), {who: np.asarray(y)[0, :, 0] for who, y in shown.items()}
