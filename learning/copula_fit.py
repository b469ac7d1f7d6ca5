"""Fit of the joint distribution around conditional quantiles."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr, ndtri

from learning.checks import as_samples, check_instance, spread
from learning.copula import InnovationCopula, log_width, positions
from learning.exceptions import InputError
from learning.quantile import QuantileNetwork
from learning.tolerances import COLLINEAR, NARROW, ROUNDING

Array = NDArray[np.float64]


def fit_copula(network: QuantileNetwork, inputs: ArrayLike, targets: ArrayLike) -> InnovationCopula:
    """Fit the joint distribution of `targets` around a network's conditional quantiles.

    Parameters
    ----------
    network : QuantileNetwork
        Of at least three levels.
    inputs : (n, d) array_like
        With what is known of the past: draws are independent from step to step.
    targets : (n, m) array_like

    Raises
    ------
    InputError
        On mismatched, too few (under 20) or non-finite samples, or a network of a single level.
    """
    network = check_instance(network, "network", QuantileNetwork)
    x, y = as_samples(inputs, targets)
    if len(network.levels) < 3:
        raise InputError("network", "a single level", "at least three, which draws can follow")
    sizes = (len(network.input_offset), network.outputs)
    if (x.shape[1], y.shape[1]) != sizes:
        got = f"{x.shape[1]} and {y.shape[1]} columns"
        raise InputError("inputs, targets", got, f"{sizes[0]} and {sizes[1]}, as the network")
    quantiles = network.predict(x)
    margins = _margins(quantiles, y, x.shape[1])
    slope, shift = regression(x, y - margins.mean(torch.tensor(quantiles)).numpy())
    quantiles = quantiles + ((x - x.mean(axis=0)) @ slope + shift)[:, None]
    margins = _margins(quantiles, y, x.shape[1])
    for name, value in (("centre", x.mean(axis=0)), ("slope", slope), ("shift", shift)):
        getattr(margins, name).copy_(torch.tensor(value))
    scores = margins.scores(quantiles, y)
    deviation = scores.std(axis=0)  # 0 for a constant output
    scores = (scores - scores.mean(axis=0)) / np.where(deviation > ROUNDING, deviation, np.inf)
    exchanged = torch.tensor(ndtr(np.roll(scores, len(scores) // 2, axis=0)))  # those half a data set later
    origin, subspace = _subspace(y, margins.at(torch.tensor(quantiles), exchanged).numpy())
    margins.origin.copy_(torch.tensor(origin))
    margins.subspace.copy_(torch.tensor(subspace))
    values, vectors = np.linalg.eigh(scores.T @ scores / len(scores))
    margins.factor.copy_(torch.tensor((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T))
    return margins


def regression(x: Array, left: Array) -> tuple[Array, Array]:
    """Return slope (d, m) and mean (m,) of residuals (n, m) on inputs (n, d).

    What is left at an input is the mean + slopeᵀ (input − mean input).
    """
    scale = spread(x, np.inf)
    shift = left.mean(axis=0)
    slope = np.linalg.lstsq((x - x.mean(axis=0)) / scale, left - shift, rcond=COLLINEAR)[0]
    return slope / scale[:, None], shift


def _margins(quantiles: Array, targets: Array, inputs: int) -> InnovationCopula:
    """Return a copula with the margins of targets (n, m), independent otherwise."""
    samples = positions(quantiles, targets)
    widths = log_width(torch.tensor(quantiles)).numpy()
    n, outputs = samples.shape
    count = int(np.clip(n // 500, 1, 24))  # widths with margins of their own: one for 500 samples
    furthest = -ndtri(0.5 / n)
    shares = ndtr(np.linspace(-furthest, furthest, 257))
    centres = np.quantile(widths, (np.arange(count) + 0.5) / count, axis=0)
    copula = InnovationCopula(inputs, outputs, knots=len(shares), widths=count)
    copula.probabilities.copy_(torch.tensor(shares))
    copula.widths.copy_(torch.tensor(centres))
    for i in range(outputs):
        distinct, index = np.unique(centres[:, i], return_inverse=True)
        for b, peak in enumerate(np.eye(len(distinct))[index]):  # of a sample's weight at each centre, linear between
            weight = np.interp(widths[:, i], distinct, peak)
            copula.positions[b, :, i] = torch.tensor(_weighted_quantiles(samples[:, i], weight, shares))
    return copula


def _weighted_quantiles(samples: Array, weight: Array, shares: Array) -> Array:
    """Return the quantiles of weighted samples, each mid-share."""
    order = np.argsort(samples, kind="stable")
    total = np.cumsum(weight[order])
    at = (total - weight[order] / 2) / total[-1]
    return np.interp(shares, at, samples[order])


def _subspace(y: Array, draws: Array) -> tuple[Array, Array]:
    """Return mean (m,) and a map (m, m) that narrows draws along the narrow principal directions of samples."""
    origin = y.mean(axis=0)
    scale = spread(y, np.inf)
    values, vectors = np.linalg.eigh(np.cov((y - origin).T / scale[:, None]).reshape(len(origin), -1))
    drawn = ((((draws - origin) / scale) @ vectors) ** 2).mean(axis=0)
    narrow = values < NARROW * values.max()
    ratio = np.sqrt(np.maximum(values, 0.0) / np.maximum(drawn, np.finfo(float).tiny))
    kept = np.where(narrow, np.minimum(ratio, 1.0), 1.0)
    finite = np.where(np.isfinite(scale), scale, 1.0)
    return origin, (finite[:, None] * (vectors * kept)) @ vectors.T / finite
