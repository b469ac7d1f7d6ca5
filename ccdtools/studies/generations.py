"""The whole loop: initialise, co-design, deploy, learn, redesign, generation after generation."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from importlib.metadata import version
from typing import Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.deployment import Replay, deploy_and_update, replay_problem
from ccdtools.disturbance import Recorded
from ccdtools.exceptions import InputError
from ccdtools.expert import expert_dataset
from ccdtools.methods.ppo import CoDesignResult, codesign_ppo
from ccdtools.policy import LearnedPolicy
from ccdtools.problem import CoDesignProblem
from ccdtools.simulation import Trajectory, simulate
from ccdtools.statistics import Summary, summarise
from ccdtools.studies.comparison import Scenario, Score, baselines, compare, replicates
from ccdtools.studies.configuration import StudyConfig
from ccdtools.studies.run_folder import RunFolder, Stage
from ccdtools.studies.study import Study
from ccdtools.twin import DigitalTwin, Discrepancy, QuantileScores, Residuals, TwinPlant, residuals
from learning.networks import ActorCritic
from learning.warm_start import fit_actor_critic

SCHEMA_VERSION = 1
MINIMUM_LOG = 500  # samples that a deployment must log for its quantiles to mean anything

Say = Callable[[str], None]


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
        self.generations, self.seed, self.say, self.progress = generations, seed, say, progress
        self.problem = study.problem()
        self.steps = deployment_steps(study, config)

    def run(self) -> dict[str, Any]:
        """All stages; the contents of results.json, which is written too."""
        design = np.asarray(self.study.p0)
        initial = self._stage("initialisation", "Step 0: expert, sets and cloning", self._initialise)
        agent: ActorCritic = initial.networks["agent"]
        twin = DigitalTwin(self.study.model)
        stages = [
            self._stage("comparison-0", "Comparison at the start design", self._comparing(0, agent, design, None))
        ]
        rows: list[dict] = [*stages[0].values["rows"]]
        generations = []
        for g in range(1, self.generations + 1):
            found = self._stage(f"codesign-{g}", f"Generation {g}: co-design", self._designing(agent, design, twin))
            agent, design = found.networks["agent"], found.arrays["design"]
            designed_on = twin.discrepancy
            service = self._stage(f"deployment-{g}", f"Generation {g}: deployment", self._deploying(g, agent, design))
            learned = self._stage(
                f"twin-{g}", f"Generation {g}: learning the discrepancy", self._learning(twin, service)
            )
            twin = self._twin(twin, service, learned)
            compared = self._stage(
                f"comparison-{g}",
                f"Generation {g}: comparison",
                self._comparing(g, agent, design, designed_on, service.networks["agent"]),
            )
            evaluated = self._stage(
                f"evaluation-{g}", f"Generation {g}: evaluation", self._evaluating(agent, design, designed_on, twin)
            )
            rows += compared.values["rows"]
            stages += [found, service, learned, compared, evaluated]
            generations.append(self._generation(g, found, service, learned, evaluated))
            agent = service.networks["agent"]
        LearnedPolicy(agent, design).save(self.folder.path / "policy.safetensors")
        results = self._results(initial, generations, rows, [initial, *stages])
        self.folder.write_json("results.json", results)
        return results

    def _stage(self, name: str, label: str, compute: Callable[[np.random.Generator], Stage]) -> Stage:
        if self.folder.has(name):
            self.say(f"{label} … already finished")
            return self.folder.read_stage(name)
        self.say(label)
        start = time.perf_counter()

        def timed() -> Stage:
            stage = compute(self._rng(name))
            return replace(stage, values=stage.values | {"seconds": time.perf_counter() - start})

        stage = self.folder.stage(name, timed)
        for line in stage.values.get("report", []):
            self.say(f"    {line}")
        return stage

    def _rng(self, name: str) -> np.random.Generator:
        """The generator of a name: the same whether or not the run was interrupted before."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=tuple(name.encode())))

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

    def _designing(self, agent: ActorCritic, design: Array, twin: DigitalTwin):
        def compute(rng: np.random.Generator) -> Stage:
            problem, judge, config = self.problem, None, self.config.codesign
            if twin.discrepancy is not None:
                # The median model with what it leaves unexplained replayed; judged on replays of the errors themselves:
                # a model fitted in closed loop can mistake the road for a consequence of the state.
                problem = updated_problem(self.problem, twin)
                judge, config = replay_problem(self.problem, twin.logs, self._window()), self.config.redesign
            result = codesign_ppo(
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

    def _deploying(self, g: int, agent: ActorCritic, design: Array):
        def compute(rng: np.random.Generator) -> Stage:
            real = self.study.real
            w = self._recorded(real.runs, "deployment" if real.runs == 1 else f"deployment-{g}")
            deployment = deploy_and_update(
                self.problem, real.plant, agent, design, x0=np.tile(real.x0, (real.runs, 1)), disturbance=w, rng=rng,
                config=replace(self.config.online, window=self._window()), progress=self.progress,
            )  # fmt: skip
            log = deployment.log
            returns = summarise(replicates(log.rewards(self.study.objective)[~log.diverged], real.runs))
            updates = [asdict(update) for update in deployment.updates]
            accepted = sum(update.accepted for update in deployment.updates)
            report = [f"return {returns.mean:.4g}, {log.diverged.mean():.1%} diverged, "
                      f"{accepted} of {len(updates)} updates of the policy accepted"]  # fmt: skip
            values = {"deployed_return": asdict(returns), "diverged": log.diverged.mean(), "updates": updates}
            return Stage(values | {"report": report}, _packed(log), {"agent": deployment.agent})

        return compute

    def _learning(self, twin: DigitalTwin, service: Stage):
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

    def _comparing(self, g: int, agent, design: Array, discrepancy: Discrepancy | None, deployed=None):
        def compute(rng: np.random.Generator) -> Stage:
            controllers = baselines(self.problem, design, rng=rng)
            rows: list[dict[str, Any]] = []
            arrays: dict[str, Array] = {}
            for plant, scenario, learner in (
                ("model", self._model_scenario(discrepancy), agent),
                ("real", self._real_scenario(), deployed or agent),
            ):
                policy = LearnedPolicy(learner, design)
                everyone = {**controllers, "learned": policy, "learned (sampled)": policy.sampled(rng)}
                scores = compare(
                    everyone, scenario, design=design, objective=self.study.objective, X=self.study.X,
                    limit=self.problem.limit, few={"MPC": self.config.mpc_runs},
                )  # fmt: skip
                model = "nominal" if discrepancy is None else "updated"
                rows += [self._row(plant, model if plant == "model" else "real", g, design, score) for score in scores]
                arrays |= self._bands(plant, scenario, design, {"LQR": controllers["LQR"], "learned": policy})
            return Stage({"rows": rows}, arrays)

        return compute

    def _bands(self, plant: str, scenario: Scenario, design: Array, controllers) -> dict[str, Array]:
        """Mean and 95 % band of states and inputs over 500 runs (or the one run), for the figures."""
        n, steps = min(500, len(scenario.x0)), min(1000, scenario.disturbance.shape[1])
        arrays = {}
        for name, controller in controllers.items():
            run = simulate(
                scenario.plant, controller, x0=scenario.x0[:n], steps=steps,
                disturbance=scenario.disturbance[:n, :steps], design=design, limit=self.problem.limit,
            )  # fmt: skip
            for kind, values in (("states", run.states), ("inputs", run.inputs)):
                kept = values[~run.diverged] if not run.diverged.all() else values
                low, high = np.percentile(kept, [2.5, 97.5], axis=0)
                arrays[f"{plant}_{name}_{kind}"] = np.stack([low, kept.mean(axis=0), high])
        return arrays

    def _evaluating(self, agent: ActorCritic, design: Array, designed_on: Discrepancy | None, twin: DigitalTwin):
        def compute(rng: np.random.Generator) -> Stage:
            policy = LearnedPolicy(agent, design)
            nominal = self._mean_return(policy, self._model_scenario(None))
            values: dict[str, Any] = {"nominal_return": nominal, "model": "nominal", "model_return": nominal}
            assert twin.discrepancy is not None
            values["updated_model_return"] = {
                noise: self._mean_return(policy, self._model_scenario(twin.discrepancy, noise=noise))
                for noise in ("none", "quantiles")
            }
            if designed_on is not None:
                values["model"] = "updated"
                values["model_return"] = self._mean_return(policy, self._model_scenario(designed_on))
            return Stage(values)

        return compute

    def _mean_return(self, policy: LearnedPolicy, scenario: Scenario) -> dict[str, Any]:
        run = simulate(
            scenario.plant, policy, x0=scenario.x0, steps=scenario.disturbance.shape[1],
            disturbance=scenario.disturbance, design=policy.design, limit=self.problem.limit,
        )  # fmt: skip
        summary: Summary = summarise(run.returns(self.study.objective)[~run.diverged])
        return asdict(summary) | {"diverged": run.diverged.mean()}

    def _model_scenario(self, discrepancy: Discrepancy | None, *, noise: str = "quantiles") -> Scenario:
        """From the evaluation's start on the nominal model, or on the updated one."""
        rng, n, steps = self._rng("model scenario"), self.config.model_runs, self.study.steps
        x0, w = self.problem.scenarios.sample(n, steps, rng)
        if discrepancy is None:
            return Scenario(self.study.model, x0, w)
        plant = TwinPlant(self.study.model, replace(discrepancy, noise=noise))
        return Scenario(plant, x0, rng.random((n, steps, self.study.plant.nx)))

    def _real_scenario(self) -> Scenario:
        real = self.study.real
        runs = 1 if real.runs == 1 else self.config.real_runs
        w = self._recorded(runs, "deployment" if runs == 1 else "real scenario")
        return Scenario(real.plant, np.tile(real.x0, (runs, 1)), w)

    def _recorded(self, runs: int, name: str) -> Array:
        return self.study.real.disturbance.sample(runs, self.steps, self._rng(name))

    def _window(self) -> int:
        """Length of a replayed episode."""
        return min(self.study.steps, self.steps // 10 if self.study.real.runs == 1 else self.steps)

    def _row(self, plant: str, model: str, g: int, design: Array, score: Score) -> dict[str, Any]:
        return {
            "plant": plant, "model": model, "generation": g, "controller": score.controller,
            "design": self.problem.design.as_dict(design),
            "active_bounds": self.problem.design.active_bounds(design),
            **asdict(score.summary),
            "paired_to_lqr": asdict(score.paired_to_lqr),
            "diverged": score.diverged, "violations": score.violations, "step_time_us": 1e6 * score.step_time,
        }  # fmt: skip

    def _generation(self, g: int, found: Stage, service: Stage, learned: Stage, evaluated: Stage) -> dict[str, Any]:
        keep = ("model", "model_return", "nominal_return", "updated_model_return")
        return {
            "generation": g,
            "design": self.problem.design.as_dict(found.arrays["design"]),
            "active_bounds": found.values["active_bounds"],
            **{name: evaluated.values[name] for name in keep},
            "deployed_return": service.values["deployed_return"],
            "deployed_diverged": service.values["diverged"],
            "online_updates": service.values["updates"],
            "quantiles": learned.values["scores"],
            "gradient_check": found.values["gradient_check"],
        }

    def _results(self, initial: Stage, generations, rows, stages: list[Stage]) -> dict[str, Any]:
        study, space = self.study, self.problem.design
        packages = ("ccdtools", "numpy", "scipy", "torch", "casadi", "daqp", "control")
        return {
            "schema_version": SCHEMA_VERSION,
            "study": study.name, "title": study.title, "seed": self.seed,
            "quick": self.config.quick, "preset": self.config.preset,
            "wall_seconds": sum(stage.values["seconds"] for stage in stages),
            "x0": study.x0, "dt": study.plant.dt, "deployment_steps": self.steps, "deployment_runs": study.real.runs,
            "state_names": study.plant.state_names, "input_names": study.plant.input_names,
            "design_space": {
                "names": space.names, "units": space.units, "lower": space.lower, "upper": space.upper,
            },
            "start": space.as_dict(study.p0),
            "initialisation": {k: v for k, v in initial.values.items() if k != "report"},
            "generations": generations,
            "comparison": rows,
            "configuration": self.config.as_dict(),
            "versions": {"python": platform.python_version()} | {name: version(name) for name in packages},
        }  # fmt: skip


def updated_problem(problem: CoDesignProblem, twin: DigitalTwin) -> CoDesignProblem:
    """`problem` on the updated model: nominal + median, its unexplained rest replayed from the logs.

    Episodes start where the log was; the width of the quantiles is penalised.
    """
    if twin.discrepancy is None:
        raise InputError("twin: got one without a discrepancy, expected one after `update`.")
    logs: tuple[Residuals, ...] = twin.innovations()
    steps = min(problem.steps, min(log.x.shape[1] for log in logs))
    discrepancy = replace(twin.discrepancy, noise="replayed")
    return replace(problem, discrepancy=discrepancy, scenarios=Replay(logs), steps=steps)


def check_counts(generations: int, seed: int) -> None:
    """Raise an `InputError` unless there is a generation to run and a seed to start from."""
    if generations < 1:
        raise InputError(f"--generations: got {generations}, expected at least 1.")
    if seed < 0:
        raise InputError(f"--seed: got {seed}, expected a whole number ≥ 0.")


def deployment_steps(study: Study, config: StudyConfig) -> int:
    """Length of a deployment: the study's, capped by the configuration and by a recording's length."""
    real = study.real
    steps = real.steps
    if config.real_steps is not None and real.runs == 1:
        steps = min(steps, config.real_steps)
    if isinstance(real.disturbance, Recorded):
        steps = min(steps, len(real.disturbance.signal))
    if steps * real.runs < MINIMUM_LOG:
        raise InputError(
            f"disturbance: got {steps} samples, expected at least {MINIMUM_LOG} to learn the discrepancy from."
        )
    return steps


def _packed(log: Trajectory) -> dict[str, Any]:
    return {
        "states": log.states, "inputs": log.inputs, "disturbances": log.disturbances,
        "diverged_at": log.diverged_at, "design": log.design,
    }  # fmt: skip


def _unpacked(stage: Stage, problem: CoDesignProblem) -> Trajectory:
    return Trajectory(**stage.arrays, dt=problem.model.dt)  # type: ignore[arg-type]
