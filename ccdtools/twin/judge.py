"""Judgement whether a learned change replaces what is deployed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.risk import of_logged_runs
from ccdtools.evidence.evidence import Evidence, Pairing
from ccdtools.evidence.verdict import Verdict, decide
from ccdtools.tolerances import NOT_WORSE
from ccdtools.trajectory import Trajectory
from ccdtools.twin.deployable import Deployable
from ccdtools.twin.distributions import Distribution
from ccdtools.twin.limits_kept import violation
from invariant_sets import AdmissibleInputs

Price = Callable[[float, int], float]


@dataclass(frozen=True, eq=False)
class Judge:
    """Paired comparison of two deployables, each behind its own design's filter."""

    problem: CoDesignProblem  # on the nominal model
    plant: Any  # that names the states
    filters: Callable[[Array], AdmissibleInputs | None]  # design (np,) → the filter behind a policy there, or None
    stretch: int  # steps of a stretch of a single run, see `Pairing`
    tolerance: float = NOT_WORSE  # loss, as a part of the size of a return, that the user accepts on a distribution

    def verdict(
        self, candidate: Deployable, current: Deployable, made_for: Distribution, nominal: Distribution, price: Price,
        others: Callable[[], Sequence[Distribution]],
    ) -> Verdict:  # fmt: skip
        """Verdict on whether a candidate replaces the current one.

        Where it gains nothing on what it was made for, the other distributions are not looked at.

        Parameters
        ----------
        made_for : Distribution
            The replayed log: there the candidate must bring a gain beyond chance, above its price, within the limits.
        nominal : Distribution
            The nominal model. Relative prices are of the larger of the returns there and on the log: a log with hardly
            any disturbance says little.
        price : callable
            (size of the return, steps) → the gain that is needed.
        others : callable
            () → all other distributions.
        """
        shown = self.evidence(candidate, current, nominal)
        made, after, before = self._compared(candidate, current, made_for)
        counted = made_for.counted or made_for.scenario.steps
        counted *= len(after.inputs) if made_for.series else 1
        size = float(np.nan_to_num(np.fmax(made.size, shown.size * counted / nominal.scenario.steps)))
        made = replace(made, size=size, needed=price(size, counted))
        found = decide([made, shown], tolerance=self.tolerance)
        if found.replaces:
            made = replace(made, violation=violation(self.problem, made_for.scenario, after, before, self.plant))
            found = decide([made, shown], tolerance=self.tolerance)
        if found.replaces:
            rest = [self.evidence(candidate, current, one) for one in others()]
            found = decide([made, *rest, shown], tolerance=self.tolerance)
        return found

    def evidence(self, candidate: Deployable, current: Deployable, on: Distribution) -> Evidence:
        """Evidence of the two on one distribution."""
        return self._compared(candidate, current, on)[0]

    def run(self, one: Deployable, on: Distribution) -> Trajectory:
        """Closed-loop runs as they would be deployed."""
        controller = one.controller(self.filters(one.design))
        return on.scenario.run(controller, design=one.design, limit=self.problem.limit)

    def _compared(
        self, candidate: Deployable, current: Deployable, on: Distribution
    ) -> tuple[Evidence, Trajectory, Trajectory]:
        """Evidence, and the runs of both."""
        after, before = (self.run(one, on) for one in (candidate, current))
        names = (f"{candidate.name}, simulated", f"{current.name}, simulated")
        pairing = Pairing(self.problem.objective, of_logged_runs(self.problem.risk), self.stretch)
        found = pairing.evidence(
            after, before, names=names, distribution=on.name, asked=on.asked, groups=on.groups, series=on.series,
            counted=on.counted,
        )  # fmt: skip
        return found, after, before
