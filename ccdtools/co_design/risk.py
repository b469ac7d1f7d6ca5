"""What of the returns of many runs is optimised: their mean, or their mean and what the bad ones are."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ccdtools.checks import as_number, has_method
from ccdtools.exceptions import InputError

TINY = float(np.finfo(np.float32).tiny)  # added to a variance: the root of none has no slope


class Risk(Protocol):
    """Turns returns into values whose mean is what is optimised."""

    def values(self, returns: Any) -> Any:
        """Values (..., n) of returns (..., n), NumPy arrays or torch tensors; differentiable."""
        ...


@dataclass(frozen=True)
class Mean:
    """The mean return."""

    def values(self, returns: Any) -> Any:
        """The returns."""
        return returns

    def describe(self) -> str:
        """In words."""
        return "mean"


MEAN = Mean()


@dataclass(frozen=True)
class MeanSpread:
    """The mean return less `weight` times its standard deviation over the runs."""

    weight: float = 1.0

    def __post_init__(self) -> None:
        weight = as_number("weight", self.weight, expected="a number ≥ 0", low=0.0)
        object.__setattr__(self, "weight", weight)

    def values(self, returns: Any) -> Any:
        """(..., n) of returns (..., n): each less its part of the spread."""
        squares = (returns - returns.mean(-1)[..., None]) ** 2
        spread = (squares.mean(-1)[..., None] + TINY) ** 0.5
        return returns - self.weight * squares / spread

    def describe(self) -> str:
        """In words."""
        return "mean minus spread" if self.weight == 1 else f"mean minus {self.weight:g} times the spread"


@dataclass(frozen=True)
class CVaR:
    """The mean of the worst `share` of the returns, their conditional value at risk; of the worst one at least.

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
        """(..., n) of returns (..., n): the quantile, less what the worst are below it."""
        n = returns.shape[-1]
        worst = max(1, math.ceil(self.share * n - 1e-9))
        order = returns.argsort(-1)[..., worst - 1 : worst]
        if isinstance(returns, np.ndarray):
            quantile = np.take_along_axis(returns, order, -1)
            return quantile + np.minimum(returns - quantile, 0.0) * (n / worst)
        quantile = returns.gather(-1, order)
        return quantile + (returns - quantile).clamp(max=0.0) * (n / worst)

    def describe(self) -> str:
        """In words."""
        return f"mean of the worst {100 * self.share:.3g} %"


def as_risk(argument: str, value: Any) -> Risk:
    """`value`, if it is a risk."""
    return has_method(argument, value, "values", "Mean(), MeanSpread(weight) or CVaR(share)")


def measure(risk: Risk) -> str:
    """A risk in words: "mean", "mean of the worst 10 %"; of one that has no words of its own, the name of its class."""
    describe = getattr(risk, "describe", None)
    return describe() if callable(describe) else type(risk).__name__
