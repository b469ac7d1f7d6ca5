"""Trade-off of control against design cost, over a datum."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, Immutable, Mask
from ccdtools.co_design.codesign import Method, as_method, codesign
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import CoDesignResult
from ccdtools.co_design.risk_intervals import difference_of_parts
from ccdtools.exceptions import InputError
from ccdtools.jobs import as_jobs, in_processes
from ccdtools.plants.design_space import DesignSpace
from ccdtools.table import Table
from ccdtools_ground.door import as_count, as_flag, as_vector, shown

ProblemOf = Callable[[float], CoDesignProblem]


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class TradeOff(Immutable):
    """Best designs over a price or another datum.

    Attributes
    ----------
    values : (n,) array
        Prices, or values of the datum.
    results : tuple of CoDesignResult
    designs : (n, np) array
    design_costs : (n,) array
        What an episode pays for each design; at price 1, where prices were asked for.
    control_returns : (n,) array
        Returns in closed loop without it, on common scenarios.
    intervals : (n, 2) array
        Where each lies beside the highest of them: 95 % intervals of paired differences to it.
    space : DesignSpace
    priced : bool
        Whether `values` are prices.
    """

    values: Array
    results: tuple[CoDesignResult, ...]
    designs: Array
    design_costs: Array
    control_returns: Array
    intervals: Array
    space: DesignSpace
    priced: bool

    @property
    def efficient(self) -> Mask:
        """Designs (n,) that none beats in both cost and return by a thousandth of their range.

        None whose runs are all lost.
        """
        cost, gain = self.design_costs, self.control_returns
        known = np.isfinite(gain)
        if not known.any():
            return known
        slack = 1e-3 * np.array([np.ptp(cost), np.ptp(gain[known])])
        cheaper = cost[None] < cost[:, None] - slack[0]
        better = gain[None] > gain[:, None] + slack[1]
        return np.asarray(known & ~(cheaper & better).any(axis=1))

    @property
    def word(self) -> str:
        """Name of what is varied."""
        return "price of the design" if self.priced else "value"

    def table(self) -> list[dict[str, Any]]:
        """Plain values, one dictionary per price."""
        return [
            {
                self.word: float(value), **self.space.as_dict(design), "design_cost": float(cost),
                "control_return": float(gain), "low95": float(ends[0]), "high95": float(ends[1]),
                "status": result.status.name, "efficient": bool(efficient),
            }
            for value, design, cost, gain, ends, result, efficient in zip(
                self.values, self.designs, self.design_costs, self.control_returns, self.intervals, self.results,
                self.efficient,
            )
        ]  # fmt: skip

    def plot(self) -> Any:
        """Figure of return against design cost, and designs over price."""
        from ccdtools.co_design.method_plots import plot_trade_off

        return plot_trade_off(self)

    def __repr__(self) -> str:
        return f"TradeOff({len(self.values)} designs over {self.values.min():g} to {self.values.max():g})"

    def __str__(self) -> str:
        """Table in aligned columns."""
        lines = []
        for row, design in zip(self.table(), self.designs):
            beaten = "" if row["efficient"] else ", another is better in both"
            status = row["status"].lower().replace("_", " ") + beaten
            lines.append((f"{row[self.word]:g}", self.space.describe(design), f"{row['design_cost']:.5g}",
                          f"{row['control_return']:.5g}", status))  # fmt: skip
        return str(Table((self.word, "design", "cost", "return", "status"), lines))


def trade_off(
    problem: CoDesignProblem | ProblemOf, values: ArrayLike, *, method: str | Method = "nested", seed: int = 0,
    design: ArrayLike | None = None, jobs: int = 1, progress: bool = False,
) -> TradeOff:  # fmt: skip
    """Best designs over prices, or any other datum.

    With a weighted sum the convex part of the set of efficient designs is found: where returns and costs have a dent,
    the designs jump over it.

    Parameters
    ----------
    problem : CoDesignProblem, or function of a number that gives one
        Of a problem `values` are prices: its design cost is multiplied by each. A function states the problem at any
        value, such as a weight; with `jobs` it is sent to other processes.
    values : (n,) array_like
        Prices ≥ 0, or what the function takes.
    method, design
        As `codesign` takes them; of every value the same.
    seed : int
    jobs : int
        Processes; −1 for all cores.
    progress : bool

    Returns
    -------
    TradeOff

    Raises
    ------
    InputError
        If an argument is of the wrong kind, a price is negative, the design costs nothing, or a method refuses.

    References
    ----------
    Das and Dennis, "A closer look at drawbacks of minimizing weighted sums of objectives", Structural Optimization 14,
    1997.
    """
    points = as_vector("values", values)
    if not len(points):
        raise InputError("values", "none", "at least one")
    as_count("seed", seed, least=0)
    as_flag("progress", progress)
    chosen = as_method(method)
    priced = isinstance(problem, CoDesignProblem)
    if isinstance(problem, CoDesignProblem):
        _check_prices(problem, points)
    elif not callable(problem):
        raise InputError("problem", shown(problem), "a CoDesignProblem, or a function that gives one")
    ends = in_processes(
        partial(_best, problem, chosen, seed, design), points.tolist(), jobs=as_jobs(jobs), label="trade-off",
        progress=progress,
    )  # fmt: skip
    results = tuple(result for result, *_ in ends)
    costs, returns = (np.array(column, dtype=float) for column in list(zip(*ends))[1:3])
    if isinstance(problem, CoDesignProblem):
        at_one = np.array([float(problem.cost_of_design(result.design)) for result in results])
        space = problem.design
    else:
        at_one, space = costs, ends[0][3]
    return TradeOff(
        values=points, results=results, designs=np.array([result.design for result in results]), design_costs=at_one,
        control_returns=returns, intervals=_intervals(results, costs, returns), space=space, priced=priced,
    )  # fmt: skip


def stated(problem_of: ProblemOf, value: float, *, argument: str = "problem") -> CoDesignProblem:
    """Problem that a function states at a value.

    Raises
    ------
    InputError
        If it gives none.
    """
    problem = problem_of(value)
    if not isinstance(problem, CoDesignProblem):
        raise InputError(argument, f"{shown(problem)} at {value:g}", "a CoDesignProblem at every value")
    return problem


def _at(problem: CoDesignProblem | ProblemOf, value: float) -> CoDesignProblem:
    """Problem whose design costs `value` times as much, or that is stated at it."""
    if not isinstance(problem, CoDesignProblem):
        return stated(problem, value)
    cost = problem.objective.design_cost.function(problem.design.dim)
    objective: Any = replace(problem.objective, design_cost=lambda p: value * cost(p))
    return replace(problem, objective=objective)


def _best(of: CoDesignProblem | ProblemOf, method: Method, seed: int, design: Any, value: float) -> tuple[Any, ...]:
    """Result at a value, design cost, return without it, and box."""
    problem = _at(of, value)
    result = codesign(problem, method=method, rng=np.random.default_rng(seed), design=design)
    assert result.closed_loop is not None
    summary = result.closed_loop.summary
    paid = float(problem.cost_of_design(result.design))
    return result, paid, summary.mean + paid, problem.design


def _intervals(results: tuple[CoDesignResult, ...], costs: Array, returns: Array) -> Array:
    """Intervals (n, 2) of returns without design costs, paired to the highest."""
    loops = [result.closed_loop for result in results if result.closed_loop is not None]
    runs = min(len(loop.values) for loop in loops)  # of longer episodes fewer are measured
    kept = np.flatnonzero(~np.logical_or.reduce([loop.lost[:runs] for loop in loops]))
    top = int(np.where(np.isnan(returns), -np.inf, returns).argmax())
    parts = [loop.parts(kept) + cost for loop, cost in zip(loops, costs)]
    gaps = [difference_of_parts(loop.risk, part - parts[top], kept) for loop, part in zip(loops, parts)]
    return np.array([np.array(gap.ci95) - gap.mean + value for gap, value in zip(gaps, returns)])


def _check_prices(problem: CoDesignProblem, prices: Array) -> None:
    """Raise an `InputError` unless prices are ≥ 0 and designs cost something."""
    if (prices < 0).any():
        raise InputError("values", f"a price of {prices.min():g}", "prices ≥ 0")
    if problem.objective.design_cost is None:
        raise InputError(
            "problem", "one whose design costs nothing", "one whose objective has a design_cost",
            "Or give a function that states the problem at every value.",
        )  # fmt: skip
