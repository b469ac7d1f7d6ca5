"""Decision whether a redesign replaces what is deployed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ccdtools.co_design.risk import measure
from ccdtools.evidence.evidence import NOTHING, summary_of
from ccdtools.evidence.verdict import Status, Verdict
from ccdtools.exceptions import InputError
from ccdtools.plants.tolerances import SAME_DESIGN
from ccdtools.studies.price import RedesignPrice
from ccdtools.studies.redesign_cost import NORMAL_95, RedesignDecision, of_normal
from ccdtools.studies.tolerances import WORTH_A_POLICY
from ccdtools.twin.distributions import NOMINAL, UPDATED, Distribution
from ccdtools.twin.updated_plant import UpdatedPlant

if TYPE_CHECKING:
    from ccdtools.arrays import Array
    from ccdtools.plants.design_space import DesignSpace
    from ccdtools.statistics import Summary
    from ccdtools.studies.evaluation import Evaluation
    from ccdtools.twin.deployable import Deployable
    from ccdtools.twin.residuals import Residuals
    from ccdtools.twin.twin import DigitalTwin

POLICY_PRICE = RedesignPrice(100 * WORTH_A_POLICY, relative=True)


@dataclass(frozen=True)
class Redesign:
    """Decision on a redesign, as its deployment needs it.

    Attributes
    ----------
    accepted, moved : bool
        Whether one is deployed, and whether it moves the design.
    text : str
        What it changes and predicts, or why it was refused.
    """

    accepted: bool
    moved: bool
    text: str


@dataclass(frozen=True, eq=False)
class RedesignJudge:
    """Judge that compares redesigns with what is deployed, on the same runs.

    On the logs each goes from the start of a run to its end, through states of its own: in a window that begins within
    a run the cost of a start that neither has earned can outweigh everything else. A redesign must bring a gain there
    that exceeds the study's price (a tenth of a per cent if the policy alone changes).
    """

    evaluation: Evaluation
    current: Deployable
    twin: DigitalTwin

    def verdict(self, candidate: Deployable) -> Verdict:
        """Whether a redesign replaces what is deployed."""
        evaluation = self.evaluation
        try:
            evaluation.admissible(candidate.design)
        except InputError:
            return Verdict(Status.NO_FILTER)
        nominal = evaluation.served.nominal(evaluation.rng("judged: nominal"))
        return evaluation.judge.verdict(
            candidate, self.current, self._made_for, nominal, self.price(candidate), lambda: self._others
        )

    def price(self, candidate: Deployable) -> Callable[[float, int], float]:
        """Needed gain of a candidate, as a function of size and steps."""
        study = self.evaluation.study
        prices = [study.price] if self.moved(candidate) else [study.price, POLICY_PRICE]
        return lambda size, steps: min(price.needed(size, steps / study.steps) for price in prices)

    def moved(self, candidate: Deployable) -> bool:
        """Whether a candidate's design differs from the deployed one."""
        return not same_design(self.evaluation.problem.design, candidate.design, self.current.design)

    def worth(self, verdict: Verdict, waited: int) -> RedesignDecision | None:
        """Decision in money on the candidate of a verdict, after so many deployments of waiting; None if not asked."""
        study = self.evaluation.study
        if study.redesign_cost is None or not verdict.evidence:
            return None
        steps = self.evaluation.deployment_steps
        deployment = study.real.runs * steps / study.steps
        gain, logs = verdict.gain, len(self.twin.logs)
        part = study.steps / (steps * logs if self.evaluation.single else steps)  # a gain of one run is over all logs
        error = part * (gain.ci95[1] - gain.ci95[0]) / (2 * NORMAL_95)
        left = max(study.redesign_cost.serves - waited * deployment, deployment)
        return of_normal(
            part * gain.mean, error, error * np.sqrt(logs), replace(study.redesign_cost, serves=left),
            deployment=deployment, allowed=verdict.replaces,
        )  # fmt: skip

    def as_dict(self, candidate: Deployable, verdict: Verdict) -> dict[str, Any]:
        """Decision as plain values, for results.json."""
        study = self.evaluation.study
        made = verdict.evidence[0] if verdict.evidence else None
        nominal, updated = (verdict.on(name) for name in (NOMINAL, UPDATED))
        before, after = (np.nan, np.nan) if nominal is None else (nominal.values[1], nominal.values[0])
        moved = self.moved(candidate)
        cheaper = not moved and made is not None and made.needed < study.price.needed(made.size, 1.0)
        return verdict.as_dict() | {
            "gain": vars(verdict.gain), "accepted": verdict.replaces, "moved": moved,
            "updated_gain": vars(NOTHING if updated is None else updated.gain),
            "needed": np.nan if made is None else made.needed, "size": np.nan if made is None else made.size,
            "nominal_before": before, "nominal_after": after, "price": str(POLICY_PRICE if cheaper else study.price),
            "predicted": verdict.percent, "measure": measure(study.judged_in),
            "reason": "" if verdict.replaces else str(verdict),
        }  # fmt: skip

    @cached_property
    def _made_for(self) -> Distribution:
        """Nominal model with all errors of whole logged runs."""
        evaluation = self.evaluation
        return evaluation.logged(evaluation.split, self.twin.logs, evaluation.rng("replayed runs"))

    @cached_property
    def _others(self) -> list[Distribution]:
        """Other distributions a deployable serves, on the updated model."""
        evaluation = self.evaluation
        logs = self.twin.logs
        rng = evaluation.rng(f"judged: {len(logs)}")
        plant = UpdatedPlant.from_logs(evaluation.split, logs, rng=rng, config=evaluation.config.quantile)
        return [evaluation.logged(plant, logs, rng), *evaluation.served.on(logs, plant, self.current.design, rng)]


def described(proposed: str, decision: Mapping[str, Any]) -> str:
    """Decision in one sentence; `proposed` says what was judged."""
    verdict = "deployed" if decision["accepted"] else f"not deployed, {decision['reason']}"
    if decision["predicted"] == "n/a":
        return f"{proposed} {verdict}"
    before, after = decision["nominal_before"], decision["nominal_after"]
    return f"{proposed} {verdict}: {decision['predicted']} predicted on the logged errors at a price of " \
           f"{decision['price']}; nominal model {before:.4g} → {after:.4g}"  # fmt: skip


def predicted(
    evaluation: Evaluation, choice: Deployable, logs: Sequence[Residuals], steps: int | None = None
) -> Summary:
    """Predicted return of a deployment.

    `steps` are its first ones, by default all.
    """
    scenario = evaluation.on_model(logs) if logs else evaluation.nominal_deployment()
    if steps is not None:
        scenario = scenario.first(len(scenario.x0), min(steps, scenario.steps))
    run = scenario.run(evaluation.deployed(choice), design=choice.design, limit=evaluation.problem.limit)
    return summary_of(run, evaluation.study.objective)


def same_design(space: DesignSpace, one: Array, other: Array) -> bool:
    """Whether two designs differ by under 0.001 of every range."""
    return bool(np.abs(space.to_unit(one) - space.to_unit(other)).max() <= SAME_DESIGN)
