"""The best causal policy of a plant of two states and one input that saturates, by dynamic programming on a grid."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product, repeat

import numpy as np
from scipy.ndimage import map_coordinates, spline_filter

from gallery.oracle.cost import model_step, simulated
from gallery.oracle.statement import Array, Statement

EXTENT = 2.0  # half-widths of X that the grid covers
POINTS = 91  # per state
INPUTS = 31
NODES = 5  # of the quadrature per disturbance


@dataclass(frozen=True)
class ClippedOptimum:
    """The policy that dynamic programming finds at one design.

    Attributes
    ----------
    statement : Statement
    design : (np,) array
    costs : (T, POINTS, POINTS) array
        Spline coefficients of the square root of the cost still to come, of the state before the disturbance acts.
    """

    statement: Statement
    design: Array
    costs: Array

    def returns(self, w: Array) -> Array:
        """Returns (n,) of the policy under disturbances w (n, T, nw)."""
        return self._returns(w, iter(self.costs))

    def stationary_returns(self, w: Array, step: int) -> Array:
        """The same of the policy that acts at all times as the optimal one acts at one step."""
        return self._returns(w, repeat(self.costs[step]))

    def _returns(self, w: Array, costs: Iterator[Array]) -> Array:
        """Returns (n,) of the policy that lowers one cost after the other."""
        s = self.statement
        A, B, _ = s.sampled(self.design)
        return simulated(s, model_step(s, self.design), lambda x: _best_input(s, x @ A.T, B, next(costs))[1], w)[0]


def clipped_optimum(s: Statement, p: Array) -> ClippedOptimum:
    """The policy at one design: V_k(x) = min_u R u² + E[x⁺ᵀ Q x⁺ + V_{k+1}(x⁺)], backwards from V_T = 0."""
    A, B, E = s.sampled(p)
    axes = [np.linspace(-EXTENT * x, EXTENT * x, POINTS) for x in s.x_max]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    kicks, weights = _quadrature(s, E)
    value = np.zeros((POINTS, POINTS))
    costs = []
    for _ in range(s.steps):
        smooth = spline_filter(np.sqrt(value))
        expected = np.zeros(len(grid))
        for kick, weight in zip(kicks, weights):
            x = grid + kick
            expected += weight * (x**2 @ s.Q + _at(s, smooth, x))
        costs.append(spline_filter(np.sqrt(expected.reshape(POINTS, POINTS))))
        value = _best_input(s, grid @ A.T, B, costs[-1])[0].reshape(POINTS, POINTS)
    return ClippedOptimum(s, p, np.array(costs[::-1]))


def _quadrature(s: Statement, E: Array) -> tuple[Array, Array]:
    """Nodes E w (m, 2) and weights (m,) of a Gauss–Hermite rule over the disturbance."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(NODES)
    weights = weights / weights.sum()
    combinations = list(product(range(NODES), repeat=len(s.std)))
    w = np.array([s.std * nodes[list(chosen)] for chosen in combinations])
    return w @ E.T, np.array([weights[list(chosen)].prod() for chosen in combinations])


def _at(s: Statement, root: Array, x: Array) -> Array:
    """A cost (n,) at states (n, 2), from the spline of its square root; beyond the grid that of its edge."""
    index = (x / (EXTENT * s.x_max) + 1) / 2 * (POINTS - 1)
    return map_coordinates(root, index.T, order=3, mode="nearest", prefilter=False) ** 2


def _best_input(s: Statement, drift: Array, B: Array, root: Array) -> tuple[Array, Array]:
    """Least cost (n,) over the inputs, and the input (n, 1), of states that would drift to (n, 2)."""
    inputs = np.linspace(-s.u_max[0], s.u_max[0], INPUTS)
    costs = np.array([s.R[0] * u**2 + _at(s, root, drift + u * B[:, 0]) for u in inputs])
    best = costs.argmin(axis=0)
    inner = np.clip(best, 1, INPUTS - 2)
    column = np.arange(len(drift))
    left, middle, right = (costs[inner + k, column] for k in (-1, 0, 1))
    bend = left - 2 * middle + right
    shift = np.where(bend > 0, 0.5 * (left - right) / np.where(bend > 0, bend, 1.0), best - inner)
    u = np.clip(inputs[inner] + shift * (inputs[1] - inputs[0]), -s.u_max[0], s.u_max[0])
    return s.R[0] * u**2 + _at(s, root, drift + u[:, None] * B[:, 0]), u[:, None]
