"""Fitting the joint distribution of samples around their conditional quantiles.

References
----------
Lütkepohl, "New Introduction to Multiple Time Series Analysis", Springer 2005, section 3.3 (Yule–Walker equations).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr, ndtri

from learning.checks import as_count, as_lengths, as_samples, check_instance
from learning.copula import InnovationCopula, log_width, positions
from learning.exceptions import InputError
from learning.quantile import QuantileNetwork
from learning.tolerances import COLLINEAR, FEWEST_HELD_OUT, NARROW, ROUNDING, SIGNIFICANT

Array = NDArray[np.float64]



def fit_copula(
    network: QuantileNetwork,
    inputs: ArrayLike,
    targets: ArrayLike,
    *,
    stretches: Sequence[int] | None = None,
    orders: int = 0,
) -> InnovationCopula:
    """The joint distribution of `targets` around the conditional quantiles of a network.

    Parameters
    ----------
    network : QuantileNetwork
        Of at least three levels.
    inputs : (n, d) array_like
        In time order.
    targets : (n, m) array_like
    stretches : sequence of int, optional
        Lengths of the contiguous stretches that make up the n samples; one stretch by default.
    orders : int
        Highest order of a correlation in time that is tried. The smallest is taken whose one-step error on the last
        part of each stretch is not worse than the best by more than two standard errors. Leave it at 0 where the inputs
        hold the past, as those of a twin do: what they explain already would be counted twice.

    Raises
    ------
    InputError
        On mismatched, too few (under 20) or non-finite samples, or a network of a single level.
    """
    network = check_instance(network, "network", QuantileNetwork)
    orders = as_count("orders", orders, least=0)
    x, y = as_samples(inputs, targets)
    if len(network.levels) < 3:
        raise InputError("network", "a single level", "at least three, which draws can follow")
    sizes = (len(network.input_offset), network.outputs)
    if (x.shape[1], y.shape[1]) != sizes:
        got = f"{x.shape[1]} and {y.shape[1]} columns"
        raise InputError("inputs, targets", got, f"{sizes[0]} and {sizes[1]}, as the network")
    lengths = as_lengths(stretches, "stretches", len(x))
    quantiles = network.predict(x)
    margins = _margins(quantiles, y, x.shape[1])
    slope, shift = regression(x, y - margins.mean(torch.tensor(quantiles)).numpy())
    quantiles = quantiles + ((x - x.mean(axis=0)) @ slope + shift)[:, None]
    margins = _margins(quantiles, y, x.shape[1])
    for name, value in (("centre", x.mean(axis=0)), ("slope", slope), ("shift", shift)):
        getattr(margins, name).copy_(torch.tensor(value))
    scores = _standard(margins.scores(quantiles, y))
    origin, subspace = _subspace(y, _exchanged(margins, quantiles, scores))
    margins.origin.copy_(torch.tensor(origin))
    margins.subspace.copy_(torch.tensor(subspace))
    parts = np.split(scores, np.cumsum(lengths)[:-1])
    return _joined(margins, parts, _order(parts, orders))


def regression(x: Array, left: Array) -> tuple[Array, Array]:
    """Return slope (d, m) and mean (m,) of what is left (n, m), in the directions that the inputs (n, d) fill.

    What is left at an input is the mean + slopeᵀ (input − mean input).
    """
    deviation = x.std(axis=0)
    scale = np.where(deviation > ROUNDING * np.abs(x).max(axis=0), deviation, np.inf)
    shift = left.mean(axis=0)
    slope = np.linalg.lstsq((x - x.mean(axis=0)) / scale, left - shift, rcond=COLLINEAR)[0]
    return slope / scale[:, None], shift


def _margins(quantiles: Array, targets: Array, inputs: int) -> InnovationCopula:
    """Return a copula with the margins of targets (n, m) among quantiles (n, levels, m), independent otherwise."""
    samples = positions(quantiles, targets)
    widths = log_width(torch.tensor(quantiles)).numpy()
    n, outputs = samples.shape
    count = int(np.clip(n // 500, 1, 24))  # widths with margins of their own: one for 500 samples
    furthest = -ndtri(0.5 / n)
    shares = ndtr(np.linspace(-furthest, furthest, 257))
    centres = np.quantile(widths, (np.arange(count) + 0.5) / count, axis=0)
    copula = InnovationCopula(inputs, outputs, knots=len(shares), widths=count, order=0)
    copula.probabilities.copy_(torch.tensor(shares))
    copula.widths.copy_(torch.tensor(centres))
    for i in range(outputs):
        for b, weight in enumerate(_nearness(widths[:, i], centres[:, i])):
            copula.positions[b, :, i] = torch.tensor(_weighted_quantiles(samples[:, i], weight, shares))
    return copula


def _nearness(widths: Array, centres: Array) -> list[Array]:
    """Return the weight (n,) of every sample at each centre. Linear between neighbours, all where they coincide."""
    distinct, index = np.unique(centres, return_inverse=True)
    hats = [np.interp(widths, distinct, np.eye(len(distinct))[b]) for b in range(len(distinct))]
    return [hats[b] for b in index]


def _weighted_quantiles(samples: Array, weight: Array, shares: Array) -> Array:
    """Return the quantiles of weighted samples. Each sample stands in the middle of its own share."""
    order = np.argsort(samples, kind="stable")
    total = np.cumsum(weight[order])
    at = (total - weight[order] / 2) / total[-1]
    return np.interp(shares, at, samples[order])


def _joined(margins: InnovationCopula, parts: Sequence[Array], order: int) -> InnovationCopula:
    """Return the copula of the margins whose scores (n, m) along the stretches are correlated as in `parts`."""
    copula = InnovationCopula.from_shape(margins.shape() | {"order": order})
    for name in ("probabilities", "positions", "widths", "centre", "slope", "shift", "origin", "subspace"):
        getattr(copula, name).copy_(getattr(margins, name))
    lagged = [_autocovariance(parts, i) for i in range(order + 1)]
    for j in range(order + 1):
        gains, left = _autoregression(lagged, j)
        copula.factors[j] = torch.tensor(_root(left))
        for i, gain in enumerate(gains):
            copula.gains[j, i] = torch.tensor(gain)
    return copula


def _exchanged(margins: InnovationCopula, quantiles: Array, scores: Array) -> Array:
    """Return draws (n, m) at the samples' quantiles, each with the scores of the sample half a data set later."""
    shares = torch.tensor(ndtr(np.roll(scores, len(scores) // 2, axis=0)))
    return margins.at(torch.tensor(quantiles), shares).numpy()


def _subspace(y: Array, draws: Array) -> tuple[Array, Array]:
    """Return the mean (m,) of samples, and the map (m, m) that takes draws to their variance in narrow directions.

    Directions are the principal ones of samples of variance 1; nothing is stretched, and wide ones stay as they are.
    """
    origin = y.mean(axis=0)
    deviation = y.std(axis=0)
    scale = np.where(deviation > ROUNDING * np.abs(y).max(axis=0), deviation, np.inf)
    values, vectors = np.linalg.eigh(np.cov((y - origin).T / scale[:, None]).reshape(len(origin), -1))
    drawn = ((((draws - origin) / scale) @ vectors) ** 2).mean(axis=0)
    narrow = values < NARROW * values.max()
    ratio = np.sqrt(np.maximum(values, 0.0) / np.maximum(drawn, np.finfo(float).tiny))
    kept = np.where(narrow, np.minimum(ratio, 1.0), 1.0)
    finite = np.where(np.isfinite(scale), scale, 1.0)
    return origin, (finite[:, None] * (vectors * kept)) @ vectors.T / finite


def _standard(scores: Array) -> Array:
    """Return scores (n, m) of mean 0 and variance 1, which the margins hold already; 0 where an output is constant."""
    deviation = scores.std(axis=0)
    return (scores - scores.mean(axis=0)) / np.where(deviation > ROUNDING, deviation, np.inf)


def _autocovariance(parts: Sequence[Array], lag: int) -> Array:
    """Return E[z_k z_{k−lag}ᵀ] (m, m) along the stretches, divided by all samples so that it stays definite."""
    total = np.zeros((parts[0].shape[1], parts[0].shape[1]))
    for part in parts:
        if len(part) > lag:
            total += part[lag:].T @ part[: len(part) - lag]
    return total / sum(len(part) for part in parts)


def _autoregression(lagged: Sequence[Array], order: int) -> tuple[list[Array], Array]:
    """Return the gains (m, m) on the last `order` scores, and the covariance (m, m) of the residuals.

    The Yule–Walker equations in the leading components of the scores: outputs that follow one signal have a covariance
    that is singular but for rounding, and gains on its noise would mean nothing.
    """
    values, vectors = np.linalg.eigh(lagged[0])
    kept = values > SIGNIFICANT * values.sum()
    into = vectors[:, kept] / np.sqrt(values[kept])
    back = vectors[:, kept] * np.sqrt(values[kept])
    if order == 0 or not kept.any():
        return [np.zeros_like(lagged[0])] * order, lagged[0]
    reduced = [into.T @ covariance @ into for covariance in lagged[: order + 1]]
    toeplitz = np.block([
        [reduced[j - i] if j >= i else reduced[i - j].T for j in range(order)] for i in range(order)
    ])  # fmt: skip
    solution = np.linalg.lstsq(toeplitz.T, np.hstack(reduced[1:]).T, rcond=1e-9)[0].T
    gains = np.split(solution, order, axis=1)
    explained = sum(gain @ covariance.T for gain, covariance in zip(gains, reduced[1:]))
    return [back @ gain @ into.T for gain in gains], lagged[0] - back @ explained @ back.T


def _root(covariance: Array) -> Array:
    """Return the symmetric square root of a positive semidefinite matrix."""
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    return (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


def _order(parts: Sequence[Array], orders: int) -> int:
    """Return the smallest order whose error on unseen scores is within two standard errors of the best."""
    cuts = [max(orders, len(part) - round(0.2 * len(part))) for part in parts]  # the last fifth chooses
    if orders == 0 or sum(max(0, len(part) - cut) for part, cut in zip(parts, cuts)) < FEWEST_HELD_OUT:
        return 0
    lagged = [_autocovariance([part[:cut] for part, cut in zip(parts, cuts)], i) for i in range(orders + 1)]
    errors = np.stack([_errors(parts, cuts, _autoregression(lagged, order)[0]) for order in range(orders + 1)])
    best = errors[errors.mean(axis=1).argmin()]
    more = errors - best
    standard = more.std(axis=1) / np.sqrt(errors.shape[1])
    return int(np.flatnonzero(more.mean(axis=1) <= 2 * standard)[0])


def _errors(parts: Sequence[Array], cuts: Sequence[int], gains: Sequence[Array]) -> Array:
    """Return the squared one-step errors of an autoregression on the end of every stretch."""
    found = []
    for part, cut in zip(parts, cuts):
        if len(part) > cut:
            past = [part[cut - 1 - i : len(part) - 1 - i] @ gain.T for i, gain in enumerate(gains)]
            found.append(((part[cut:] - sum(past)) ** 2).sum(axis=1))
    return np.concatenate(found)
