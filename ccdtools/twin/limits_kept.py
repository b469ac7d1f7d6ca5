"""Whether a candidate keeps the state and output limits as asked.

Of a deployment of one run, its stretches stand for runs: the tolerance is one of episodes, and the peak of a long run
is higher than that of each of its parts.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ccdtools.arrays import Array
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
    more than the tolerance, and more than that of what is deployed: beyond chance, where chance can be told.

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
    (whole, (own, *_)), (_, (other, *_)) = (
        Excursions.from_trajectory(run, problem.state_limits(run.design), plant, problem.output_limits)
        for run in (after, before)
    )
    if max(_pair(own).values()) <= LEAST_TOLERANCE and isinstance(asked, str):
        return None
    suspect = [name for name in MEASURES if _further(own, other, name)]
    if not suspect:
        return None
    by_mpc = isinstance(asked, str)
    runs = min(len(scenario.x0), fewer_runs(MPC_RUNS, scenario.steps)) if by_mpc else len(after.states)
    allowed = _by_mpc(problem, scenario.first(runs), after.design) if isinstance(asked, str) else Pair(*asked)
    achieved = _pair(own, runs)
    broken = {name: a > g for name, a, g in zip(MEASURES, achieved.values(), allowed.values())}
    if not any(broken[name] for name in suspect):
        return None
    return Violation(achieved.values(), _pair(other, runs).values(), allowed.values(), whole.exceeded, by_mpc)


def _by_mpc(problem: CoDesignProblem, scenario: Scenario, design: Array) -> Pair:
    """Tolerance of 1.25 times what MPC does; the least if it loses all runs."""
    least = Pair(LEAST_TOLERANCE, LEAST_TOLERANCE)
    try:
        run = scenario.run(linear_mpc(problem, design), design=design, limit=problem.limit)
    except InputError:
        raise
    except MPCError:  # no law at this design, such as of a plant that cannot be stabilised
        return least
    if run.diverged.all():
        return least
    X = problem.state_limits(design)
    done = _pair(Excursions.from_trajectory(run, X, None, problem.output_limits)[1][0])
    return Pair(*(max(LEAST_TOLERANCE, BESIDE_MPC * value) for value in done.values()))


def _pair(outside: Excursions, runs: int | None = None) -> Pair:
    """Mean fraction and peak over the first `runs`, or all stretches; 0 of none."""
    first = slice(None) if outside.single else slice(runs)
    kept = ~np.asarray(outside.lost)[first]
    means = (getattr(outside, name)[first][kept] for name in MEASURES)
    return Pair(*(float(values.mean()) if len(values) else 0.0 for values in means))


def _further(own: Excursions, other: Excursions, name: str) -> bool:
    """Whether a measure is larger on runs neither lost, beyond chance if known."""
    kept = ~(np.asarray(own.lost) | np.asarray(other.lost))
    values, others = (getattr(one, name)[kept] for one in (own, other))
    if not len(values) or not values.mean() > others.mean():
        return False
    found = mean_interval(values - others) if own.single else paired_difference(values, others)
    return not np.isfinite(found.ci95).all() or found.ci95[0] > 0
