"""Expected cost of unsaturated LQG, by two Riccati equations."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.co_design.measured import kalman_filter
from ccdtools.co_design.methods.riccati_cost import RiccatiCost
from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.estimation.belief import gain_of, propagated_covariance, updated_covariance
from mpc import NotStabilisableError


@dataclass(eq=False)
class LqgCost(RiccatiCost):
    """Expected cost of LQG, plus the design's.

    The second moments of states and estimates are carried along the episode, so that its start counts. Inputs never
    saturate, the disturbance is white; else see `RiccatiCost`.
    """

    words = "LQG without saturation, by two Riccati equations"

    def __call__(self, v: Array) -> tuple[float, Callable[[], Array]]:
        """Cost and slope (np,) at a point (np,); infinite without LQR, or beyond all numbers."""
        value = self._value(v)[0]
        self.remember(self.problem.design.from_unit(v), -value)
        return value, lambda: self.differences(v, self._value, 1)[0]

    def _value(self, v: Array) -> Array:
        """Cost (1,) at a point."""
        p = self.problem.design.from_unit(v)
        with suppress(NotStabilisableError), np.errstate(all="ignore"):
            value = self._of_loop(p) + self._at_rest(p)[0]
            return np.array([value if np.isfinite(value) else np.inf])
        return np.array([np.inf])

    def _of_loop(self, p: Array) -> float:
        """Expected cost of the steps of an episode.

        Of z = (x, x̄), the state and its estimate before the measurement, about their common mean, along which LQR acts
        as if it saw it; u = −K (M C x + (I − M C) x̄ + M v).
        """
        problem, nx = self.problem, self.problem.model.nx
        A, B, E = problem.model.matrices(p)
        law, known = saturated_lqr(problem, p), kalman_filter(problem, p)
        K, C, V, P = law.K, known.C, known.V, known.P0
        mean, _, noise = problem.moments
        starts = P + np.outer(mean, mean)
        eye, none = np.eye(nx), np.zeros((nx, nx))
        plant, moved = np.block([[A, none], [none, none]]), np.vstack([-B @ K, A - B @ K])
        driven = np.block([[E @ noise @ E.T, none], [none, none]])
        S = np.block([[P, none], [none, none]])
        total = np.zeros((nx + len(K), nx + len(K)))  # of (x, u), summed over the steps
        for _ in range(problem.steps):
            M = gain_of(P, C, V)
            P = propagated_covariance(updated_covariance(P, C, V, M), A, known.W)
            estimate = np.hstack([M @ C, eye - M @ C])
            seen = np.vstack([np.hstack([eye, none]), -K @ estimate])
            of_noise = M @ V @ M.T
            total += seen @ S @ seen.T
            total[nx:, nx:] += K @ of_noise @ K.T
            F = plant + moved @ estimate
            S = F @ S @ F.T + moved @ of_noise @ moved.T + driven
            u = law.offset - K @ mean
            total += np.outer(np.r_[mean, u], np.r_[mean, u])
            mean = A @ mean + B @ u + known.c
        Q, R, cross = problem.weights(p)
        cost = np.sum(Q * total[:nx, :nx]) + np.sum(R * total[nx:, nx:])
        cost += 0.0 if cross is None else 2 * np.sum(cross * total[:nx, nx:])
        after = S[:nx, :nx] + np.outer(mean, mean)
        if isinstance(problem.objective, QuadraticObjective):  # judges the states after the steps
            cost += np.sum(Q * (after - starts))
        terminal = getattr(problem.objective, "terminal_cost", None)
        if terminal is not None:
            cost += np.sum(np.asarray(terminal.hessian(nx, len(p))(p)) / 2 * after)
        return float(cost)
