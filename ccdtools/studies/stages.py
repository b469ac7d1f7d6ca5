"""What each stage of the loop computes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.codesign import codesign
from ccdtools.co_design.configuration import CoDesignConfig
from ccdtools.co_design.expert import expert_dataset
from ccdtools.co_design.learned_result import LearnedCoDesign
from ccdtools.controllers.controllers import Controller
from ccdtools.exceptions import InputError
from ccdtools.progress import Echo
from ccdtools.scenario import Scenario
from ccdtools.studies.account import account, region_line
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.held_out import GenerationRecord, former_services, held_out_stage
from ccdtools.studies.redesign import (
    InService,
    RedesignDecision,
    judge_redesign,
    promised,
    same_design,
    same_service,
)
from ccdtools.studies.report.formatting import FORMER
from ccdtools.studies.service import Served, ServiceStatus, judge_deployment, promise_of
from ccdtools.studies.stage_storage import Stage
from ccdtools.studies.trust_region import Trust, doubt_of, edges, in_whole_box, within
from ccdtools.trajectory import Trajectory
from ccdtools.twin.deployment import deploy_and_update
from ccdtools.twin.discrepancy import Discrepancy, QuantileScores
from ccdtools.twin.free_running import held_out_bands
from ccdtools.twin.limits_kept import Breach, breach
from ccdtools.twin.recombined_returns import NOT_ASKED, Independence, independence
from ccdtools.twin.replay import replay_problem, updated_problem
from ccdtools.twin.residuals import Residuals, residuals
from ccdtools.twin.twin import DigitalTwin
from learning.warm_start import fit_actor_critic

MORE_EPISODES = 4  # a climb fits the runs that it is given: of 256, with tall costs, hardly anything is left on others
POLICY_ALONE = "its policy at the present design"


@dataclass(frozen=True, eq=False)
class LoopStages:
    """The stages of one run; each takes its generator first and returns what is to be kept.

    Attributes
    ----------
    evaluation : Evaluation
        The study, its configuration, and what the stages are measured on.
    progress : bool
        Show progress bars.
    echo : callable, optional
        Takes a line of text now and then where there are no bars.
    """

    evaluation: Evaluation
    progress: bool
    echo: Echo | None = None

    def initialise(self, rng: np.random.Generator) -> Stage:
        """The first policy: a network trained to imitate the expert."""
        config = self.evaluation.config
        problem = self.evaluation.problem
        data = expert_dataset(
            problem, samples=config.samples, rng=rng, expert=config.expert, gamma=config.codesign.ppo.gamma,
            sets=config.sets, time_limit=config.sets_time_limit, progress=self.progress, echo=self.echo,
        )  # fmt: skip
        assert data.sets is not None
        if self.echo is not None:
            self.echo(f"    {len(data.inputs)} samples; imitation takes {config.cloning.steps} steps")
        agent = fit_actor_critic(
            data.inputs, data.actions, data.values, action_bounds=problem.action_bounds,
            input_bounds=problem.observation_bounds, rng=rng, network=config.network, config=config.cloning,
            progress=self.progress,
        )  # fmt: skip
        values = {
            "expert": config.expert, "candidates": config.samples, "samples": len(data.inputs),
            "acceptance": data.acceptance, "diverged": data.diverged, "sets": data.sets.as_dict(),
        }  # fmt: skip
        report = [f"{data.sets} ({data.sets.seconds:.2g} s)",
                  f"{data.acceptance:.0%} of {config.samples} candidates feasible, {len(data.inputs)} samples imitated"]
        return Stage(values | {"report": report}, networks={"agent": agent})

    def co_design(
        self, rng: np.random.Generator, current: InService, twin: DigitalTwin, trust: Trust,
        history: Sequence[GenerationRecord] = (),
    ) -> Stage:  # fmt: skip
        """The first co-design on the nominal model; later ones on the updated model, taken if they are worth it.

        A redesign is trained on the median model, with what that leaves unexplained replayed, and judged on replays of
        the logged errors themselves: a model fitted in closed loop can mistake the road for a consequence of the state.
        Where the errors do not depend on each other in time it is trained on what it is judged on, recombined: there
        the median has nothing to tell, and what it says is chance.
        Beside it stand the start of the study and what has been in service before: the best of those taken is deployed.
        """
        problem = self.evaluation.problem
        config = self.evaluation.config
        if twin.discrepancy is None:
            first = codesign(
                problem, agent=current.agent, design=current.design, rng=rng, method=config.method,
                config=config.codesign, progress=self.progress,
            )  # fmt: skip
            return self._co_designed(first, InService(first.agent, first.design), twin, None)
        doubt = doubt_of(twin, problem.state_scale)
        limited = trust.limits(doubt)
        region = within(problem, current.design, trust.radius) if limited else problem
        window, before = self.evaluation.training_episode(twin.logs, region.design)
        judge = replay_problem(problem, twin.logs, window, warm_up=before)
        recombines = self.evaluation.replay(twin.logs).recombines
        training = judge if recombines else updated_problem(problem, twin, window, warm_up=before)
        if limited:  # only now: a log may be from outside the region
            training, judge = (within(one, current.design, trust.radius) for one in (training, judge))
        result = codesign(
            training, agent=current.agent, design=current.design, rng=rng, method=config.method,
            config=_of_many_runs(config.redesign) if recombines else config.redesign, judge=judge,
            progress=self.progress,
        )  # fmt: skip
        result = in_whole_box(result, region.design, problem.design)
        proposals = self._proposals(result, current, history)
        decisions = self._judged(proposals, current, twin)
        taken = [name for name, decision in decisions.items() if decision.accepted]
        best = max(taken, key=lambda name: decisions[name].gain.mean, default=None)
        chosen = current if best is None else proposals[best]
        redesign = self._redesign(result, best, current, decisions)
        redesign["region"] = {
            "radius": trust.radius if limited else None, **asdict(doubt), "text": doubt.describe(),
            "edges": edges(result.design, region.design, problem.design),
        }  # fmt: skip
        return self._co_designed(result, chosen, twin, redesign)

    def _proposals(
        self, result: LearnedCoDesign, current: InService, history: Sequence[GenerationRecord]
    ) -> dict[str, InService]:
        """What is judged, by name: the redesign, its policy without its design, the start, and what was in service."""
        proposals = {"redesign": InService(result.agent, result.design)}
        if not same_design(self.evaluation.problem.design, result.design, current.design):
            proposals[POLICY_ALONE] = InService(result.agent, current.design)
        return proposals | {FORMER + name: service for name, service in former_services(history, current).items()}

    def _judged(
        self, proposals: Mapping[str, InService], current: InService, twin: DigitalTwin
    ) -> dict[str, RedesignDecision]:
        """The decisions by name; the policy of a redesign is looked at alone only if the redesign is not taken."""
        decisions: dict[str, RedesignDecision] = {}
        for name, proposal in proposals.items():
            if name != POLICY_ALONE or not decisions["redesign"].accepted:
                decisions[name] = judge_redesign(self.evaluation, proposal, current, twin.logs, twin)
        return decisions

    def _redesign(
        self, result: LearnedCoDesign, chosen: str | None, current: InService, decisions: Mapping[str, RedesignDecision]
    ) -> dict[str, Any]:
        """What became of a redesign, as plain values; `chosen` names what is deployed in the place of `current`."""
        space = self.evaluation.problem.design
        return {
            "proposed": space.as_dict(result.design), "accepted": chosen is not None, "chosen": chosen,
            "from": space.as_dict(current.design), "texts": [d.describe(name) for name, d in decisions.items()],
            "decisions": {name: decision.as_dict() for name, decision in decisions.items()},
        }  # fmt: skip

    def _co_designed(
        self, result: LearnedCoDesign, chosen: InService, twin: DigitalTwin, redesign: dict[str, Any] | None
    ) -> Stage:
        """A co-design, with the policy and design that go into service, the decisions, and what they promise."""
        history = result.history
        space = self.evaluation.problem.design
        arrays = {f"history_{name}": getattr(history, name) for name in history.__dataclass_fields__}
        check = None if result.gradients is None else asdict(result.gradients)
        report = [*str(result.gradients).splitlines()] if result.gradients is not None else []
        report += result.describe()
        if redesign is not None:
            report += [region_line(redesign["region"]), f"proposed: {space.describe(result.design)}",
                       *redesign["texts"]]  # fmt: skip
        active = space.active_bounds(chosen.design)
        named = ", ".join(f"{name} at its {side} bound" for name, side in active.items())
        kept = ", ".join(space.active_constraints(chosen.design))
        held = f"active bounds: {named or 'none'}" + (f"; active constraints: {kept}" if kept else "")
        report.append(f"{space.describe(chosen.design)}; {held}")
        if result.limits is not None:
            report.append(str(result.limits))
        promise = promised(self.evaluation, chosen, twin.logs)
        report.append(f"promised return of the deployment {promise.mean:.4g}")
        values = {"active_bounds": active, "gradient_check": check, "ended": result.as_dict(), "redesign": redesign,
                  "promised": asdict(promise), "limits": _limits(result), "report": report}  # fmt: skip
        return Stage(values, {"design": chosen.design, **arrays}, {"agent": chosen.agent})

    def deploy(
        self, rng: np.random.Generator, generation: int, found: Stage, former: Served | None, trust: Trust,
        twin: DigitalTwin | None = None,
    ) -> Stage:  # fmt: skip
        """The policy on the real plant, updated on the way; the log, and whether it stays in service."""
        real = self.evaluation.study.real
        evaluation = self.evaluation
        online = evaluation.config.online
        current = InService(found.networks["agent"], found.arrays["design"])
        deployment = deploy_and_update(
            evaluation.problem, real.plant, current.agent, current.design, x0=np.tile(real.x0, (real.runs, 1)),
            disturbance=evaluation.deployment(generation), rng=rng,
            config=replace(
                online, window=evaluation.window, recombine=evaluation.config.recombine and online.recombine
            ),
            progress=self.progress, admissible=evaluation.admissible(current.design),
            former=[] if twin is None else [one for one in twin.logs if one.independent], twin=twin,
        )  # fmt: skip
        log = deployment.log
        if former is None and log.diverged.all():
            place = evaluation.problem.design.describe(current.design)
            got = f"a start from which every run of deployment {generation} diverged at {place}"
            raise InputError("real.x0", got, "one that some design can recover from")
        redesign = found.values["redesign"]
        redesigned = redesign is not None and redesign["accepted"]
        delivery = judge_deployment(
            log, None if former is None else former.log, evaluation.study.objective,
            promise_of(found.values["promised"]), redesigned=redesigned, risk=evaluation.study.judged_in,
            stretch=evaluation.window,
        )  # fmt: skip
        updates = [asdict(update) for update in deployment.updates]
        carried = former is not None and not redesigned and not same_service(current, former.designed)
        broken = None
        if former is not None and delivery.status.replaces and (redesigned or carried or deployment.changed):
            broken = self._breach(log, former.log)
            delivery = delivery if broken is None else replace(delivery, status=ServiceStatus.LIMITS)
        moved = redesigned and redesign["decisions"][redesign["chosen"]]["moved"]
        kept = delivery.judge.kept if moved else None  # only a design that moved shows how errors follow the design
        values = {
            "deployed_return": asdict(delivery.returns), "diverged": log.diverged.mean(), "updates": updates,
            "delivery": delivery.as_dict() | {
                "former": None if former is None else former.generation, "carried": carried,
                "breach": "" if broken is None else str(broken),
            },
            "trust": asdict(trust.after(kept)),
        }  # fmt: skip
        space = evaluation.problem.design
        sentence = account(generation, values, redesign, space.describe(current.design))
        return Stage(values | {"account": sentence, "report": [sentence]}, packed(log), {"agent": deployment.agent})

    def _breach(self, log: Trajectory, former: Trajectory) -> Breach | None:
        """How a deployment broke limits that the one before it had kept; MPC is asked on the errors that it met."""
        study = self.evaluation.study
        errors = residuals(study.model, log)
        x0, w = self.evaluation.replay([errors]).whole()
        scenario = Scenario(self.evaluation.split.replayed_model, x0, w)
        return breach(self.evaluation.problem, scenario, log, former, study.real.plant)

    def learn(self, rng: np.random.Generator, twin: DigitalTwin, log: Trajectory, deployed: Stage) -> Stage:
        """The quantiles of the one-step errors of the nominal model along all logs, and how well draws hold."""
        if log.diverged.all() and twin.discrepancy is not None and twin.scores is not None:
            report = ["every run diverged: nothing was learned from them"]
            values = {"scores": asdict(twin.scores), "free_running": None, "report": report}
            return Stage(values, networks=_networks(twin.discrepancy))
        updated = twin.update(
            log, weight=self.evaluation.study.weight, rng=rng, config=self.evaluation.config.quantile,
            progress=self.progress,
        )  # fmt: skip
        assert updated.discrepancy is not None
        assert updated.scores is not None
        scores = updated.scores
        report = [f"held-out coverage {_shares(scores.coverage)} (nominal {scores.nominal_coverage:.0%})"]
        policy = self.evaluation.in_service(deployed.networks["agent"], log.design)
        since = max((update["after"] for update in deployed.values["updates"] if update["accepted"]), default=0)
        bands = held_out_bands(updated, log, policy, rng=rng, since=since)
        if bands is not None:
            report += [f"free-running bands of {bands.steps[-1]} steps: coverage {_shares(bands.coverage[-1])} of 80%"]
        independent = self._independence(log, policy, len(twin.logs))
        if len(log.diverged) > 1:
            report.append(independent.describe())
        values = {"scores": asdict(scores), "free_running": None if bands is None else bands.summary(),
                  "independence": asdict(independent)}  # fmt: skip
        return Stage(values | {"report": report}, networks=_networks(updated.discrepancy))

    def _independence(self, log: Trajectory, policy: Controller, number: int) -> Independence:
        """Whether the runs of a log may be recombined; decided once, on all of them."""
        evaluation = self.evaluation
        replay = evaluation.replay([residuals(evaluation.study.model, log)])

        def drive(x0: Array, w: Array) -> tuple[Trajectory]:
            """The runs of the policy in service."""
            scenario = Scenario(evaluation.split.replayed_model, x0, w)
            return (scenario.run(policy, design=log.design, limit=evaluation.problem.limit),)

        if not evaluation.config.recombine:
            return NOT_ASKED
        return independence(replay, drive, evaluation.study.objective, evaluation.rng(f"independence-{number}"))

    def learned_twin(self, twin: DigitalTwin, log: Trajectory, learned: Stage) -> DigitalTwin:
        """The twin that `learn` has left behind."""
        if log.diverged.all():
            return twin
        taught = twin.remembering(log)
        newest = replace(taught.logs[-1], independent=learned.values["independence"]["independent"])
        taught = replace(taught, logs=(*taught.logs[:-1], newest))
        discrepancy = Discrepancy(
            learned.networks["quantiles"], self.evaluation.study.weight, transport=taught.transport,
            copula=learned.networks.get("copula"),
        )  # fmt: skip
        return replace(taught, discrepancy=discrepancy, scores=QuantileScores(**learned.values["scores"]))

    def compare(
        self, rng: np.random.Generator, generation: int, designed: InService, deployed: InService,
        logs: Sequence[Residuals],
    ) -> Stage:  # fmt: skip
        """Every controller at the design: on the model that it was judged on, and on the real plant."""
        return self.evaluation.comparison(
            generation, designed.design, designed=designed.agent, deployed=deployed.agent, judged_on=logs, rng=rng
        )

    def held_out(self, rng: np.random.Generator, history: Sequence[GenerationRecord]) -> Stage:
        """Every controller under disturbances that no generation has met, and the gains there and where deployed."""
        return held_out_stage(self.evaluation, history)

    def evaluate(
        self, rng: np.random.Generator, designed: InService, logs: Sequence[Residuals], twin: DigitalTwin
    ) -> Stage:
        """Returns of the policy as designed, on every model."""
        assert twin.discrepancy is not None
        return self.evaluation.returns(designed.agent, designed.design, judged_on=logs, learned=twin.discrepancy)


def _of_many_runs(config: CoDesignConfig) -> CoDesignConfig:
    """The co-design with more episodes a gradient: where runs are recombined there are as many as are asked for."""
    return replace(config, pathwise_runs=MORE_EPISODES * config.pathwise_runs)


def _limits(result: LearnedCoDesign) -> dict[str, Any] | None:
    """How a co-design kept its state limits, as plain values; None where they were switched off."""
    if result.limits is None:
        return None
    return asdict(result.limits) | {"kept": result.limits.kept, "text": str(result.limits)}


def _networks(discrepancy: Discrepancy) -> dict[str, Any]:
    """What is kept of a discrepancy."""
    parts = {"quantiles": discrepancy.network, "copula": discrepancy.copula}
    return {name: part for name, part in parts.items() if part is not None}


def _shares(values: Sequence[float]) -> str:
    """Whole per cents, one after the other."""
    return ", ".join(f"{value:.0%}" for value in values)


def packed(log: Trajectory) -> dict[str, Any]:
    """The arrays of a log."""
    return {
        "states": log.states, "inputs": log.inputs, "disturbances": log.disturbances,
        "diverged_at": log.diverged_at, "design": log.design,
    }  # fmt: skip


def unpacked(stage: Stage, dt: float) -> Trajectory:
    """The log that a deployment has left behind."""
    return Trajectory(**stage.arrays, dt=dt)  # type: ignore[arg-type]
