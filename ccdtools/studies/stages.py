"""Stages of the loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.codesign import codesign
from ccdtools.co_design.learned_result import LearnedCoDesign
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.evidence.drift import DriftStatus
from ccdtools.evidence.evidence import Pairing, Violation, summary_of
from ccdtools.evidence.verdict import Verdict
from ccdtools.exceptions import InputError
from ccdtools.scenario import Scenario
from ccdtools.studies.account import account, proposed, refused, region_line
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.first_policy import imitated_at
from ccdtools.studies.held_out import GenerationRecord, formerly_deployed
from ccdtools.studies.names import FORMER, POLICY_ALONE
from ccdtools.studies.redesign import Redesign, RedesignJudge, described, predicted, same_design
from ccdtools.studies.redesign_cost import RedesignAction
from ccdtools.studies.service import Deployed, judge_deployment
from ccdtools.studies.stage_storage import Stage, kept_log
from ccdtools.studies.trust_region import Trust, attribute_errors, edges, in_whole_box, within
from ccdtools.trajectory import Trajectory
from ccdtools.twin.deployable import Deployable
from ccdtools.twin.deployment import deploy_and_update
from ccdtools.twin.discrepancy import Discrepancy, QuantileScores
from ccdtools.twin.free_running import held_out_bands
from ccdtools.twin.limits_kept import violation
from ccdtools.twin.log_drift import drift_of_log, outside_data
from ccdtools.twin.plant_fit import FitStatus, fit_plant
from ccdtools.twin.replay import Replay, replay_problem, updated_problem
from ccdtools.twin.residuals import residuals
from ccdtools.twin.twin import DigitalTwin
from learning.networks import ActorCritic


@dataclass(frozen=True, eq=False)
class LoopStages:
    """Stages of one run; each takes its generator first."""

    evaluation: Evaluation  # the study, its configuration, and what the stages are measured on
    progress: bool  # show progress bars

    def initialise(self, rng: np.random.Generator) -> Stage:
        """First policy: a network trained to imitate an expert."""
        config = self.evaluation.config
        study = self.evaluation.study
        first = imitated_at(self.evaluation.problem, study, config, rng, progress=self.progress)
        data = first.data
        expert = config.expert if callable(first.expert) else first.expert
        values = {"expert": expert, "samples": first.samples}
        imitated = f"{expert} of the model imitated in {first.samples} samples"
        report = [f"LQR brings nothing to rest: {imitated if first.samples else 'PPO learned the policy from scratch'}"]
        if data is not None:
            assert data.sets is not None
            values |= {
                "candidates": config.samples, "acceptance": data.acceptance, "diverged": data.diverged,
                "sets": data.sets.as_dict(),
            }  # fmt: skip
            report = [
                f"{data.sets} ({data.sets.seconds:.2g} s)",
                f"{data.acceptance:.0%} of {config.samples} candidates feasible, {first.samples} samples imitated",
            ]
        return Stage(values | {"report": report}, networks={"agent": first.agent})

    def co_design(
        self, rng: np.random.Generator, generation: int, current: Deployable, twin: DigitalTwin, trust: Trust,
        history: Sequence[GenerationRecord] = (),
    ) -> Stage:  # fmt: skip
        """Co-design on the nominal model, or redesign on the updated one.

        A redesign is trained on the median model, with what that leaves unexplained replayed, and ranked on replays of
        the logged errors themselves: a model fitted in closed loop can mistake the road for a consequence of the state.
        Half of its episodes start where the log was, half where else it will serve. Beside it stand the start of the
        study and what has been deployed before: the best of those that may replace what is deployed is deployed.
        """
        problem = self.evaluation.problem
        config = self.evaluation.config
        name = f"the design of generation {generation}"
        if twin.discrepancy is None:
            first = codesign(
                problem, agent=current.agent, design=current.design, rng=rng, method=config.method,
                config=config.codesign, progress=self.progress,
            )  # fmt: skip
            return self._co_designed(first, Deployable(first.agent, first.design, name), twin)
        doubt = attribute_errors(twin, problem.state_scale)
        radius = trust.radius if trust.limits(doubt) else None
        region = problem if radius is None else within(problem, current.design, radius)
        result = in_whole_box(self._redesigned(rng, current, twin, region, radius), region.design, problem.design)
        judge = RedesignJudge(self.evaluation, current, twin)
        proposals = self._proposals(Deployable(result.agent, result.design, name), current, history)
        verdicts: dict[str, Verdict] = {}
        for name, proposal in proposals.items():
            if name != POLICY_ALONE or not verdicts["redesign"].replaces:  # a policy is judged alone after a refusal
                verdicts[name] = judge.verdict(proposal)
        dear = [name for name in verdicts if judge.moved(proposals[name])]
        dearest = max(dear, key=lambda name: verdicts[name].gain.mean, default=None)
        worth = None if dearest is None else judge.worth(verdicts[dearest], _waited(history))
        barred = dear if worth is not None and worth.status is not RedesignAction.REDESIGN else []
        deployed = [name for name, verdict in verdicts.items() if verdict.replaces and name not in barred]
        best = max(deployed, key=lambda name: verdicts[name].evidence[0].gain.mean, default=None)
        name = "redesign" if best is None else best
        moved = judge.moved(proposals[name])
        space = problem.design
        held = edges(result.design, region.design, space)
        place = space.describe(proposals[name].design)
        said = refused(verdicts[name], moved=moved)
        if best is not None:
            said = proposed(best, verdicts[name], place, held, moved=moved)
        decisions = {name: judge.as_dict(proposals[name], verdict) for name, verdict in verdicts.items()}
        texts = [described(name, decision) for name, decision in decisions.items()]
        if worth is not None:
            texts.append(f"{dearest}: {worth}")
            said = f"{said}; {texts[-1]}" if best is None else said
        redesign = {
            "proposed": space.as_dict(result.design), "accepted": best is not None, "chosen": best,
            "from": space.as_dict(current.design), "decisions": decisions,
            "texts": texts,
            "region": {"radius": radius, **asdict(doubt), "text": doubt.describe(), "edges": held},
        } | ({} if worth is None else {"worth": worth.as_dict() | {"text": texts[-1]}})  # fmt: skip
        found = self._co_designed(result, current if best is None else proposals[best], twin, redesign)
        decided = Redesign(best is not None, moved, said)
        return replace(found, values=found.values | {"decided": asdict(decided)})

    def _redesigned(
        self, rng: np.random.Generator, current: Deployable, twin: DigitalTwin, region: CoDesignProblem,
        radius: float | None,
    ) -> LearnedCoDesign:  # fmt: skip
        """Co-design on the updated model, within the region of a radius if there is one."""
        problem = self.evaluation.problem
        window, before = self.evaluation.training_episode(twin.logs, region.design)
        starts = self.evaluation.served.trained_from(current.design, self.evaluation.rng("starts"))
        ranking = replay_problem(problem, twin.logs, window, warm_up=before, starts=starts)
        training = updated_problem(problem, twin, window, warm_up=before, starts=starts)
        if radius is not None:  # only now: a log may be from outside the region
            training, ranking = (within(one, current.design, radius) for one in (training, ranking))
        config = self.evaluation.config
        return codesign(
            training, agent=current.agent, design=current.design, rng=rng, method=config.method,
            config=config.redesign, judge=ranking, progress=self.progress,
        )  # fmt: skip

    def _proposals(
        self, redesign: Deployable, current: Deployable, history: Sequence[GenerationRecord]
    ) -> dict[str, Deployable]:
        """Proposals by name: redesign, its policy alone, start and former deployables."""
        proposals = {"redesign": redesign}
        if not same_design(self.evaluation.problem.design, redesign.design, current.design):
            proposals[POLICY_ALONE] = replace(redesign, design=current.design)
        return proposals | {FORMER + name: service for name, service in formerly_deployed(history, current).items()}

    def _co_designed(
        self, result: LearnedCoDesign, chosen: Deployable, twin: DigitalTwin,
        redesign: dict[str, Any] | None = None,
    ) -> Stage:  # fmt: skip
        """Stage of a co-design, with what is deployed, decided and predicted."""
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
        limits = None
        if result.limits is not None:
            report.append(str(result.limits))
            limits = asdict(result.limits) | {"kept": result.limits.kept, "text": str(result.limits)}
        expected = predicted(self.evaluation, chosen, twin.logs)
        report.append(f"predicted return of the deployment {expected.mean:.4g}")
        values = {"active_bounds": active, "gradient_check": check, "ended": result.as_dict(), "redesign": redesign,
                  "predicted": asdict(expected), "limits": limits, "report": report,
                  "name": chosen.name}  # fmt: skip
        return Stage(values, {"design": chosen.design, **arrays}, {"agent": chosen.agent})

    def deploy(
        self, rng: np.random.Generator, generation: int, found: Stage, current: Deployable, former: Deployed | None,
        trust: Trust, twin: DigitalTwin | None = None,
    ) -> Stage:  # fmt: skip
        """Deployment with its updates, and whether it stays."""
        evaluation = self.evaluation
        study = evaluation.study
        real = study.real
        config = evaluation.config
        designed = deployable_of(found)
        deployment = deploy_and_update(
            evaluation.problem, real.plant, designed.agent, designed.design, x0=np.tile(real.x0, (real.runs, 1)),
            disturbance=evaluation.deployment(generation), rng=rng,
            config=replace(
                config.online, window=evaluation.window, quantile=config.quantile, accept_loss=study.accepted_loss
            ),
            progress=self.progress, admissible=evaluation.admissible(designed.design),
            former=[] if twin is None else twin.logs, served=evaluation.served,
        )  # fmt: skip
        log = deployment.log
        if former is None and log.diverged.all():
            place = evaluation.problem.design.describe(designed.design)
            got = f"a start from which every run of deployment {generation} diverged at {place}"
            raise InputError("real.x0", got, "one that some design can recover from")
        redesign = Redesign(**found.values["decided"]) if "decided" in found.values else None
        redesigned = redesign is not None and redesign.accepted
        known = () if twin is None else twin.logs
        moved = redesign is not None and redesign.accepted and redesign.moved
        drift = None
        if config.drift is not None and twin is not None and known and not log.diverged.all():
            drift = drift_of_log(twin, log, level=config.drift)
        changed = drift is not None and drift.status is DriftStatus.DRIFT and not redesigned  # else by what is new
        delivery = judge_deployment(
            deployed_of(generation, designed, deployment.agent, log, deployment.changes), former, current,
            Pairing(study.objective, study.judged_in, evaluation.window),
            lambda steps: predicted(evaluation, designed, known, steps), redesigned=redesigned, limits=self._violation,
            other_plant=changed,
        )  # fmt: skip
        kept = delivery.agreement.kept if moved else None  # only a design that moved shows how errors follow the design
        place = evaluation.problem.design.describe(designed.design)
        sentence = account(generation, delivery, deployment.updates, redesign, place)
        report = [f"update {k} refused, {update.verdict.status.value}: {update.verdict.reason}"
                  for k, update in enumerate(deployment.updates, 1) if not update.accepted]  # fmt: skip
        notes = [
            f"update {k} on trial, {update.trial}" for k, update in enumerate(deployment.updates, 1) if update.trial
        ]
        watched: dict[str, Any] = {}
        if twin is not None and known and not log.diverged.all():
            watched["outside"], excess = outside_data(twin, log)
            notes += _left(watched["outside"], excess, (*study.plant.state_names, *study.plant.input_names))
        if drift is not None:
            notes += [str(drift), "what was logged before is left out from here on"][: 1 + changed]
            watched |= {"drift": drift.as_dict(), "changed": changed}
        values = watched | ({"notes": notes} if notes else {}) | {
            "diverged": log.diverged.mean(), "updates": [update.as_dict() for update in deployment.updates],
            "deployed_return": asdict(summary_of(log, study.objective)),
            "delivery": delivery.as_dict(), "trust": asdict(trust.after(kept)), "account": sentence,
            "report": [sentence, *report, *notes],
        }  # fmt: skip
        drove = {f"update-{k}": one.agent for k, one in enumerate(deployment.updates, 1) if one.changes}
        return Stage(values, kept_log(log), {"agent": deployment.agent} | drove)

    def _violation(self, log: Trajectory, former: Trajectory) -> Violation | None:
        """Limits that a deployment violated and the one before kept."""
        evaluation = self.evaluation
        if log.diverged.all():
            return None
        x0, w = Replay((residuals(evaluation.study.model, log),), evaluation.split).whole()
        scenario = Scenario(evaluation.split.replayed_model, x0, w)
        return violation(evaluation.problem, scenario, log, former, evaluation.study.real.plant)

    def identify(self, rng: np.random.Generator, logs: Sequence[Trajectory]) -> Stage:
        """Unknown entries of the plant that logs tell."""
        fit = fit_plant(self.evaluation.problem, logs, plant=self.evaluation.study.unknown)
        known, own = fit.status is FitStatus.SOLVED, slice(len(fit.unknown.free))  # names of noise follow
        ends = fit.intervals()[own]
        rows = zip(fit.names[own], fit.values, ends)
        pairs = ", ".join(f"{name} {value:.4g} [{low:.4g}, {high:.4g}]" for name, value, (low, high) in rows)
        text = f"the logs tell {pairs}" if known else f"the model stays: {fit.advice.removesuffix('.')}"
        values = {"status": fit.status.name, "known": known, "names": fit.names[own], "text": text, "report": [text]}
        return Stage(values, {"values": fit.values[own], "intervals": ends})

    def learn(self, rng: np.random.Generator, twin: DigitalTwin, log: Trajectory, deployed: Stage) -> Stage:
        """Discrepancy learned from all logs, with its scores."""
        if log.diverged.all() and twin.discrepancy is not None and twin.scores is not None:
            report = ["every run diverged: nothing was learned from them"]
            values = {"scores": asdict(twin.scores), "free_running": None, "report": report}
            return Stage(values, networks={"quantiles": twin.discrepancy.network})
        updated = twin.update(
            log, weight=self.evaluation.study.weight, rng=rng, config=self.evaluation.config.quantile,
            progress=self.progress,
        )  # fmt: skip
        assert updated.discrepancy is not None
        assert updated.scores is not None
        scores = updated.scores
        report = [f"held-out coverage {_shares(scores.coverage)} (nominal {scores.nominal_coverage:.0%})"]
        policy = self.evaluation.deployed(Deployable(deployed.networks["agent"], log.design))
        since = max(changes_of(deployed), default=0)
        bands = held_out_bands(updated, log, policy, rng=rng, since=since)
        if bands is not None:
            report += [f"free-running bands of {bands.steps[-1]} steps: coverage {_shares(bands.coverage[-1])} of 80%"]
        values = {"scores": asdict(scores), "free_running": None if bands is None else bands.summary()}
        return Stage(values | {"report": report}, networks={"quantiles": updated.discrepancy.network})

    def learned_twin(self, twin: DigitalTwin, log: Trajectory, learned: Stage) -> DigitalTwin:
        """Twin after `learn`."""
        if log.diverged.all():
            return twin
        taught = twin.remembering(log)
        discrepancy = Discrepancy(
            learned.networks["quantiles"], self.evaluation.study.weight, transport=taught.transport
        )
        return replace(taught, discrepancy=discrepancy, scores=QuantileScores(**learned.values["scores"]))


def _left(share: float, excess: Array, names: Sequence[str], told: float = 0.01) -> list[str]:
    """Note on a log that leaves the twin's data."""
    if share <= told:
        return []
    most = int(np.argmax(excess))
    by = f"{names[most]} by {excess[most]:.0%} of its range there"
    return [f"{share:.0%} of the samples lie outside what the twin has learned from, {by}: there it is a guess"]


def _shares(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.0%}" for value in values)


def _waited(history: Sequence[GenerationRecord]) -> int:
    """Deployments that were waited for a redesign."""
    waited = 0
    for record in reversed(history):
        redesign = record.stages["codesign"].values["redesign"] if "codesign" in record.stages else None
        if redesign is None or redesign.get("worth", {}).get("status") != RedesignAction.LOG.value:
            break
        waited += 1
    return waited


def stopped(found: Stage) -> dict[str, Any] | None:
    """Decision by which a run stops; None if it goes on."""
    redesign = found.values["redesign"] or {}
    worth: dict[str, Any] = redesign.get("worth", {})
    stops = worth.get("status") == RedesignAction.STOP.value and not redesign["accepted"]
    return worth if stops else None


def deployable_of(found: Stage) -> Deployable:
    """Deployable of a co-design's stage."""
    return Deployable(found.networks["agent"], found.arrays["design"], found.values["name"])


def changes_of(deployed: Stage) -> tuple[int, ...]:
    """Samples logged before every change of the policy."""
    updates = deployed.values["updates"]
    return tuple(
        int(change) for update in updates
        for change in update.get("changes", [update["after"]] if update["accepted"] else [])
    )  # fmt: skip


def deployed_of(
    generation: int, designed: Deployable, agent: ActorCritic, log: Trajectory, changes: Sequence[int]
) -> Deployed:  # fmt: skip
    """Deployment of a deployable with its kept updates, after so many samples each."""
    after = replace(designed, agent=agent, name=f"{designed.name}, updated")
    return Deployed(generation, designed, designed if after.same_as(designed) else after, log, tuple(changes))
