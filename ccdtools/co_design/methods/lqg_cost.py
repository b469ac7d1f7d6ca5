"""Expected cost of unsaturated LQG, by two Riccati equations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.co_design.measured import kalman_filter
from ccdtools.co_design.methods.riccati_cost import RiccatiCost
from ccdtools.co_design.objective import QuadraticObjective
from mpc import NotStabilisableError


@dataclass(eq=False)
class LqgCost(RiccatiCost):
    """Expected cost of the episodes under LQG, plus the design's; slopes by differences.

    The second moments of states and estimates are carried along the episode, so that its start counts. Inputs never
    saturate, the disturbance is white; else see `RiccatiCost`.
    """

    words = "LQG without saturation, by two Riccati equations"

    def __call__(self, v: Array) -> tuple[float, Callable[[], Array]]:
        """Cost and slope (np,) at a point (np,); infinite without LQR or filter."""
        value = self._value(v)[0]
        self.remember(self.problem.design.from_unit(v), -value)
        return value, lambda: self.differences(v, self._value, 1)[0]

    def _value(self, v: Array) -> Array:
        """Cost (1,) at a point."""
        p = self.problem.design.from_unit(v)
        try:
            return np.array([self._of_loop(p) + self._at_rest(p)[0]])
        except NotStabilisableError:  # of a filter, too
            return np.array([np.inf])

    def _of_loop(self, p: Array) -> float:
        """Expected cost of the steps of an episode.

        Of z = (x, x̄), the state and its estimate before the measurement, u = −K (M C x + (I − M C) x̄ + M v).
        """
        problem, nx = self.problem, self.problem.model.nx
        A, B, E = problem.model.matrices(p)
        K, found = saturated_lqr(problem, p).K, kalman_filter(problem, p)
        M, C, eye, none = found.gain, found.C, np.eye(nx), np.zeros((nx, nx))
        estimate = np.hstack([M @ C, eye - M @ C])
        moved = np.vstack([-B @ K, A - B @ K])
        F = np.block([[A, none], [none, none]]) + moved @ estimate
        starts, noise = problem.second_moments
        N = moved @ M @ found.V @ M.T @ moved.T
        N[:nx, :nx] += E @ noise @ E.T
        S = np.zeros((2 * nx, 2 * nx))
        S[:nx, :nx] = starts
        total = np.zeros_like(S)
        for _ in range(problem.steps):
            total += S
            S = F @ S @ F.T + N
        seen = np.vstack([np.hstack([eye, none]), -K @ estimate])
        both = seen @ total @ seen.T  # of (x, u), summed over the steps
        both[nx:, nx:] += problem.steps * (K @ M @ found.V @ M.T @ K.T)
        Q, R, cross = problem.weights(p)
        cost = np.sum(Q * both[:nx, :nx]) + np.sum(R * both[nx:, nx:])
        cost += 0.0 if cross is None else 2 * np.sum(cross * both[:nx, nx:])
        if isinstance(problem.objective, QuadraticObjective):  # judges the states after the steps
            cost += np.sum(Q * (S[:nx, :nx] - starts))
        return float(cost)
