"""Run of a study on sensors."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.codesign import codesign
from ccdtools.co_design.methods.learned import Learned
from ccdtools.exceptions import CCDError, InputError
from ccdtools.jobs import beside
from ccdtools.scenario import Scenario
from ccdtools.studies.budgets import TRIAL_RUNS
from ccdtools.studies.by_fit import FittedGeneration, FittedLoop
from ccdtools.studies.first_policy import imitated_at
from ccdtools.studies.fitted_trial import NESTED, DriveTrial, compared, generation_of, law_runs, service_runs
from ccdtools.studies.on_sensors import LQG, OnSensors
from ccdtools.studies.presets import StudyConfig
from ccdtools.studies.run_folder import RunFolder
from ccdtools.studies.side_by_side import START
from ccdtools.studies.stage_storage import Stage, kept_log
from ccdtools.twin.plant_fit import PlantFit
from mpc import MPCError


@dataclass(frozen=True, eq=False)
class FittedRun:
    """Run of a study on sensors in a folder."""

    study: OnSensors
    config: StudyConfig
    folder: RunFolder
    seed: int
    echo: Callable[[str], None]
    progress: bool = False
    generations: int = 2
    jobs: int = 1

    def run(self) -> tuple[dict[str, Stage], dict[str, DriveTrial]]:
        """Generations by number, and trials by drive."""
        study, real = self.study, self.study.real
        drives = real.fresh or {"as deployed": real.disturbance}
        scenarios = {use: self._fresh(use, drive) for use, drive in drives.items()}
        names = [LQG, *study.laws]
        with beside(self.jobs, 3) as begun:
            nested = None if self.folder.has("nested-lqr") else begun(_nested, study, self.seed)
            stages = dict[str, Stage]()
            for name, stage in self._generations():
                if not stages:
                    if nested is not None:
                        self._stage("nested-lqr", "Nested LQR of the model, as a baseline", nested[1])
                    best = self.folder.read_stage("nested-lqr")
                    for why in best.values.get("report", ()):
                        self.echo(f"  nested LQR found no design: {why}")
                    nominal = {NESTED: best.arrays["design"]} if "design" in best.arrays else {}
                    designs = {START: study.p0, **nominal, name: stage.arrays["design"]}
                    laws = begun(law_runs, study, scenarios, designs, (), names)[1]
                stages[name] = stage
            self.echo("Comparison on the real plant")
            last = {[*stages][-1]: stage.arrays["design"]}
            told = names if len(stage.arrays["known"]) else []
            given = study, scenarios, last, stage.arrays["known"]
            others = begun(law_runs, *given, told[1::2])[1]  # half of them, in the other process
            found = [service_runs(study, scenarios, stages), law_runs(*given, told[::2]), laws(), others()]
        driven = {use: {at: run for part in found for at, run in part[use].items()} for use in drives}
        return stages, {
            use: compared(study, self.config.expert, drive, stages, driven[use]) for use, drive in drives.items()
        }

    def _fresh(self, use: str, drive: Any) -> Scenario:
        """Runs of one drive, drawn for the comparison."""
        rng, real = np.random.default_rng([self.seed, 1, *use.encode()]), self.study.real
        x0, w = np.tile(real.x0, (self._runs, 1)), drive.sample(self._runs, real.steps, rng)
        return Scenario(real.plant, x0, w, output=self._loop.sensors, seed=int(rng.integers(2**31)))

    @cached_property
    def _loop(self) -> FittedLoop:
        """Generations on the real plant."""
        return FittedLoop(self.study.sensed, self.study.real, self.study.unknown, draws=8, trial_runs=self._runs)

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
            found.append(generation_of(study, stage))
            if found[-1].log.diverged.all():
                break
        notes = {"study": study.name, "mode": "QUICK" if config.quick else "full"}
        try:
            self.folder.save_policy(found[-1].controller, notes)
        except InputError as error:  # its filter is no expression
            self.echo(f"The policy is kept without its filter: {error}")
            self.folder.save_policy(found[-1].controller.controller, notes | {"filter": "none"})

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
        """Policy that imitates the study's expert."""
        rng = np.random.default_rng([self.seed, 0])
        found = imitated_at(self.study.problem(), self.study, self.config, rng, progress=self.progress)
        return Stage(networks={"agent": found.agent})


def _stage_of(
    computed: Callable[[np.random.Generator], FittedGeneration], rng: np.random.Generator, known: Array
) -> Stage:  # fmt: skip
    """Generation as it is kept.

    Its filter is that of the unknown entries in `known`, or the nominal one.
    """
    one = computed(rng)
    by = None if one.fit is None else "redesign" if one.accepted else "update" if one.update else ""
    fit = one.fit if isinstance(one.fit, PlantFit) else None
    report, told = [str(one)], None
    if fit is not None:
        known = fit.values[: len(fit.unknown.free)] if by else known
        told = {"names": fit.names, "values": fit.values, "deviations": fit.deviations, "status": fit.status.name}
        report.append(repr(fit))
    return Stage({"report": report, "by": by, "fit": told}, {**kept_log(one.log), "known": known}, {"agent": one.agent})


def _nested(study: OnSensors, seed: int) -> Stage:
    """Design of nested LQR, or why there is none."""
    rng = np.random.default_rng([seed, *b"nested"])
    try:
        found = codesign(study.problem(), method="nested", design=study.p0, rng=rng)
    except (CCDError, MPCError) as error:
        return Stage({"report": [str(error)]})
    return Stage(arrays={"design": found.design})
