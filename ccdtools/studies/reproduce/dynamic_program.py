"""Optimal returns by dynamic programming, of a linear model of two states with one bounded input."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.ndimage import map_coordinates, spline_filter

from ccdtools.arrays import Array, Mask
from ccdtools.co_design.objective import Weights

QUADRATURE = 5  # Gauss–Hermite points of the noise in each state


def optimal_return(
    A: Array, B: Array, weights: Weights, std: Array, inputs: tuple[float, float], box: tuple[Array, Array], x0: Array,
    *, steps: int, cells: tuple[int, int] = (91, 61), choices: int = 41,
) -> float:  # fmt: skip
    """Largest expected return from a state, over all causal policies.

    V ← max_u E[−x⁺ᵀQx⁺ − uᵀRu + V(x⁺)], x⁺ = A x + B u + w, with cubic splines on a grid of states and a parabola
    through the best of a grid of inputs. Beyond the grid V is that of its edge, which costs less than the truth.

    Parameters
    ----------
    A, B : (2, 2) and (2, 1) arrays
    weights : Weights
    std : (2,) array
        Of the normal, independent noise w.
    inputs : (float, float)
        Least and largest input.
    box : ((2,) array, (2,) array)
        Grid of states.
    x0 : (2,) array
    steps : int
    cells, choices : (int, int) and int
        Grid points of each state, and of the input.
    """
    lower, upper = box
    axes = [np.linspace(*ends, n) for ends, n in zip(zip(lower, upper), cells)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"))
    cell = (upper - lower) / (np.array(cells) - 1)
    u = np.linspace(*inputs, choices)
    following = np.einsum("ij,jab->iab", A, x)[..., None] + B[:, 0, None, None, None] * u
    paid = np.einsum("iabu,ij,jabu->abu", following, weights.Q, following) + weights.R[0, 0] * u**2
    paid = paid + np.trace(weights.Q @ np.diag(std**2))
    nodes, share = np.polynomial.hermite_e.hermegauss(QUADRATURE)
    share = share / share.sum()
    noise = [((i, j), share[i] * share[j]) for i, j in itertools.product(range(QUADRATURE), repeat=2)]
    at = (following - lower[:, None, None, None]) / cell[:, None, None, None]
    own = (x - lower[:, None, None]) / cell[:, None, None]
    value = np.zeros(cells)
    for _ in range(steps):
        smooth = spline_filter(value, mode="nearest")
        expected = sum(
            weight * _spline(smooth, own + (nodes[list(pair)] * std / cell)[:, None, None]) for pair, weight in noise
        )
        value = _best(_spline(spline_filter(expected, mode="nearest"), at) - paid)
    return float(_spline(spline_filter(value, mode="nearest"), ((x0 - lower) / cell)[:, None])[0])


def viable(
    A: Array, B: Array, inputs: tuple[float, float], box: tuple[Array, Array], *, cells: int = 201, choices: int = 41
) -> float:
    """Area of the states that inputs can keep in a box, by a grid."""
    lower, upper = box
    axes = np.linspace(lower, upper, cells).T
    x = np.stack(np.meshgrid(*axes, indexing="ij"))
    cell = (upper - lower) / (cells - 1)
    u = np.linspace(*inputs, choices)
    following = np.einsum("ij,jab->iab", A, x)[..., None] + B[:, 0, None, None, None] * u
    at = (following - lower[:, None, None, None]) / cell[:, None, None, None]
    kept: Mask = np.ones((cells, cells), dtype=bool)
    for _ in range(cells):
        inside = map_coordinates(kept.astype(float), at, order=1, cval=0.0)
        fewer = kept & (inside >= 0.5).any(axis=-1)
        if fewer.sum() == kept.sum():
            break
        kept = fewer
    return float(kept.mean() * np.prod(upper - lower))


def _spline(coefficients: Array, at: Array) -> Array:
    """Cubic spline at grid coordinates (2, ...)."""
    return np.asarray(map_coordinates(coefficients, at, order=3, prefilter=False, mode="nearest"))


def _best(values: Array) -> Array:
    """Largest of values (..., u), by the parabola through the largest and its neighbours."""
    top = np.clip(values.argmax(axis=-1), 1, values.shape[-1] - 2)[..., None]
    low, middle, high = (np.take_along_axis(values, top + k, axis=-1)[..., 0] for k in (-1, 0, 1))
    bend = low - 2 * middle + high
    vertex = np.divide(low - high, 2 * bend, out=np.zeros_like(bend), where=bend < 0)
    inner = middle - np.clip(vertex, -1, 1) * (low - high) / 2 + bend / 2 * np.clip(vertex, -1, 1) ** 2
    return np.asarray(np.maximum(values.max(axis=-1), np.where(bend < 0, inner, -np.inf)))
