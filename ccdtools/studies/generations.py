"""The whole loop: initialise, co-design, deploy, learn, redesign."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from typing import Any

import numpy as np

from ccdtools.arrays import jsonable
from ccdtools.co_design.design_controllers import tangent_note
from ccdtools.co_design.risk import measure
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.jobs import Begun, as_jobs, beside
from ccdtools.limits import limits_in_words
from ccdtools.progress import telling
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.held_out import GenerationRecord, compared, gains_by_place, held_out_rows
from ccdtools.studies.in_service import InService
from ccdtools.studies.presets import StudyConfig
from ccdtools.studies.report.headline import headline
from ccdtools.studies.run_folder import RunFolder
from ccdtools.studies.service import after_deployment
from ccdtools.studies.stage_storage import Stage, log_of
from ccdtools.studies.stages import LoopStages, changes_of, deployable_of, deployed_of, stopped
from ccdtools.studies.study import Study
from ccdtools.studies.trust_region import Trust
from ccdtools.trajectory import Trajectory
from ccdtools.twin.deployable import Deployable
from ccdtools.twin.residuals import Residuals
from ccdtools.twin.twin import DigitalTwin
from ccdtools_ground.door import as_count

Echo = Callable[[str], None]
PACKAGES = ("ccdtools", "numpy", "scipy", "torch", "casadi", "daqp", "control")


class Generations:
    """Run of a study in a folder, with finished stages read back.

    Parameters
    ----------
    study : Study
    config : StudyConfig
    folder : RunFolder
    generations : int
        At least 1.
    seed : int
        Every stage draws from a generator of its own, spawned from the seed and the name of the stage.
    echo : callable
        Takes one line of text per stage.
    progress : bool
        Show progress bars.
    jobs : int
        Processes: comparisons are computed beside the loop in all but one.

    Raises
    ------
    InputError
        If `generations` or `seed` is out of range, or the deployment is too short to learn from.
    """

    def __init__(
        self,
        study: Study,
        config: StudyConfig,
        folder: RunFolder,
        *,
        generations: int = 2,
        seed: int = 0,
        echo: Echo = print,
        progress: bool = True,
        jobs: int = 1,
    ) -> None:
        self.generations = as_count("generations", generations)
        self.jobs = as_jobs(jobs)
        self.folder = folder
        self.echo = echo
        self.evaluation = Evaluation(study, config, as_count("seed", seed, least=0))
        self.evaluation.held_out  # noqa: B018  (raises if fresh runs cannot be drawn)
        self.compute = LoopStages(self.evaluation, progress)
        self._real = study.real
        self._in_service = InService()
        self._comparing: dict[int, tuple[str, str, Begun]] = {}  # by generation
        self._compared: dict[int, Stage] = {}
        self._told: list[Trajectory] = []  # logs that tell the unknown entries of the plant

    def run(self) -> dict[str, Any]:
        """Run all stages; write and return the contents of results.json."""
        with beside(self.jobs, self.generations + 1) as self._begun:
            return self._run()

    def _run(self) -> dict[str, Any]:
        study = self.evaluation.study
        twin = DigitalTwin(study.model, scale=self.evaluation.problem.state_scale)
        history = [self._begin()]
        end = None
        for generation in range(1, self.generations + 1):
            self._meet(generation)
            found = self._designed(generation, twin, history)
            end = stopped(found)
            if end is not None:
                self.echo(f"Generation {generation}: {end['text']}")
                self._meet(generation - 1)  # what it would have met, no deployment has
                break
            twin, record = self._next(generation, found, twin, history)
            served = self._stage(
                f"in-service-{generation}", f"Generation {generation}: in service, on all that it serves",
                lambda _, record=record: self._in_service.stage(self.evaluation, [*history, record]),
            )  # fmt: skip
            history.append(replace(record, stages={**record.stages, "in service": served}))
        service = history[-1].after
        config = self.evaluation.config
        gains = self._stage("gains", "What brought the gain", lambda _: gains_by_place(self.evaluation, history))
        compared = [self._compared_at(number) for number in range(len(history))]
        label = "Disturbances that no generation has met"
        beyond = self._stage("held-out-rows", label, lambda _: self._beyond(history, compared, twin.logs))
        notes = {"study": study.name, "mode": "QUICK" if config.quick else "full"}
        self.folder.save_policy(LearnedPolicy(service.agent, service.design), notes)
        contents = self._results(history, compared, gains, beyond) | ({} if end is None else {"stopped": jsonable(end)})
        self.folder.write_json("results.json", contents)
        return contents

    def _meet(self, generation: int) -> None:
        """Go on with the real plant of a generation."""
        study = self.evaluation.study
        met = self._real.met_by(generation)
        if met is not study.real:
            self.evaluation = replace(self.evaluation, study=replace(study, real=met))
            self.compute = replace(self.compute, evaluation=self.evaluation)

    def _results(
        self, history: Sequence[GenerationRecord], compared: list[Stage], gains: Stage, beyond: Stage
    ) -> dict[str, Any]:  # fmt: skip
        stages = [stage for record in history for stage in record.stages.values()] + compared
        initial = history[0].stages["initialisation"].values
        evaluation = self.evaluation
        study = evaluation.study
        config = evaluation.config
        space = evaluation.problem.design
        contents: dict[str, Any] = {
            "schema_version": 7,
            "study": study.name, "title": study.title, "seed": evaluation.seed,
            "quick": config.quick, "preset": config.preset,
            "wall_seconds": sum(stage.values["seconds"] for stage in (*stages, gains, beyond)),
            "x0": study.x0, "starts": None if study.starts is None else repr(study.scenarios), "dt": study.plant.dt,
            "deployment_steps": evaluation.deployment_steps, "deployment_runs": study.real.runs,
            "state_names": study.plant.state_names, "input_names": study.plant.input_names,
            "design_space": {"names": space.names, "units": space.units, "lower": space.lower, "upper": space.upper,
                             "constraints": space.constraint_names, "integer": space.integer},
            "start": space.as_dict(study.p0), "limits": limits_in_words(evaluation.problem.output_limits),
            "measure": measure(study.judged_in), "optimised": measure(evaluation.problem.risk),
            "real_plant_changes": study.real is not self._real,
            "objective": study.objective.describe(), "linearisation": tangent_note(evaluation.problem),
            "initialisation": {key: value for key, value in initial.items() if key != "report"},
            "generations": [self._entry(number, record) for number, record in enumerate(history[1:], 1)],
            "comparison": [row for stage in compared for row in stage.values["rows"]],
            "held_out": beyond.values["rows"],
            "gains": gains.values["gains"],
            "in_service": history[-1].stages["in service"].values["rows"],
            "configuration": asdict(config),
            "versions": {"python": platform.python_version()} | {name: version(name) for name in PACKAGES},
        }  # fmt: skip
        return dict(jsonable(contents | {"headline": headline(contents)}))

    def _begin(self) -> GenerationRecord:
        """Record of the start: the first policy, compared at the start design."""
        initial = self._stage("initialisation", "Step 0: expert, sets and imitation", self.compute.initialise)
        service = Deployable(initial.networks["agent"], np.asarray(self.evaluation.study.p0), "the start")
        self._compare(0, "Comparison at the start design", service, service, (), ())
        return GenerationRecord(service, service, stages={"initialisation": initial})

    def _compare(self, generation: int, label: str, *inputs: Any) -> None:
        """Begin the comparison at one generation's design."""
        name = f"comparison-{generation}"
        if self.folder.has(name):
            self._compared[generation] = self._read(name, label)
            return
        held_out = self._at_the_end(generation)
        begun = self._begun(compared, self.evaluation, self.evaluation.rng(name), generation, *inputs, held_out)
        self._comparing[generation] = name, label, begun

    def _compared_at(self, generation: int) -> Stage:
        """Comparison of a generation, kept; waits for it."""
        if generation in self._comparing:
            name, label, (_, value) = self._comparing.pop(generation)
            self._compared[generation] = self._computed(name, label, lambda _: value())
        return self._compared[generation]

    def _at_the_end(self, generation: int) -> bool:
        """Whether held-out runs are compared with it.

        At the first and the last design, on the plants of the end.
        """
        study = self.evaluation.study
        stays = study.unknown is None and self._real.met_by(self.generations) is self._real
        return generation == self.generations or (generation == 0 and stays)

    def _beyond(
        self, history: Sequence[GenerationRecord], compared: Sequence[Stage], logs: Sequence[Residuals]
    ) -> Stage:  # fmt: skip
        """Comparisons on held-out runs."""
        rows: list[dict[str, Any]] = []
        for generation, known in ((0, ()), (len(history) - 1, logs)):
            found = compared[generation].values.get("held_out") if self._at_the_end(generation) else None
            if found is None:
                found = held_out_rows(self.evaluation, generation, history[generation].after, known)
            rows += found
        return Stage({"rows": rows})

    def _designed(self, generation: int, twin: DigitalTwin, history: Sequence[GenerationRecord]) -> Stage:
        """Stage of a co-design, and of the decision on what is deployed."""
        last = history[-1]
        return self._stage(
            f"codesign-{generation}", f"Generation {generation}: co-design", self.compute.co_design, generation,
            last.after, twin, last.trust, history,
        )  # fmt: skip

    def _next(
        self, generation: int, found: Stage, twin: DigitalTwin, history: Sequence[GenerationRecord]
    ) -> tuple[DigitalTwin, GenerationRecord]:
        """Twin and record after one more generation: deploy, learn, compare, evaluate."""
        title = f"Generation {generation}"
        last = history[-1]
        deployed = self._stage(
            f"deployment-{generation}", f"{title}: deployment", self.compute.deploy, generation, found, last.after,
            last.served, last.trust, twin,
        )  # fmt: skip
        log = log_of(deployed, self.evaluation.study.plant.dt)
        if deployed.values.get("changed"):  # what was logged before was of another plant
            twin, self._told = DigitalTwin(twin.model, scale=self.evaluation.problem.state_scale), []
        twin, identified = self._identified(generation, log, twin)
        known = twin.logs
        now = deployed_of(generation, deployable_of(found), deployed.networks["agent"], log, changes_of(deployed))
        delivery = deployed.values["delivery"]
        service, served = after_deployment(
            now, last.after, last.served, replaces=delivery["replaces"], carried=delivery["carried"]
        )
        logs = known if log.diverged.all() else twin.remembering(log).logs
        self._compare(generation, f"{title}: comparison", served.designed, service, known, logs)
        learned = self._stage(
            f"twin-{generation}", f"{title}: learning the discrepancy", self.compute.learn, twin, log, deployed
        )
        taught = self.compute.learned_twin(twin, log, learned)
        assert taught.discrepancy is not None
        discrepancy = taught.discrepancy
        returns = self._stage(f"evaluation-{generation}", f"{title}: evaluation",
                              lambda _: self.evaluation.returns(served.designed, known, discrepancy))  # fmt: skip
        stages = {"codesign": found, "deployment": deployed, "twin": learned,
                  "evaluation": returns} | identified  # fmt: skip
        trust = Trust(**deployed.values["trust"])
        return taught, GenerationRecord(now.designed, service, delivery["replaces"], served, trust, stages)

    def _identified(
        self, generation: int, log: Trajectory, twin: DigitalTwin
    ) -> tuple[DigitalTwin, dict[str, Stage]]:  # fmt: skip
        """Twin of the model that all logs tell, and the stage."""
        if self.evaluation.study.unknown is None or log.diverged.all():
            return twin, {}
        before = tuple(self._told)
        self._told.append(log)
        title = f"Generation {generation}: identification"
        found = self._stage(f"identification-{generation}", title, self.compute.identify, tuple(self._told))
        if found.values["known"]:
            self.evaluation = self.evaluation.of_plant(found.arrays["values"])
            self.compute = replace(self.compute, evaluation=self.evaluation)
            twin = DigitalTwin(self.evaluation.study.model, scale=self.evaluation.problem.state_scale)
            for former in before:
                twin = twin.remembering(former)
        return twin, {"identification": found}

    def _entry(self, generation: int, record: GenerationRecord) -> dict[str, Any]:
        """Element of ``generations`` in results.json."""
        found, deployed, learned, returns = (
            record.stages[name] for name in ("codesign", "deployment", "twin", "evaluation")
        )
        design = record.after.design
        space = self.evaluation.problem.design
        keep = ("model", "model_return", "nominal_return", "updated_model_return")
        return {
            "generation": generation, "account": deployed.values["account"],
            "design": space.as_dict(design), "active_bounds": space.active_bounds(design),
            "active_constraints": space.active_constraints(design),
            "deployed_design": space.as_dict(found.arrays["design"]), "predicted_return": found.values["predicted"],
            **{name: returns.values[name] for name in keep},
            "deployed_return": deployed.values["deployed_return"], "deployed_diverged": deployed.values["diverged"],
            "delivery": deployed.values["delivery"], "trust": deployed.values["trust"],
            "online_updates": deployed.values["updates"],
            "quantiles": learned.values["scores"], "free_running": learned.values["free_running"],
            "gradient_check": found.values["gradient_check"], "codesign": found.values["ended"],
            "redesign": found.values["redesign"], "limits": found.values["limits"],
            **{name: deployed.values[name] for name in ("notes", "drift") if name in deployed.values},
            **({"identified": record.stages["identification"].values["text"]} if "identification" in record.stages
               else {}),
        }  # fmt: skip

    def _stage(self, name: str, label: str, compute: Callable[..., Stage], *inputs: Any) -> Stage:
        """Stage of a name, read back or computed.

        Comparisons that have ended are kept first.
        """
        for generation in [g for g, (*_, (ended, _)) in self._comparing.items() if ended()]:
            self._compared_at(generation)
        return self._read(name, label) if self.folder.has(name) else self._computed(name, label, compute, *inputs)

    def _computed(self, name: str, label: str, compute: Callable[..., Stage], *inputs: Any) -> Stage:
        """Stage that is computed and kept."""
        self.echo(label)
        start = time.perf_counter()
        with telling(None if self.compute.progress else self.echo, label):
            computed = compute(self.evaluation.rng(name), *inputs)
        timed = replace(computed, values=computed.values | {"seconds": time.perf_counter() - start})
        stage = self.folder.keep_stage(name, timed)
        for line in stage.values.get("report", []):
            self.echo(f"    {line}")
        return stage

    def _read(self, name: str, label: str) -> Stage:
        """Finished stage of a name."""
        self.echo(f"{label} … already finished")
        return self.folder.read_stage(name)
