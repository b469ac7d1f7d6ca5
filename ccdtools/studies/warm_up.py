"""Length of a replay before its return counts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.plants.design_space import DesignSpace
from ccdtools.scenario import Scenario
from ccdtools.studies.budgets import WARM_UP_DESIGNS, WARM_UP_WINDOWS
from ccdtools.studies.tolerances import SETTLED_START
from ccdtools.twin.residuals import Residuals
from ccdtools.twin.transport import ErrorSplit
from mpc import MPCError


def warm_up(problem: CoDesignProblem, logs: Sequence[Residuals], window: int, space: DesignSpace) -> int:
    """Steps before a window until the logged loop no longer matters.

    A window starts at a state of the logged loop. Where that costs a design more, or less, than its own states would,
    and the loop settles slowly, the start outweighs the disturbance. LQR is run over windows of the logged errors at
    designs all over the box, with more and more steps before them; its return is compared with that after the most.

    Parameters
    ----------
    problem : CoDesignProblem
        On the nominal model.
    logs : sequence of Residuals
    window : int
        Steps that count.
    space : DesignSpace
        The designs that matter: the problem's box, or a part of it.
    """
    longest = min(8 * window, min(log.steps for log in logs) // 2)  # eight windows at most
    split = ErrorSplit(problem.model, problem.state_scale)
    designs = _designs(space)
    places = list(_places(logs, longest, window))
    entering = [split.disturbances(log) for log in logs]

    def returns(before: int) -> Array:
        """Mean return of every design after `before` steps; NaN where a run diverges."""
        x0 = np.array([logs[i].x[run, k - before] for i, run, k in places])
        w = np.array([entering[i][run, k - before : k + window] for i, run, k in places])
        scenario = Scenario(split.replayed_model, x0, w)
        return np.array([_return(problem, scenario, design, before) for design in designs])

    settled = returns(longest) if places else np.zeros(0)
    size = problem.objective.made_by_control(settled, designs, window) if places else settled
    doubled = [max(1, window // 4) << k for k in range(longest.bit_length())]
    for before in (0, *(steps for steps in doubled if steps < longest)):
        away = np.abs(returns(before) - settled) if places else np.zeros(0)
        if not (away > SETTLED_START * size).any():
            return before
    return longest


def _designs(space: DesignSpace) -> Array:
    """A few designs (n, np) all over the box."""
    spread = space.spread()
    if 2**space.dim < WARM_UP_DESIGNS:
        return spread[:WARM_UP_DESIGNS]
    return np.asarray(spread[np.linspace(0, len(spread) - 1, WARM_UP_DESIGNS).astype(int)])


def _return(problem: CoDesignProblem, scenario: Scenario, design: Array, before: int) -> float:
    """Mean return of saturated LQR after `before` steps; NaN if it fails."""
    try:
        controller = saturated_lqr(problem, design)
    except MPCError:
        return float("nan")
    run = scenario.run(controller, design=design, limit=problem.limit)
    return float("nan") if run.diverged.any() else float(run.rewards(problem.objective)[:, before:].sum(axis=1).mean())


def _places(logs: Sequence[Residuals], before: int, window: int) -> Iterator[tuple[int, int, NDArray[np.int64]]]:
    """Log, run and first step of windows, with room for `before` steps."""
    every = [(i, run) for i, log in enumerate(logs) for run in range(log.runs)]
    some = np.unique(np.linspace(0, len(every) - 1, min(WARM_UP_WINDOWS, len(every))).round().astype(int))
    for i, run in (every[k] for k in some):
        last = logs[i].steps - window
        for k in np.unique(np.linspace(before, last, max(1, WARM_UP_WINDOWS // len(some))).round().astype(int)):
            yield i, run, k
