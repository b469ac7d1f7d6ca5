"""The whole loop: initialise, co-design, deploy, learn, redesign, generation after generation."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.codesign import codesign
from ccdtools.co_design.expert import expert_dataset
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import CoDesignResult
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.exceptions import InputError
from ccdtools.statistics import summarise
from ccdtools.studies.comparison import replicates
from ccdtools.studies.configuration import StudyConfig
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.report.results import generation_entry, results
from ccdtools.studies.run_folder import RunFolder, Stage
from ccdtools.studies.study import Study
from ccdtools.trajectory import Trajectory
from ccdtools.twin.deployment import deploy_and_update
from ccdtools.twin.discrepancy import Discrepancy, QuantileScores
from ccdtools.twin.replay import replay_problem, updated_problem
from ccdtools.twin.residuals import Residuals, residuals
from ccdtools.twin.twin import DigitalTwin
from learning.networks import ActorCritic
from learning.warm_start import fit_actor_critic

Say = Callable[[str], None]
Compute = Callable[[np.random.Generator], Stage]


class Generations:
    """One run of a study in a folder. Each stage is read back if a former, interrupted run had finished it.

    Parameters
    ----------
    study : Study
    config : StudyConfig
    folder : RunFolder
    generations : int
        At least 1.
    seed : int
        Every stage draws from a generator of its own, spawned from the seed and the name of the stage.
    say : callable
        Takes one line of text per stage.
    progress : bool
        Show progress bars.

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
        say: Say = print,
        progress: bool = True,
    ) -> None:
        check_counts(generations, seed)
        self.study, self.config, self.folder = study, config, folder
        self.generations, self.say, self.progress = generations, say, progress
        self.evaluation = Evaluation(study, config, seed)
        self.problem, self.steps = self.evaluation.problem, self.evaluation.deployment_steps

    def run(self) -> dict[str, Any]:
        """All stages; the contents of results.json, which is written too."""
        design = np.asarray(self.study.p0)
        initial = self._stage("initialisation", "Step 0: expert, sets and cloning", self._initialise)
        agent: ActorCritic = initial.networks["agent"]
        twin = DigitalTwin(self.study.model)
        start = self._stage("comparison-0", "Comparison at the start design", self._comparing(0, design, agent, agent))
        stages, entries, rows = [initial, start], [], [*start.values["rows"]]
        for g in range(1, self.generations + 1):
            title = f"Generation {g}"
            known = twin.logs
            found = self._stage(f"codesign-{g}", f"{title}: co-design", self._designing(agent, design, twin))
            designed, design = found.networks["agent"], found.arrays["design"]
            service = self._stage(f"deployment-{g}", f"{title}: deployment", self._deploying(g, designed, design))
            agent = service.networks["agent"]
            learned = self._stage(f"twin-{g}", f"{title}: learning the discrepancy", self._learning(twin, service))
            twin = self._twin(twin, service, learned)
            compared = self._stage(
                f"comparison-{g}", f"{title}: comparison", self._comparing(g, design, designed, agent, known)
            )
            returns = self._stage(
                f"evaluation-{g}", f"{title}: evaluation", self._evaluating(designed, design, known, twin)
            )
            stages += [found, service, learned, compared, returns]
            rows += compared.values["rows"]
            entries.append(
                generation_entry(g, self.evaluation, found=found, service=service, learned=learned, returns=returns)
            )
        notes = {"study": self.study.name, "mode": "QUICK" if self.config.quick else "full"}
        LearnedPolicy(agent, design).save(self.folder.path / "policy.safetensors", **notes)
        contents = results(self.evaluation, initial=initial, generations=entries, comparison=rows, stages=stages)
        self.folder.write_json("results.json", contents)
        return contents

    def _stage(self, name: str, label: str, compute: Compute) -> Stage:
        if self.folder.has(name):
            self.say(f"{label} … already finished")
            return self.folder.read_stage(name)
        self.say(label)
        start = time.perf_counter()

        def timed() -> Stage:
            stage = compute(self.evaluation.rng(name))
            return replace(stage, values=stage.values | {"seconds": time.perf_counter() - start})

        stage = self.folder.stage(name, timed)
        for line in stage.values.get("report", []):
            self.say(f"    {line}")
        return stage

    def _initialise(self, rng: np.random.Generator) -> Stage:
        config = self.config
        data = expert_dataset(
            self.problem, samples=config.samples, rng=rng, expert=config.expert,
            gamma=config.codesign.ppo.gamma, progress=self.progress,
        )  # fmt: skip
        agent = fit_actor_critic(
            data.inputs, data.actions, data.values, action_bounds=self.problem.input_bounds,
            input_bounds=self.problem.observation_bounds, rng=rng, network=config.network, config=config.cloning,
            progress=self.progress,
        )  # fmt: skip
        values = {
            "expert": config.expert, "candidates": config.samples, "samples": len(data.inputs),
            "acceptance": data.acceptance, "diverged": data.diverged,
        }  # fmt: skip
        report = [f"{data.acceptance:.0%} of {config.samples} candidates feasible, {len(data.inputs)} samples cloned"]
        return Stage(values | {"report": report}, networks={"agent": agent})

    def _designing(self, agent: ActorCritic, design: Array, twin: DigitalTwin) -> Compute:
        def compute(rng: np.random.Generator) -> Stage:
            problem, judge, config = self.problem, None, self.config.codesign
            if twin.discrepancy is not None:
                # The median model with what it leaves unexplained replayed; judged on replays of the errors themselves:
                # a model fitted in closed loop can mistake the road for a consequence of the state.
                problem = updated_problem(self.problem, twin)
                judge, config = replay_problem(self.problem, twin.logs, self.evaluation.window), self.config.redesign
            result = codesign(
                problem, agent=agent, design=design, rng=rng, config=config, judge=judge, progress=self.progress
            )
            return self._designed(result)

        return compute

    def _designed(self, result: CoDesignResult) -> Stage:
        history, space = result.history, self.problem.design
        arrays = {f"history_{name}": getattr(history, name) for name in history.__dataclass_fields__}
        check = None if result.gradients is None else asdict(result.gradients)
        active = ", ".join(f"{name} at its {side} bound" for name, side in result.active_bounds.items())
        report = [*str(result.gradients).splitlines()] if result.gradients is not None else []
        report.append(f"{space.describe(result.design)}; active bounds: {active or 'none'}")
        values = {"active_bounds": result.active_bounds, "gradient_check": check, "report": report}
        return Stage(values, {"design": result.design, **arrays}, {"agent": result.agent})

    def _deploying(self, g: int, agent: ActorCritic, design: Array) -> Compute:
        def compute(rng: np.random.Generator) -> Stage:
            real = self.study.real
            w = self.evaluation.recorded(real.runs, "deployment" if real.runs == 1 else f"deployment-{g}")
            deployment = deploy_and_update(
                self.problem, real.plant, agent, design, x0=np.tile(real.x0, (real.runs, 1)), disturbance=w, rng=rng,
                config=replace(self.config.online, window=self.evaluation.window), progress=self.progress,
            )  # fmt: skip
            log = deployment.log
            if log.diverged.all():
                raise InputError(
                    f"x0: got a start from which every run of deployment {g} diverged at "
                    f"{self.problem.design.describe(design)}, expected one that some design can recover from."
                )
            returns = summarise(replicates(log.rewards(self.study.objective)[~log.diverged], real.runs))
            updates = [asdict(update) for update in deployment.updates]
            accepted = sum(update.accepted for update in deployment.updates)
            report = [f"return {returns.mean:.4g}, {log.diverged.mean():.1%} diverged, "
                      f"{accepted} of {len(updates)} updates of the policy accepted"]  # fmt: skip
            values = {"deployed_return": asdict(returns), "diverged": log.diverged.mean(), "updates": updates}
            return Stage(values | {"report": report}, _packed(log), {"agent": deployment.agent})

        return compute

    def _learning(self, twin: DigitalTwin, service: Stage) -> Compute:
        def compute(rng: np.random.Generator) -> Stage:
            log = _unpacked(service, self.problem)
            updated = twin.update(
                log, weight=self.study.weight, rng=rng, config=self.config.quantile, progress=self.progress
            )
            assert updated.discrepancy is not None
            assert updated.scores is not None
            scores = updated.scores
            coverage = ", ".join(f"{c:.0%}" for c in scores.coverage)
            report = [f"held-out coverage {coverage} (nominal {scores.nominal_coverage:.0%})"]
            return Stage(
                {"scores": asdict(scores), "report": report}, networks={"quantiles": updated.discrepancy.network}
            )

        return compute

    def _twin(self, twin: DigitalTwin, service: Stage, learned: Stage) -> DigitalTwin:
        logs = (*twin.logs, residuals(self.study.model, _unpacked(service, self.problem)))
        discrepancy = Discrepancy(learned.networks["quantiles"], self.study.weight)
        return replace(twin, logs=logs, discrepancy=discrepancy, scores=QuantileScores(**learned.values["scores"]))

    def _comparing(self, g, design, designed, deployed, judged_on: Sequence[Residuals] = ()) -> Compute:
        def compute(rng: np.random.Generator) -> Stage:
            return self.evaluation.comparison(
                g, design, designed=designed, deployed=deployed, judged_on=judged_on, rng=rng
            )

        return compute

    def _evaluating(self, agent, design: Array, judged_on: Sequence[Residuals], twin: DigitalTwin) -> Compute:
        def compute(rng: np.random.Generator) -> Stage:
            assert twin.discrepancy is not None
            return self.evaluation.returns(agent, design, judged_on=judged_on, learned=twin.discrepancy)

        return compute


def check_counts(generations: int, seed: int) -> None:
    """Raise an `InputError` unless there is a generation to run and a seed to start from."""
    if generations < 1:
        raise InputError(f"--generations: got {generations}, expected at least 1.")
    if seed < 0:
        raise InputError(f"--seed: got {seed}, expected a whole number ≥ 0.")


def _packed(log: Trajectory) -> dict[str, Any]:
    return {
        "states": log.states, "inputs": log.inputs, "disturbances": log.disturbances,
        "diverged_at": log.diverged_at, "design": log.design,
    }  # fmt: skip


def _unpacked(stage: Stage, problem: CoDesignProblem) -> Trajectory:
    return Trajectory(**stage.arrays, dt=problem.model.dt)  # type: ignore[arg-type]
