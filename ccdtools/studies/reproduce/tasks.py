"""Tasks of a reproduction, which keep their finished stages in the folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ccdtools.arrays import Array
from ccdtools.co_design.codesign import codesign
from ccdtools.co_design.expert import expert_dataset, feasible_sets
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.presets import StudyConfig, configuration
from ccdtools.studies.redesign import RedesignJudge
from ccdtools.studies.reproduce.budget import CASES, EPOCHS, UPDATES, Budget
from ccdtools.studies.reproduce.dynamic_program import optimal_return, viable
from ccdtools.studies.reproduce.paper_figures import SETS_AT
from ccdtools.studies.reproduce.places import fixed_places, floors, grid, lqr_beside, on_model, paper_designs
from ccdtools.studies.run_folder import RunFolder
from ccdtools.studies.stage_storage import Stage, kept_log, log_of
from ccdtools.studies.study import Study
from ccdtools.trajectory import Trajectory
from ccdtools.twin.deployable import Deployable
from ccdtools.twin.deployment import deploy_and_update
from ccdtools.twin.discrepancy import Discrepancy
from ccdtools.twin.replay import replay_problem, updated_problem
from ccdtools.twin.twin import DigitalTwin
from learning.networks import ActorCritic
from learning.warm_start import fit_actor_critic

MARGIN = 0.25  # By this part of X the grid of the dynamic program goes beyond it.


@dataclass(frozen=True, eq=False)
class Task:
    """Part of a reproduction that needs no other part.

    Attributes
    ----------
    folder : RunFolder
    budget : Budget
    case : str
    kind : {"loop", "paper", "reference", "optimum"}
        All steps of the paper from one seed; its first co-design by the preset ``paper``; what LQR does in the same
        places; sets and dynamic programs.
    seed : int
    """

    folder: RunFolder
    budget: Budget
    case: str
    kind: str
    seed: int = 0

    @property
    def name(self) -> str:
        """Name in the folder and on the screen."""
        return f"{self.case}-{self.kind}-{self.seed}"

    @property
    def of_seed(self) -> bool:
        """Whether every seed has one."""
        return self.kind in ("loop", "paper")

    def finished(self) -> dict[str, Stage]:
        """Stages of the task that are in the folder."""
        own = (name for name in self.folder.finished() if name.startswith(f"{self.name}-"))
        return {name.removeprefix(f"{self.name}-"): self.folder.read_stage(name) for name in own}

    def run(self) -> str:
        """Name of the task, whose stages are all in the folder now."""
        torch.set_num_threads(1)
        {"loop": self._loop, "paper": self._paper, "reference": self._reference, "optimum": self._optimum}[self.kind]()
        return self.name

    @cached_property
    def study(self) -> Study:
        """Case study."""
        return self.budget.study(self.case)

    @cached_property
    def problem(self) -> CoDesignProblem:
        """Co-design problem on the nominal model."""
        return self.study.problem()

    @cached_property
    def evaluation(self) -> Evaluation:
        """What a redesign is trained and decided on, as in `ccdtools run`."""
        return Evaluation(self.study, configured(self.budget, self.study), self.seed)

    def stage(self, name: str, compute: Callable[[np.random.Generator], Stage]) -> Stage:
        """Stage of this task, read back or computed."""
        whole = f"{self.name}-{name}"
        if self.folder.has(whole):
            return self.folder.read_stage(whole)
        sequence = np.random.SeedSequence(self.seed, spawn_key=tuple(whole.encode()))
        return self.folder.keep_stage(whole, compute(np.random.default_rng(sequence)))

    def _loop(self) -> None:
        """Steps 0 to 4 of the paper, then what each policy returns in every place."""
        start = self.stage("start", lambda rng: self._imitated(rng, "default"))
        first = self.stage("first", lambda rng: self._first(rng, start, "default"))
        logged = self.stage("deployment-1", lambda rng: self._deployed(rng, first))
        learned = self.stage("twin", lambda rng: self._learned(rng, logged))
        twin = self.twin(logged, learned)
        second = self.stage("second", lambda rng: self._second(rng, logged, twin))
        kept = second if second.values["replaces"] else Stage({}, {"design": logged.arrays["design"]}, logged.networks)
        again = self.stage("deployment-2", lambda rng: self._deployed(rng, kept))
        self.stage("measured", lambda _: self._measured(start, first, logged, second, kept, again, twin))

    def _paper(self) -> None:
        """First co-design by the preset of the paper."""
        start = self.stage("start", lambda rng: self._imitated(rng, "paper"))
        found = self.stage("first", lambda rng: self._first(rng, start, "paper"))
        seen = fixed_places(self.study, self.budget)["nominal"]
        self.stage("measured", lambda _: self._laws({
            "after-paper": (seen, found.networks["agent"], found.arrays["design"], "after"),
        }))  # fmt: skip

    def _imitated(self, rng: np.random.Generator, preset: str) -> Stage:
        config = configured(self.budget, self.study, preset)
        problem = self.problem
        data, fresh = (
            expert_dataset(problem, samples=n, rng=rng, sets=config.sets, time_limit=config.sets_time_limit)
            for n in (config.samples, 100)
        )
        agent = fit_actor_critic(
            data.inputs, data.actions, data.values, action_bounds=problem.action_bounds,
            input_bounds=problem.observation_bounds, rng=rng, network=config.network, config=config.cloning,
        )  # fmt: skip
        with torch.no_grad():
            said = agent(torch.tensor(fresh.inputs, dtype=torch.float32)).numpy()
        spread = ((fresh.actions - fresh.actions.mean(axis=0)) ** 2).sum()
        score = 1 - ((said - fresh.actions) ** 2).sum() / spread
        return Stage({"samples": len(data.inputs)}, {"r2": np.array([score])}, {"agent": agent})

    def _first(self, rng: np.random.Generator, start: Stage, preset: str) -> Stage:
        config = configured(self.budget, self.study, preset)
        found = codesign(
            self.problem, agent=start.networks["agent"], design=self.study.p0, rng=rng, method=config.method,
            config=config.codesign,
        )  # fmt: skip
        return _designed(found)

    def _deployed(self, rng: np.random.Generator, found: Stage) -> Stage:
        real = self.study.real
        evaluation = self.evaluation
        deployment = deploy_and_update(
            self.problem, real.plant, found.networks["agent"], found.arrays["design"],
            x0=np.tile(real.x0, (real.runs, 1)), disturbance=evaluation.deployment(1), rng=rng,
            config=replace(evaluation.config.online, window=evaluation.window, quantile=evaluation.config.quantile),
        )  # fmt: skip
        return Stage({"accepted": len(deployment.changes)}, kept_log(deployment.log), {"agent": deployment.agent})

    def log(self, logged: Stage) -> Trajectory:
        """Trajectory of a deployment's stage."""
        return log_of(logged, self.study.plant.dt)

    def _learned(self, rng: np.random.Generator, logged: Stage) -> Stage:
        twin = DigitalTwin(self.study.model, scale=self.problem.state_scale).update(
            self.log(logged), weight=self.study.weight, rng=rng, config=configured(self.budget, self.study).quantile
        )
        assert twin.discrepancy is not None
        assert twin.scores is not None
        scores = {"rmse": np.sqrt(np.mean(np.square(twin.scores.rmse))), "pinball": np.mean(twin.scores.pinball)}
        return Stage({}, {name: np.array([value]) for name, value in scores.items()},
                     {"quantiles": twin.discrepancy.network})  # fmt: skip

    def twin(self, logged: Stage, learned: Stage) -> DigitalTwin:
        """Twin after the first deployment."""
        taught = DigitalTwin(self.study.model, scale=self.problem.state_scale).remembering(self.log(logged))
        network: Any = learned.networks["quantiles"]
        return replace(taught, discrepancy=Discrepancy(network, self.study.weight, transport=taught.transport))

    def _second(self, rng: np.random.Generator, logged: Stage, twin: DigitalTwin) -> Stage:
        """Co-design on the updated model, and whether it is deployed."""
        evaluation = self.evaluation
        current = Deployable(logged.networks["agent"], logged.arrays["design"], "generation 1")
        window, before = evaluation.training_episode(twin.logs, self.problem.design)
        starts = evaluation.served.trained_from(current.design, evaluation.rng("starts"))
        found = codesign(
            updated_problem(self.problem, twin, window, warm_up=before, starts=starts), agent=current.agent,
            design=current.design, rng=rng, config=evaluation.config.redesign,
            judge=replay_problem(self.problem, twin.logs, window, warm_up=before, starts=starts),
        )  # fmt: skip
        candidate = Deployable(found.agent, found.design, "generation 2")
        verdict = RedesignJudge(evaluation, current, twin).verdict(candidate)
        stage = _designed(found)
        return replace(stage, values=stage.values | {"replaces": verdict.replaces, "verdict": str(verdict)})

    def _measured(
        self, start: Stage, first: Stage, logged: Stage, second: Stage, kept: Stage, again: Stage, twin: DigitalTwin
    ) -> Stage:  # fmt: skip
        """What each policy returns in every place.

        On the updated model stand the two policies of the second co-design; elsewhere what is deployed.
        """
        places = fixed_places(self.study, self.budget)
        one, two = first.arrays["design"], kept.arrays["design"]
        before, after = first.networks["agent"], logged.networks["agent"]
        redesigned, last = kept.networks["agent"], again.networks["agent"]
        laws: dict[str, tuple[Any, ActorCritic, Array, str]] = {
            "before": (places["nominal"], start.networks["agent"], np.asarray(self.study.p0), "before"),
            "after": (places["nominal"], before, one, "after"),
        }
        updated = updated_problem(self.problem, twin)
        assert updated.discrepancy is not None
        free = replace(updated, discrepancy=replace(updated.discrepancy, weight=0 * self.study.weight))
        models = {"penalised": updated, "free": free}
        for name, problem in models.items():
            seen = on_model(name, problem, self.budget.runs)
            laws |= {f"{name}-1": (seen, after, one, "1"),
                     f"{name}-2": (seen, second.networks["agent"], second.arrays["design"], "2")}  # fmt: skip
        for name in ("sigma", "drive", "quiet", "road"):
            if name in places:
                laws |= {f"{name}-1": (places[name], after, one, "1-updated"),
                         f"{name}-2": (places[name], last, two, "2-updated")}  # fmt: skip
        for name in ("quiet", "road"):
            if name in places:
                laws |= {f"{name}-1b": (places[name], before, one, "1"),
                         f"{name}-2b": (places[name], redesigned, two, "2")}  # fmt: skip
        found = self._laws(laws)
        points = 6 if self.problem.design.dim == 1 else 3
        tags = {tag: paper_designs(self.study)[tag] for tag in ("1", "2")}
        for name, problem in models.items():
            beside = lqr_beside(self.problem, on_model(name, problem, min(200, self.budget.runs)), tags, points)
            found.arrays.update(beside.arrays)
            found.values["designs"].update(beside.values["designs"])
        return found

    def _laws(self, laws: dict[str, tuple[Any, ActorCritic, Array, str]]) -> Stage:
        """Values of policies in places: at their own designs (ours), and at the paper's (policy).

        What no update or redesign has changed is run once.
        """
        arrays, texts = {}, {}
        known: dict[Any, dict[str, Array]] = {}
        for key, (seen, agent, design, tag) in laws.items():
            at_paper = paper_designs(self.study)[tag.removesuffix("-updated")]
            weights = b"".join(part.numpy().tobytes() for part in agent.state_dict().values())
            for kind, p in (("ours", design), ("policy", at_paper)):
                law = seen, weights, p.tobytes()
                if law not in known:
                    known[law] = seen(LearnedPolicy(agent, p), p)
                for name, values in known[law].items():
                    row = f"nominal-{key}" if name == "nominal" else f"{name}-{tag}"
                    arrays[f"{row}.{kind}"] = values
                    texts[f"{row}.{kind}"] = p.tolist()
        return Stage({"designs": texts}, arrays)

    def _reference(self) -> None:
        points = 3 if self.budget.quick else 26 if self.problem.design.dim == 1 else 7
        for name, seen in fixed_places(self.study, self.budget).items():
            tags = {tag: p for tag, p in paper_designs(self.study).items() if (tag in "12") != (name == "nominal")}
            self.stage(name, lambda _, seen=seen, tags=tags: lqr_beside(self.problem, seen, tags, points))  # type: ignore[misc]
        self.stage("floors", lambda _: Stage({}, floors(self.study, self.evaluation.deployment_steps)))

    @property
    def programs(self) -> list[str]:
        """Names of the dynamic programs, one a design."""
        return [f"dynamic-{i:02}" for i in range(3 if self.budget.quick else 11)]

    def _optimum(self) -> None:
        self.stage("sets", lambda _: self._sets())
        for name, p in zip(self.programs, grid(self.problem.design, len(self.programs))):
            self.stage(name, lambda _, p=p: self._dynamic(p))  # type: ignore[misc]

    def _sets(self) -> Stage:
        family = feasible_sets(self.problem)
        arrays = {}
        for p in SETS_AT:
            A, B, _ = self.problem.model.matrices(np.array([p]))
            X = self.problem.state_limits(np.array([p])).bounding_box()
            ends = self.problem.input_bounds_at(np.array([p]))
            arrays[f"set-{p}.ours"] = np.array([family.at(np.array([p])).volume])
            arrays[f"set-{p}.optimum"] = np.array([viable(A, B, (float(ends[0][0]), float(ends[1][0])), X)])
        return Stage({}, arrays)

    def _dynamic(self, p: Array) -> Stage:
        A, B, _ = self.problem.model.matrices(p)
        lower, upper = self.problem.state_limits(p).bounding_box()
        ends = self.problem.input_bounds_at(p)
        room = MARGIN * (upper - lower)
        noise: Any = self.study.disturbance
        found = optimal_return(
            A, B, self.study.weights, np.asarray(noise.std), (float(ends[0][0]), float(ends[1][0])),
            (lower - room, upper + room), np.asarray(self.study.x0), steps=self.study.steps,
        )  # fmt: skip
        return Stage({}, {"p": p, "return": np.array([found])})


def _designed(found: Any) -> Stage:
    """Stage of a co-design, with its course."""
    course = {name: getattr(found.history, name) for name in ("iteration", "design", "model_return")}
    arrays = {"design": found.design, **{f"history_{name}": value for name, value in course.items()}}
    return Stage({"status": found.status.name}, arrays, {"agent": found.agent})


def configured(budget: Budget, study: Study, preset: str = "default") -> StudyConfig:
    """Configuration of a preset within a budget."""
    config = configuration(study, preset=preset, quick=budget.quick)
    if not budget.paper:
        config = replace(config, online=replace(config.online, updates=UPDATES))
    if preset == "paper" and not budget.paper:
        epochs = 8 if budget.quick else EPOCHS
        config = replace(config, codesign=replace(config.codesign, iterations=epochs, block=epochs))
    return config


def all_tasks(path: Path, budget: Budget) -> list[Task]:
    """Every task of a reproduction, the long ones first."""
    folder = RunFolder(path)
    own = [
        Task(folder, budget, case, kind, seed)
        for kind in ("loop", "paper")
        for seed in range(budget.seeds)
        for case in CASES[::-1]
    ]
    common = [Task(folder, budget, case, "reference") for case in CASES]
    return [Task(folder, budget, "illustrative", "optimum"), *common, *own]
