"""Risk measures of returns: mean, tail, or worst case."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from operator import methodcaller
from typing import Any, Protocol

import numpy as np

from ccdtools.arrays import Array, Indices, Mask
from ccdtools.disturbances.combinations import cases_in
from ccdtools.exceptions import InputError
from ccdtools_ground.door import as_count, as_number, has_method

TINY = float(np.finfo(np.float32).tiny)  # added to a variance: the root of none has no slope


class Risk(Protocol):
    """Measure that turns returns into values with the optimised mean."""

    def values(self, returns: Any) -> Any:
        """Differentiable values (..., n) of returns (..., n), NumPy or torch."""
        ...


@dataclass(frozen=True)
class Mean:
    """Mean return."""

    def values(self, returns: Any) -> Any:
        """Returns."""
        return returns

    def describe(self) -> str:
        """Short description of the risk, for tables."""
        return "mean"


MEAN = Mean()


@dataclass(frozen=True)
class MeanSpread:
    """Mean return less `weight` times its standard deviation over runs."""

    weight: float = 1.0

    def __post_init__(self) -> None:
        weight = as_number("weight", self.weight, expected="a number ≥ 0", low=0.0)
        object.__setattr__(self, "weight", weight)

    def values(self, returns: Any) -> Any:
        """Returns (..., n), each less its part of the spread."""
        squares = (returns - returns.mean(-1)[..., None]) ** 2
        spread = (squares.mean(-1)[..., None] + TINY) ** 0.5
        return returns - self.weight * (spread + squares / spread) / 2

    def describe(self) -> str:
        """Short description of the risk, for tables."""
        return "mean minus spread" if self.weight == 1 else f"mean minus {self.weight:g} times the spread"


@dataclass(frozen=True)
class CVaR:
    """Conditional value at risk: mean of the worst `share`, at least one.

    References
    ----------
    Rockafellar and Uryasev, "Optimization of conditional value-at-risk", Journal of Risk 2, 2000.
    """

    share: float = 0.1

    def __post_init__(self) -> None:
        share = as_number("share", self.share, expected="a number above 0, at most 1", low=0.0, high=1.0)
        if share == 0:
            raise InputError("share", "0", "a number above 0, at most 1", "A small one, such as 1e-6: the worst run.")
        object.__setattr__(self, "share", share)

    def values(self, returns: Any) -> Any:
        """Values (..., n): the quantile, less the shortfall of the worst."""
        n = returns.shape[-1]
        worst = max(1, math.ceil(self.share * n - 1e-9))
        order = returns.argsort(-1)[..., worst - 1 : worst]
        if isinstance(returns, np.ndarray):
            quantile = np.take_along_axis(returns, order, -1)
            return quantile + np.minimum(returns - quantile, 0.0) * (n / worst)
        quantile = returns.gather(-1, order)
        return quantile + (returns - quantile).clamp(max=0.0) * (n / worst)

    def describe(self) -> str:
        """Short description of the risk, for tables."""
        return f"mean of the worst {100 * self.share:.3g} %"


@dataclass(frozen=True)
class WorstCase:
    """Mean return of the worst case, such as a mass or road.

    The cases are those of the scenarios' `Cases`, met by the runs in turn. Within a case chance is averaged; between
    the cases nothing is. The least of the means has a kink where two cases are alike, which is where robust designs
    lie, so it is rounded from above: −τ log of the mean of exp(−μ / τ) over the cases, with τ `smoothing` times the
    worst mean μ. It exceeds the least by τ log m at most, of m cases, and by nothing where they are alike.

    Parameters
    ----------
    smoothing : float
        τ, as a part of the worst mean; 0 for the least itself, with the slope of the worst case.
    cases : int, optional
        m; a problem or study sets it to what its scenarios have.

    References
    ----------
    Ben-Tal, El Ghaoui, Nemirovski, Robust optimization, Princeton 2009; Nesterov, "Smooth minimization of non-smooth
    functions", Mathematical Programming 103, 2005 (the rounding).
    """

    smoothing: float = 0.003
    cases: int | None = None

    def __post_init__(self) -> None:
        smoothing = as_number("smoothing", self.smoothing, expected="a number from 0 to 1", low=0.0, high=1.0)
        object.__setattr__(self, "smoothing", smoothing)
        if self.cases is not None:
            object.__setattr__(self, "cases", as_count("cases", self.cases, least=2))

    def describe(self) -> str:
        """Short description of the risk, for tables."""
        return "worst case" if self.cases is None else f"worst of {self.cases} cases"

    def over(self, scenarios: Any) -> WorstCase:
        """Worst case with the cases of scenarios or a disturbance.

        Raises
        ------
        InputError
            If they have none.
        """
        cases = cases_of(scenarios)
        if cases == 1:
            raise InputError("risk", "a worst case of scenarios without cases", "a disturbance with Cases",
                             "Such as Stacked((road, Cases.of([-0.2, 0.2]))).")  # fmt: skip
        return replace(self, cases=cases)

    def means(self, returns: Any) -> Any:
        """Mean return (..., m) of every case, from returns (..., n).

        There must be one run of every case at least.

        Raises
        ------
        InputError
            If the number of cases is not known.
        """
        members = self._members(returns)
        return returns @ members.T / members.sum(-1)

    def values(self, returns: Any) -> Any:
        """Values (..., n): the measure, plus deviations of worst-case runs from their mean.

        Their mean is the measure; so their spread says how well it is known.
        """
        members = self._members(returns)
        means = self.means(returns)
        measure, slopes = self._smoothed(means) if self.smoothing > 0 else _least(means)
        counted = (slopes * (returns.shape[-1] / members.sum(-1))) @ members
        return measure + counted * (returns - means @ members)

    def _smoothed(self, means: Any) -> tuple[Any, Any]:
        """Risk (..., 1) of the case means, with its slopes (..., m)."""
        exp, log = (np.exp, np.log) if isinstance(means, np.ndarray) else map(methodcaller, ("exp", "log"))
        worst, _ = _least(means)
        tau = self.smoothing * abs(worst) + TINY
        parts = exp((worst - means) / tau)
        return worst - tau * log(parts.mean(-1)[..., None]), parts / parts.sum(-1)[..., None]

    def _members(self, returns: Any) -> Any:
        """Membership (m, n) of runs in cases, 1 or 0."""
        if self.cases is None:
            raise InputError("risk", "a worst case that does not know its cases", "the number of cases",
                             "Take the risk of a problem, or say WorstCase(cases=3).")  # fmt: skip
        n = returns.shape[-1]
        members = (np.arange(n) % self.cases == np.arange(self.cases)[:, None]).astype(float)
        return members if isinstance(returns, np.ndarray) else returns.new_tensor(members.tolist())


def check_followed(risk: Risk, method: str, design_gradient: str) -> None:
    """Raise an `InputError` if a method follows the mean of another risk."""
    if not isinstance(risk, Mean) and ("ppo" in method or design_gradient != "pathwise"):
        got = f'"{method}" with the design gradient "{design_gradient}"'
        raise InputError("method", got, '"pathwise" for both: PPO follows the mean return, and the problem has a risk')


def fewest_runs(risk: Risk) -> int:
    """Least number of runs of a risk, one per case."""
    return (risk.cases or 1) if isinstance(risk, WorstCase) else 1


def has_cases(scenarios: Any) -> bool:
    """Whether scenarios, or a disturbance, have cases in turn."""
    return cases_of(scenarios) > 1


def cases_of(scenarios: Any) -> int:
    """Number of runs after which cases of scenarios come again."""
    parts = (scenarios, getattr(scenarios, "disturbance", None), getattr(scenarios, "x0", None))
    own = getattr(scenarios, "own", None)  # of those that hold others
    return math.lcm(*map(cases_in, parts), 1 if own is None else cases_of(own))


def of_logged_runs(risk: Risk) -> Risk:
    """Risk that replays of logged runs can follow.

    A worst case, whose cases are not known there, becomes the mean.
    """
    return MEAN if isinstance(risk, WorstCase) else risk


def _least(means: Any) -> tuple[Any, Any]:
    """Least mean (..., 1), with slopes (..., m) shared by equal ones."""
    if isinstance(means, np.ndarray):
        worst = means.min(-1, keepdims=True)
        parts = (means == worst).astype(float)
    else:
        worst = means.amin(-1, keepdim=True)
        parts = (means == worst).to(means)
    return worst, parts / parts.sum(-1)[..., None]


def as_risk(argument: str, value: Any) -> Risk:
    """`value`, if it is a risk."""
    risk: Risk = has_method(argument, value, "values", "Mean(), MeanSpread(weight), CVaR(share) or WorstCase()")
    return risk


def measure(risk: Risk) -> str:
    """Name of a risk: "mean", "mean of the worst 10 %".

    A risk without words of its own has the name of its class.
    """
    describe = getattr(risk, "describe", None)
    return describe() if callable(describe) else type(risk).__name__


def risk_of(risk: Risk, returns: Array, runs: Indices | None = None) -> float:
    """Risk of returns (n,); for a worst case, the least mean.

    NaN where nothing can be said: of no run, or of a worst case without a run of one of its cases.
    """
    if isinstance(risk, WorstCase):
        numbers = np.arange(len(returns)) if runs is None else runs
        cases = by_case(risk, returns, numbers)
        return float(np.min([case.mean() if len(case) else np.nan for case in cases]))
    return float(risk.values(returns).mean()) if len(returns) else float("nan")


def of_kept_runs(risk: Risk, returns: Array, lost: Mask) -> tuple[float, float, float]:
    """Risk and standard deviation of kept returns, and lost fraction."""
    runs = np.flatnonzero(~lost)
    std = float(returns[runs].std(ddof=1)) if len(runs) > 1 else 0.0
    return risk_of(risk, returns[runs], runs), std, float(lost.mean())


def by_case(risk: WorstCase, values: Array, runs: Indices) -> list[Array]:
    """Values (n,) of these runs, case by case."""
    assert risk.cases is not None
    return [values[runs % risk.cases == case] for case in range(risk.cases)]
