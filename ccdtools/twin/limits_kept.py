"""Whether a candidate keeps the state and output limits as asked.

Of a deployment of one run, its stretches stand for runs: the tolerance is one of episodes, and the peak of a long run
is higher than that of each of its parts.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ccdtools.arrays import Array, Indices
from ccdtools.co_design.budgets import MPC_RUNS
from ccdtools.co_design.design_controllers import linear_mpc
from ccdtools.co_design.differentiable_model import fewer_runs
from ccdtools.co_design.limits import Pair
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.tolerances import BESIDE_MPC, LEAST_TOLERANCE
from ccdtools.evidence.evidence import Violation
from ccdtools.limits import Excursions
from ccdtools.scenario import Scenario
from ccdtools.statistics import mean_interval, paired_difference
from ccdtools.trajectory import Trajectory
from mpc import InputError, MPCError

MEASURES = ("fraction", "peak")


def violation(
    problem: CoDesignProblem, scenario: Scenario, after: Trajectory, before: Trajectory, plant: Any
) -> Violation | None:
    """Violation of limits by a candidate. None if kept, no worse than before, or unchecked.

    It breaks them if a measure, the fraction of the samples outside or the mean over the runs of the peak depth, is
    more than the tolerance, and more than that of what is deployed: beyond chance, where chance can be told. The
    limits of states and of outputs count together and each alone, on runs that neither loses.

    Parameters
    ----------
    problem : CoDesignProblem
        Whose limits, and whose tolerance.
    scenario : Scenario
        That both met; MPC meets it, too, where it says what the tolerance is.
    after, before : Trajectory
        Of the candidate and of what is deployed.
    plant : Plant
        That names the states.
    """
    asked = problem.limit_tolerance
    if asked == "off":
        return None
    lost = np.where(after.diverged | before.diverged, 0, -1)  # a run that only the candidate saves is none to compare
    (_, own), (_, other) = (
        Excursions.from_trajectory(
            replace(run, diverged_at=lost), problem.state_limits(run.design), plant, problem.output_limits
        ) for run in (after, before)
    )  # fmt: skip
    by_mpc = isinstance(asked, str)
    if by_mpc and max(_pair(own[0]).values()) <= LEAST_TOLERANCE:
        return None
    suspects = [[name for name in MEASURES if _further(*pieces, name)] for pieces in zip(own, other)]
    if not any(suspects):
        return None
    runs = min(len(scenario.x0), fewer_runs(MPC_RUNS, scenario.steps)) if by_mpc else len(after.states)
    tolerances = _by_mpc(problem, scenario.first(runs), after.design, lost[:runs]) if by_mpc else (Pair(*asked),)
    for kind in reversed(range(len(own))):
        achieved, allowed = _pair(own[kind], runs), tolerances[min(kind, len(tolerances) - 1)]
        broken = {name: a > g for name, a, g in zip(MEASURES, achieved.values(), allowed.values())}
        if any(broken[name] for name in suspects[kind]):
            formerly = _pair(other[kind], runs)
            return Violation(achieved.values(), formerly.values(), allowed.values(), own[kind].exceeded, by_mpc)
    return None


def _by_mpc(problem: CoDesignProblem, scenario: Scenario, design: Array, lost: Indices) -> tuple[Pair, ...]:
    """Tolerances by MPC, of all limits and of each kind."""
    least = (Pair(LEAST_TOLERANCE, LEAST_TOLERANCE),)
    try:
        run = scenario.run(linear_mpc(problem, design), design=design, limit=problem.limit)
    except InputError:
        raise
    except MPCError:  # no law at this design, such as of a plant that cannot be stabilised
        return least
    run = replace(run, diverged_at=np.maximum(run.diverged_at, lost))
    if run.diverged.all():
        return least
    X = problem.state_limits(design)
    done = (_pair(one).values() for one in Excursions.from_trajectory(run, X, None, problem.output_limits)[1])
    return tuple(Pair(*(max(LEAST_TOLERANCE, BESIDE_MPC * value) for value in pair)) for pair in done)


def _pair(outside: Excursions, runs: int | None = None) -> Pair:
    """Mean fraction and peak over the first `runs`, or all stretches; 0 of none."""
    first = slice(None) if outside.single else slice(runs)
    kept = ~np.asarray(outside.lost)[first]
    means = (getattr(outside, name)[first][kept] for name in MEASURES)
    return Pair(*(float(values.mean()) if len(values) else 0.0 for values in means))


def _further(own: Excursions, other: Excursions, name: str) -> bool:
    """Whether a measure is larger on runs neither lost, beyond chance if known."""
    values, others = (getattr(one, name)[~np.asarray(one.lost)] for one in (own, other))
    if not len(values) or not values.mean() > others.mean():
        return False
    found = mean_interval(values - others) if own.single else paired_difference(values, others)
    return not np.isfinite(found.ci95).all() or found.ci95[0] > 0
