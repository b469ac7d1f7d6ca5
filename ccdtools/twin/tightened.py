"""MPC that keeps its limits under the errors of a log."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array
from ccdtools.co_design.budgets import SET_SECONDS
from ccdtools.co_design.closed_loop import ONLINE_RUNS, ClosedLoopReturns, closed_loop_returns
from ccdtools.co_design.design_controllers import HORIZON, linear_mpc
from ccdtools.co_design.expert import feasible_sets
from ccdtools.co_design.problem import CoDesignProblem, as_seen_problem
from ccdtools.exceptions import InputError
from ccdtools.statistics import PairedDifference, paired_difference
from ccdtools.twin.error_quantiles import ErrorQuantiles
from ccdtools.twin.error_set import disturbance_set
from ccdtools.twin.residuals import Logs, errors_in
from ccdtools_ground.door import as_choice, as_count, as_generator
from invariant_sets import Polytope, SetResult, Status
from mpc import LinearMPC, Status as Solved

ERRORS = ("set", "quantiles", "normal")


@dataclass(frozen=True, eq=False, repr=False)
class RobustMPC:
    """Tightened controller of a log, and the price of its guarantee.

    Attributes
    ----------
    controller : LinearMPC
        From every state that has a plan it keeps X and U as long as errors stay in W.
    W : Polytope or ErrorQuantiles
        Errors x⁺ − Ax − Bu of one step (nx,), see `disturbance_set`; or quantiles of what they add up to.
    level : float
        Share of the errors within W, or probability of each limit.
    nominal_set, robust_set : SetResult
        States that some input keeps within X for ever, without errors and whatever errors of W do; where none were
        found in time, and of quantiles, the terminal set of `controller`, which is a part of both.
    nominal, tightened : ClosedLoopReturns
        Returns and violations of MPC without and with W, on the same scenarios of the problem.
    planned : float
        Share of the starts of these scenarios that have a plan, which is where the guarantee holds from.
    left_out : (int, int)
        Runs of the logs that diverged, whose errors are not allowed for, of so many.
    """

    controller: LinearMPC
    W: Polytope | ErrorQuantiles
    level: float
    nominal_set: SetResult
    robust_set: SetResult
    nominal: ClosedLoopReturns
    tightened: ClosedLoopReturns
    planned: float
    left_out: tuple[int, int] = (0, 0)

    @property
    def price(self) -> PairedDifference:
        """Return that tightening costs, over runs that neither loses."""
        kept = ~(self.nominal.lost | self.tightened.lost)
        return paired_difference(self.nominal.values[kept], self.tightened.values[kept])

    @cached_property
    def volume_left(self) -> float:
        """Part of the nominal set's volume that is left.

        That of the robust set; of quantiles, what has a plan, counted over states drawn from it.
        """
        if isinstance(self.W, Polytope):
            return self.robust_set.set.volume / self.nominal_set.set.volume
        return _planned(self.controller, self.nominal_set.set.sample(ONLINE_RUNS, rng=np.random.default_rng(0)))

    def __str__(self) -> str:
        """Price, violations and volume in a sentence."""
        low, high = self.price.ci95
        stopped = [one.status.name for one in (self.nominal_set, self.robust_set) if one.status is not Status.CONVERGED]
        so_far = f" as far as it was found ({stopped[0]})" if stopped else ""
        lost = "; {} of {} runs diverged: what they met is not allowed for".format(*self.left_out)
        kept = "of the errors are allowed for" if isinstance(self.W, Polytope) else "is the probability of each limit"
        return (
            f"{self.level:.4g} {kept} at a return of {self.price.mean:.4g} "
            f"[{low:.4g}, {high:.4g}] less; states outside X: {self.tightened.outside:.3%}, without "
            f"{self.nominal.outside:.3%}; volume left of X_fea{so_far}: {self.volume_left:.1%}; "
            f"starts that have a plan: {self.planned:.1%}{lost if self.left_out[0] else ''}"
        )

    def __repr__(self) -> str:
        return f"RobustMPC(level={self.level:g}, {self.controller!r})"


def robust_mpc(
    problem: CoDesignProblem, design: ArrayLike, logs: Logs, *, rng: np.random.Generator, level: float = 0.99,
    horizon: int = HORIZON, runs: int | None = None, errors: str = "set",
) -> RobustMPC:  # fmt: skip
    """Controller whose limits hold under a log's errors, with price.

    By `errors` it is a tube MPC with a guarantee, or a stochastic one: a plan within tightened limits may then be lost,
    is relaxed where it must be and says `SOFTENED`.

    Parameters
    ----------
    problem : CoDesignProblem
    design : (np,) array_like
        That of the logs.
    logs : Trajectory or Residuals, or a sequence of them
        From `deploy`, or `twin.carried()` of logs at several designs, the newest of which is meant.
    rng : numpy.random.Generator
        Draws the scenarios of the price.
    level : float
        Share of the errors to allow for, or probability of each limit, in (0, 1).
    horizon : int
        [steps]; longer where starts have no plan, which is to reach the terminal set.
    runs : int, optional
        As in `closed_loop_returns`.
    errors : {"set", "quantiles", "normal"}
        A set of the errors of one step at the level, for whose every sequence the limits hold; or what errors add up to
        in a loop over k steps, for which each limit is to hold with the level's probability at each step: its quantile
        by rank, or that of a normal distribution.

    Raises
    ------
    InputError
        If the logs are of another design, or too short for the level.
    mpc.InfeasibleError
        If errors of such a size leave nothing of the limits: take a lower level, or a better model.

    Examples
    --------
    >>> found = robust_mpc(problem, design, deploy(plant, law, design, disturbance, x0=x0), rng=rng)
    >>> print(found)
    >>> u = found.controller(x)
    """
    as_seen_problem(problem)
    seed = int(as_generator("rng", rng).integers(2**63))
    p = problem.design.check_one(design)
    given = errors_in(problem, logs)
    by_set = as_choice("errors", errors, ERRORS) == "set"
    steps = as_count("horizon", horizon)
    for log in given:
        if not np.array_equal(log.p, p):
            cure = "`DigitalTwin.carried()` carries them to the newest."
            raise InputError("logs", f"logs at {log.p}", f"at {p}", cure)
    W = (
        disturbance_set(given, level=level, model=problem.model) if by_set
        else ErrorQuantiles.of(problem.model, given, level=level, steps=steps, normal=errors == "normal")
    )  # fmt: skip
    controllers = [linear_mpc(problem, p, horizon=horizon, W=one) for one in (None, W)]
    known: list[Polytope | None] = [None, W] if isinstance(W, Polytope) else [None]
    sets = [replace(feasible_sets(problem, W=one), time_limit=SET_SECONDS).result(p) for one in known]
    terminal = Polytope(*(controllers[1].terminal_rows if by_set else controllers[1].rows_at("terminal", steps)))
    sets = [replace(one, set=terminal) if one.set.is_empty else one for one in sets]
    sets += [] if by_set else [replace(sets[0], set=terminal)]
    returns = [
        closed_loop_returns(problem, controller, p, np.random.default_rng(seed), runs=runs)
        for controller in controllers
    ]
    starts = problem.scenarios.sample(len(returns[1].values), problem.steps, np.random.default_rng(seed))[0]
    planned = _planned(controllers[1], starts)
    lost = sum(log.left_out for log in given)
    left_out = (lost, lost + sum(log.runs for log in given))
    return RobustMPC(controllers[1], W, level, sets[0], sets[1], returns[0], returns[1], planned, left_out)


def _planned(controller: LinearMPC, states: Array) -> float:
    """Share of states (n, nx) that have a plan."""
    return float(np.mean([plan.status is Solved.SOLVED for plan in controller.solve_many(states)]))
