"""Evaluation of every generation on the same scenarios."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import linear_mpc, saturated_lqr
from ccdtools.co_design.expert import admissible_inputs
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.risk import Risk, WorstCase, has_cases
from ccdtools.comparison.comparison import Score, compare
from ccdtools.comparison.pid_tuning import baselines
from ccdtools.controllers.controllers import Controller, Passive
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.disturbances.disturbance import Recorded
from ccdtools.evidence.evidence import summary_of
from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import DesignSpace
from ccdtools.progress import at
from ccdtools.scenario import Scenario
from ccdtools.studies.names import IDENTIFIED, NOT_IDENTIFIED, OFFSET_FREE
from ccdtools.studies.presets import StudyConfig
from ccdtools.studies.stage_storage import Stage
from ccdtools.studies.study import Study
from ccdtools.studies.tolerances import MOSTLY_OUTSIDE
from ccdtools.studies.warm_up import warm_up
from ccdtools.tolerances import FEWEST_PAIRS
from ccdtools.twin.deployable import Deployable
from ccdtools.twin.discrepancy import Discrepancy, TwinPlant
from ccdtools.twin.distributions import Distribution, ServedDistributions, logged
from ccdtools.twin.identified import identified_lqr
from ccdtools.twin.judge import Judge
from ccdtools.twin.residuals import Residuals, is_common
from ccdtools.twin.transport import ErrorSplit
from ccdtools.twin.unknown_plant import stated_plant
from ccdtools.twin.updated_plant import UpdatedPlant
from invariant_sets import AdmissibleInputs
from mpc import NotStabilisableError, OffsetFreeMPC


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Scenarios, comparisons and returns of one run of a study."""

    study: Study
    config: StudyConfig
    seed: int  # every draw has a generator of its own, spawned from the seed and a name

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        """Without what it has computed, for another process."""
        return Evaluation, (self.study, self.config, self.seed)

    def rng(self, name: str) -> np.random.Generator:
        """Random generator of a name, independent of interruptions."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=tuple(name.encode())))

    @cached_property
    def problem(self) -> CoDesignProblem:
        """Co-design problem on the nominal model."""
        return self.study.problem()

    def of_plant(self, values: Array) -> Evaluation:
        """Evaluation on the model with its unknown entries at values (m,); a constant part is left to the errors."""
        own, unknown = self.study.plant, self.study.unknown
        assert unknown is not None
        plant, _ = stated_plant(self.problem, unknown).at(self.problem.design, values)
        plant = replace(
            plant, outputs=own.output(plant.x, plant.u, plant.p) if own.ny else None, output_names=own.output_names,
            output_limits=own.output_limits, state_names=own.state_names, input_names=own.input_names,
        )  # fmt: skip
        return replace(self, study=replace(self.study, plant=plant))

    @cached_property
    def deployment_steps(self) -> int:
        """Length of a deployment, capped by configuration and recording."""
        real = self.study.real
        steps = real.steps
        if self.config.real_steps is not None and real.runs == 1:
            steps = min(steps, self.config.real_steps)
        if isinstance(real.disturbance, Recorded):
            steps = min(steps, len(real.disturbance.signal))
        return steps

    def check_deployment(self) -> None:
        """Raise if a deployment has no room for trials, or LQR at the start design leaves X too much under a recording.

        Raises
        ------
        InputError
            If its run diverges, or spends more than half of its samples outside X; or if updates are tried, and there
            is no room for the pairs of one trial after as many samples to learn from.
        """
        steps, trial = self.deployment_steps, self.config.online.trial
        real = self.study.real
        if trial is not None and self.config.online.updates and trial.pairs(real.runs, steps) < 2 * FEWEST_PAIRS:
            got = f"room for {trial.pairs(real.runs, steps)} pairs in a deployment ({real.runs} runs of {steps} steps)"
            expected = f"at least {2 * FEWEST_PAIRS}, of which half are learned from"
            raise InputError("trial", got, expected, "State more runs, or more steps of a single one, with `real`.")
        if not isinstance(real.disturbance, Recorded):
            return
        w = self.recorded(1, "deployment")
        scenario = Scenario(real.plant, real.x0, w[:, :steps])
        lqr = saturated_lqr(self.problem, self.study.p0)
        run = scenario.run(lqr, design=self.study.p0, limit=self.problem.limit)
        outside = float(1 - self.problem.state_limits(self.study.p0).contains(run.states[0, 1:]).mean())
        if run.diverged.any() or outside > MOSTLY_OUTSIDE:
            lost = f"is outside X in {outside:.0%} of the samples"
            if run.diverged.any():
                lost = f"diverges after {run.diverged_at[0]} samples"
            got = f"values up to {np.abs(w).max():.3g}, under which LQR at the start design {lost}"
            raise InputError("real.disturbance", got, "a recording that the plant can bear", "Check its units.")

    def recorded(self, runs: int, name: str) -> Array:
        """Disturbance of the real plant, (runs, T, nw)."""
        return self.study.real.disturbance.sample(runs, self.deployment_steps, self.rng(name))

    @property
    def window(self) -> int:
        """Length of a replayed training episode while deployed."""
        return min(self.study.steps, self.deployment_steps // 10 if self.single else self.deployment_steps)

    def training_episode(self, logs: Sequence[Residuals], space: DesignSpace) -> tuple[int, int]:
        """Counted steps of a redesign's episode, and warm-up steps before them.

        Of several runs that are not very long, an episode is a whole run from its own start.
        """
        if self.study.real.runs > 1 and self.deployment_steps <= 1000:  # longer ones are cut
            return self.deployment_steps, 0
        return self.window, warm_up(self.problem, logs, self.window, space)

    def on_model(self, logs: Sequence[Residuals]) -> Scenario:
        """Scenario on the nominal model that a generation is judged on.

        Before the first log every run starts where the study says. Afterwards it starts where the runs of the newest
        log did, and meets the errors that they met, to their end.
        """
        return self.logged(self.split, logs[-1:], self.rng("replayed runs")).scenario if logs else self._nominal

    @cached_property
    def _nominal(self) -> Scenario:
        x0, w = self.problem.scenarios.sample(self.config.model_runs, self.study.steps, self.rng("model scenario"))
        return Scenario(self.study.model, x0, w)

    def logged(
        self, by: ErrorSplit | UpdatedPlant, logs: Sequence[Residuals], rng: np.random.Generator
    ) -> Distribution:
        """Whole logged runs on the nominal model or the updated one."""
        return logged(by, logs, series=self.single, most=self.config.model_runs, rng=rng)

    @cached_property
    def split(self) -> ErrorSplit:
        """Split of logged errors into disturbances and the rest."""
        return ErrorSplit(self.study.model, self.problem.state_scale)

    @property
    def single(self) -> bool:
        """Whether a deployment is one long run."""
        return self.study.real.runs == 1

    @cached_property
    def served(self) -> ServedDistributions:
        """Distributions that the deployed will serve, by draws of their own."""
        runs = self.config.online.judged
        return ServedDistributions(self.problem, self.study.real.x0, self._fresh("judged", runs), runs)

    def _fresh(self, purpose: str, runs: int) -> dict[str, Array]:
        """Draws (n, T, nw) of every held-out disturbance, of their own for each purpose."""
        steps = min(self.config.held_out_steps, self.deployment_steps)
        fresh = self.study.real.fresh
        return {name: one.sample(runs, steps, self.rng(f"{purpose}: {name}")) for name, one in fresh.items()}

    @cached_property
    def judge(self) -> Judge:
        """Judge that compares two deployables."""
        return Judge(self.problem, self.study.plant, self.admissible, self.window, self.study.accepted_loss)

    def nominal_deployment(self) -> Scenario:
        """Scenario that predicts a deployment on the nominal model."""
        real = self.study.real
        runs = min(self.config.model_runs, max(16, 250_000 // self.deployment_steps))  # samples
        w = self.study.disturbance.sample(runs, self.deployment_steps, self.rng("nominal deployment"))
        return Scenario(self.study.model, np.tile(real.x0, (runs, 1)), w)

    def deployment(self, generation: int) -> Array:
        """Disturbances of a deployment, (runs, T, nw).

        A single run is the same in every generation. Of several, every second one is: there two generations are
        compared run by run; the others are fresh, for what there is to be learned.
        """
        runs = self.study.real.runs
        common = self.recorded(runs, "deployment")
        if runs == 1:
            return common
        w = self.recorded(runs, f"deployment-{generation}")
        return np.where(is_common(np.arange(runs))[:, None, None], common, w)

    def on_updated(self, discrepancy: Discrepancy, *, noise: str) -> Scenario:
        """Scenario on the model updated by a discrepancy."""
        n = self.config.model_runs
        steps = self.study.steps
        rng = self.rng("updated scenario")
        plant = TwinPlant(self.study.model, replace(discrepancy, noise=noise))
        return Scenario(plant, self.study.model_starts(n, rng), rng.random((n, steps, self.study.plant.nx)))

    def on_real(self) -> Scenario:
        """Scenario of a single long deployment, or of many like it."""
        real = self.study.real
        runs = 1 if real.runs == 1 else self.config.real_runs
        w = self.recorded(runs, "deployment" if runs == 1 else "real scenario")
        return Scenario(real.plant, np.tile(real.x0, (runs, 1)), w)

    @cached_property
    def held_out(self) -> dict[str, Scenario]:
        """Fresh runs of the real plant, by disturbance name."""
        real = self.study.real
        runs = self.config.held_out_runs
        x0 = np.tile(real.x0, (runs, 1))
        return {name: Scenario(real.plant, x0, w) for name, w in self._fresh("held out", runs).items()}

    @cached_property
    def _tuned(self) -> Callable[[tuple[float, ...]], dict[str, Controller]]:
        """Unused baselines of a design, tuned once."""

        def tuned(design: tuple[float, ...]) -> dict[str, Controller]:
            p = np.array(design)
            own = {name: self.study.law(name, self.problem, p) for name in self.study.laws}
            return baselines(self.problem, p, rng=self.rng("baselines")) | own

        return cache(tuned)

    def baselines(self, design: Array, logs: Sequence[Residuals] = ()) -> dict[str, Controller]:
        """Baselines at a design, tuned once and copied, with those that know the logs."""
        informed: dict[str, Controller] = {}
        if logs:
            at_rest = OffsetFreeMPC(
                linear_mpc(self.problem, design), np.zeros((0, self.problem.model.nx)), reference=()
            )
            informed[OFFSET_FREE] = at_rest
            try:
                informed[IDENTIFIED] = identified_lqr(self.problem, design, logs)
            except NotStabilisableError:
                informed[IDENTIFIED] = Passive(self.problem.model.nu, remark=NOT_IDENTIFIED)
        return deepcopy(self._tuned(tuple(design))) | informed

    def comparison(
        self, rng: np.random.Generator, generation: int, designed: Deployable, deployed: Deployable,
        logs: Sequence[Residuals],
    ) -> Stage:  # fmt: skip
        """Comparison of every controller at one design, on model and real plant.

        On the model stands the policy as designed, on the real plant the one deployed at the end.
        """
        at("baselines at the design")
        design = designed.design
        controllers = self.baselines(design, logs)
        rows: list[dict[str, Any]] = []
        arrays: dict[str, Array] = {}
        for plant, name, scenario, one in (
            ("model", "replayed errors" if logs else "nominal", self.on_model(logs), designed),
            ("real", "real", self.on_real(), deployed),
        ):
            policy = LearnedPolicy(one.agent, design)
            admissible = self.admissible(design) if plant == "real" else None
            as_deployed = one.controller(admissible)
            everyone = {**controllers, "learned": as_deployed, "learned (sampled)": policy.sampled(rng)}
            if admissible is not None:
                everyone["learned, no filter"] = policy
            rows += self.rows(
                everyone, scenario, design, {"plant": plant, "model": name, "generation": generation},
                mpc_runs=self.config.mpc_runs, risk=self._shown_risk(plant, logs),
            )  # fmt: skip
            bands = self._bands(scenario, design, {"LQR": controllers["LQR"], "learned": as_deployed})
            arrays |= {f"{plant}_{key}": band for key, band in bands.items()}
        return Stage({"rows": rows}, arrays)

    def _shown_risk(self, plant: str, judged_on: Sequence[Residuals]) -> Risk | None:
        """Worst case, if asked for and the runs have cases; else None."""
        asked = self.study.risk
        if not isinstance(asked, WorstCase) or (plant == "model" and judged_on):
            return None
        scenarios = self.problem.scenarios if plant == "model" else self.study.real.disturbance
        return asked.over(scenarios) if has_cases(scenarios) else None

    def admissible(self, design: Array) -> AdmissibleInputs | None:
        """Input filter of a design; None if the study has none."""
        return None if self.study.filter == "none" else self._filters(tuple(design))

    @cached_property
    def _filters(self) -> Callable[[tuple[float, ...]], AdmissibleInputs]:
        return cache(lambda design: admissible_inputs(self.problem, np.array(design)))

    def deployed(self, one: Deployable) -> Controller:
        """Policy as deployed on the real plant, behind the study's filter."""
        return one.controller(self.admissible(one.design))

    def returns(self, designed: Deployable, logs: Sequence[Residuals], learned: Discrepancy) -> Stage:
        """Returns of a policy as designed, on judged, nominal and updated model."""
        policy = LearnedPolicy(designed.agent, designed.design)
        return Stage({
            "model": "replayed errors" if logs else "nominal",
            "model_return": self._mean_return(policy, self.on_model(logs)),
            "nominal_return": self._mean_return(policy, self.on_model(())),
            "updated_model_return": {
                "median": self._mean_return(policy, self.on_updated(learned, noise="none")),
                "quantiles": self._mean_return(policy, self.on_updated(learned, noise="quantiles")),
            },
        })  # fmt: skip

    def rows(
        self, everyone: Mapping[str, Controller], scenario: Scenario, design: Array, place: dict[str, Any], *,
        mpc_runs: int, risk: Risk | None = None,
    ) -> list[dict[str, Any]]:  # fmt: skip
        """Table rows of controllers compared in one place, of which MPC sees a few runs."""
        scores = compare(
            everyone, scenario, design=design, objective=self.study.objective, X=self.problem.state_limits(design),
            limit=self.problem.limit, few={"MPC": mpc_runs, OFFSET_FREE: mpc_runs}, metrics=self.study.metrics,
            output_limits=self.problem.output_limits, risk=risk,
        )  # fmt: skip
        return [place | self._row(design, score) for score in scores]

    def _row(self, design: Array, score: Score) -> dict[str, Any]:
        space = self.problem.design
        values: dict[str, Any] = asdict(score)
        summary, seconds, *_ = (values.pop(name) for name in ("summary", "step_time", "in_risk", "runs"))
        return values | dict(summary) | {
            "step_time_us": 1e6 * seconds, "design": space.as_dict(design),
            "active_bounds": space.active_bounds(design), "active_constraints": space.active_constraints(design),
        }  # fmt: skip

    def _mean_return(self, policy: LearnedPolicy, scenario: Scenario) -> dict[str, Any]:
        """Return statistics of undiverged runs, and the diverged fraction."""
        run = scenario.run(policy, design=policy.design, limit=self.problem.limit)
        return asdict(summary_of(run, self.study.objective)) | {"diverged": run.diverged.mean()}

    def _bands(self, scenario: Scenario, design: Array, controllers: Mapping[str, Controller]) -> dict[str, Array]:
        """Edges and mean (3, T, ·) of the 95 % band of signals."""
        shown = scenario.first(min(500, len(scenario.x0)), min(1000, scenario.steps))
        bands = {}
        for name, controller in controllers.items():
            run = shown.run(controller, design=design, limit=self.problem.limit)
            for kind, values in (("states", run.states), ("inputs", run.inputs)):
                kept = values[~run.diverged] if not run.diverged.all() else values
                low, high = np.percentile(kept, [2.5, 97.5], axis=0)
                bands[f"{name}_{kind}"] = np.stack([low, kept.mean(axis=0), high])
        return bands
