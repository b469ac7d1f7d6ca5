"""What each stage of the loop computes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ccdtools.co_design.codesign import codesign
from ccdtools.co_design.expert import expert_dataset
from ccdtools.co_design.result import CoDesignResult
from ccdtools.exceptions import InputError
from ccdtools.statistics import summarise_returns
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.redesign import InService, RedesignDecision, judge_redesign, same_design
from ccdtools.studies.stage_storage import Stage
from ccdtools.trajectory import Trajectory
from ccdtools.twin.deployment import deploy_and_update
from ccdtools.twin.discrepancy import Discrepancy, QuantileScores
from ccdtools.twin.replay import replay_problem, updated_problem
from ccdtools.twin.residuals import Residuals
from ccdtools.twin.twin import DigitalTwin
from learning.warm_start import fit_actor_critic


@dataclass(frozen=True, eq=False)
class LoopStages:
    """The stages of one run; each takes its generator first and returns what is to be kept.

    Attributes
    ----------
    evaluation : Evaluation
        The study, its configuration, and what the stages are measured on.
    progress : bool
        Show progress bars.
    """

    evaluation: Evaluation
    progress: bool

    def initialise(self, rng: np.random.Generator) -> Stage:
        """The first policy: a network trained to imitate the expert."""
        config = self.evaluation.config
        problem = self.evaluation.problem
        data = expert_dataset(
            problem, samples=config.samples, rng=rng, expert=config.expert, gamma=config.codesign.ppo.gamma,
            progress=self.progress,
        )  # fmt: skip
        agent = fit_actor_critic(
            data.inputs, data.actions, data.values, action_bounds=problem.input_bounds,
            input_bounds=problem.observation_bounds, rng=rng, network=config.network, config=config.cloning,
            progress=self.progress,
        )  # fmt: skip
        values = {
            "expert": config.expert, "candidates": config.samples, "samples": len(data.inputs),
            "acceptance": data.acceptance, "diverged": data.diverged,
        }  # fmt: skip
        report = [f"{data.acceptance:.0%} of {config.samples} candidates feasible, {len(data.inputs)} samples imitated"]
        return Stage(values | {"report": report}, networks={"agent": agent})

    def co_design(self, rng: np.random.Generator, current: InService, twin: DigitalTwin) -> Stage:
        """The first co-design on the nominal model; later ones on the updated model, taken if they are worth it.

        A redesign is trained on the median model, with what that leaves unexplained replayed, and judged on replays of
        the logged errors themselves: a model fitted in closed loop can mistake the road for a consequence of the state.
        """
        problem = self.evaluation.problem
        config = self.evaluation.config
        if twin.discrepancy is None:
            first = codesign(
                problem, agent=current.agent, design=current.design, rng=rng, method=config.method,
                config=config.codesign, progress=self.progress,
            )  # fmt: skip
            return self._co_designed(first, InService(first.agent, first.design), {})
        result = codesign(
            updated_problem(problem, twin), agent=current.agent, design=current.design, rng=rng,
            method=config.method, config=config.redesign, progress=self.progress,
            judge=replay_problem(problem, twin.logs, self.evaluation.window),
        )  # fmt: skip
        proposals = {"redesign": InService(result.agent, result.design)}
        if not same_design(problem.design, result.design, current.design):
            proposals["its policy at the present design"] = InService(result.agent, current.design)
        decisions: dict[str, RedesignDecision] = {}
        for name, proposal in proposals.items():
            decisions[name] = judge_redesign(self.evaluation, proposal, current, twin.logs)
            if decisions[name].accepted:
                return self._co_designed(result, proposal, decisions)
        return self._co_designed(result, current, decisions)

    def _co_designed(
        self, result: CoDesignResult, chosen: InService, decisions: Mapping[str, RedesignDecision]
    ) -> Stage:
        """A co-design, with the policy and design that go into service and the decisions that led to them."""
        history = result.history
        space = self.evaluation.problem.design
        arrays = {f"history_{name}": getattr(history, name) for name in history.__dataclass_fields__}
        check = None if result.gradients is None else asdict(result.gradients)
        report = [*str(result.gradients).splitlines()] if result.gradients is not None else []
        redesign: dict[str, Any] | None = None
        if decisions:
            texts = [decision.describe(name) for name, decision in decisions.items()]
            taken = any(decision.accepted for decision in decisions.values())
            redesign = {"proposed": space.as_dict(result.design), "accepted": taken, "texts": texts,
                        "decisions": {name: asdict(decision) for name, decision in decisions.items()}}  # fmt: skip
            report += [f"proposed: {space.describe(result.design)}", *texts]
        active = space.active_bounds(chosen.design)
        named = ", ".join(f"{name} at its {side} bound" for name, side in active.items())
        report.append(f"{space.describe(chosen.design)}; active bounds: {named or 'none'}")
        values = {"active_bounds": active, "gradient_check": check, "redesign": redesign, "report": report}
        return Stage(values, {"design": chosen.design, **arrays}, {"agent": chosen.agent})

    def deploy(self, rng: np.random.Generator, generation: int, current: InService) -> Stage:
        """The policy on the real plant, updated on the way; the log."""
        real = self.evaluation.study.real
        evaluation = self.evaluation
        w = evaluation.recorded(real.runs, "deployment" if real.runs == 1 else f"deployment-{generation}")
        deployment = deploy_and_update(
            evaluation.problem, real.plant, current.agent, current.design, x0=np.tile(real.x0, (real.runs, 1)),
            disturbance=w, rng=rng, config=replace(evaluation.config.online, window=evaluation.window),
            progress=self.progress,
        )  # fmt: skip
        log = deployment.log
        if log.diverged.all():
            place = evaluation.problem.design.describe(current.design)
            got = f"a start from which every run of deployment {generation} diverged at {place}"
            raise InputError("real.x0", got, "one that some design can recover from")
        returns = summarise_returns(log.rewards(evaluation.study.objective)[~log.diverged], runs=real.runs)
        updates = [asdict(update) for update in deployment.updates]
        accepted = sum(update.accepted for update in deployment.updates)
        report = [f"return {returns.mean:.4g}, {log.diverged.mean():.1%} diverged, "
                  f"{accepted} of {len(updates)} updates of the policy accepted"]  # fmt: skip
        values = {"deployed_return": asdict(returns), "diverged": log.diverged.mean(), "updates": updates}
        return Stage(values | {"report": report}, packed(log), {"agent": deployment.agent})

    def learn(self, rng: np.random.Generator, twin: DigitalTwin, log: Trajectory) -> Stage:
        """The quantiles of the one-step errors of the nominal model along all logs."""
        updated = twin.update(
            log, weight=self.evaluation.study.weight, rng=rng, config=self.evaluation.config.quantile,
            progress=self.progress,
        )  # fmt: skip
        assert updated.discrepancy is not None
        assert updated.scores is not None
        scores = updated.scores
        coverage = ", ".join(f"{c:.0%}" for c in scores.coverage)
        report = [f"held-out coverage {coverage} (nominal {scores.nominal_coverage:.0%})"]
        networks = {"quantiles": updated.discrepancy.network}
        return Stage({"scores": asdict(scores), "report": report}, networks=networks)

    def learned_twin(self, twin: DigitalTwin, log: Trajectory, learned: Stage) -> DigitalTwin:
        """The twin that `learn` has left behind."""
        taught = twin.remembering(log)
        discrepancy = Discrepancy(
            learned.networks["quantiles"], self.evaluation.study.weight, transport=taught.transport
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

    def evaluate(
        self, rng: np.random.Generator, designed: InService, logs: Sequence[Residuals], twin: DigitalTwin
    ) -> Stage:
        """Returns of the policy as designed, on every model."""
        assert twin.discrepancy is not None
        return self.evaluation.returns(designed.agent, designed.design, judged_on=logs, learned=twin.discrepancy)


def packed(log: Trajectory) -> dict[str, Any]:
    """The arrays of a log."""
    return {
        "states": log.states, "inputs": log.inputs, "disturbances": log.disturbances,
        "diverged_at": log.diverged_at, "design": log.design,
    }  # fmt: skip


def unpacked(stage: Stage, dt: float) -> Trajectory:
    """The log that a deployment has left behind."""
    return Trajectory(**stage.arrays, dt=dt)  # type: ignore[arg-type]
