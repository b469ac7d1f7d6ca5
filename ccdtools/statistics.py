"""Means, intervals and paired differences of returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from ccdtools.checks import as_floats
from ccdtools.exceptions import InputError


@dataclass(frozen=True)
class Summary:
    """Mean, standard deviation, median, number and 95 % interval of the mean; NaN where there are too few values."""

    mean: float
    std: float
    median: float
    n: int
    ci95: tuple[float, float]


@dataclass(frozen=True)
class PairedDifference:
    """Mean difference on common random numbers with its 95 % interval."""

    mean: float
    ci95: tuple[float, float]


def summarise(values: ArrayLike) -> Summary:
    """Statistics of independent values (n,), by Student's t."""
    v = as_floats("values", values)
    if v.ndim != 1:
        raise InputError("values", f"shape {v.shape}", "(n,)")
    if len(v) == 0:
        return Summary(np.nan, np.nan, np.nan, 0, (np.nan, np.nan))
    std = float(v.std(ddof=1)) if len(v) > 1 else float("nan")
    mean = float(v.mean())
    return Summary(mean, std, float(np.median(v)), len(v), _interval(mean, std, len(v)))


def paired_difference(a: ArrayLike, b: ArrayLike) -> PairedDifference:
    """Mean of a − b over pairs (n,), with its interval."""
    first = as_floats("a", a)
    second = as_floats("b", b)
    if first.shape != second.shape:
        raise InputError("a, b", f"shapes {first.shape} and {second.shape}", "as many of each")
    summary = summarise(first - second)
    return PairedDifference(summary.mean, summary.ci95)


def _interval(mean: float, std: float, n: int) -> tuple[float, float]:
    """The 95 % interval of a mean of n values by Student's t; NaN below two."""
    if n < 2:
        return (float("nan"), float("nan"))
    half = float(stats.t.ppf(0.975, n - 1)) * std / float(np.sqrt(n))
    return (mean - half, mean + half)
