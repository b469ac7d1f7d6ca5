"""Stagewise QPs, for unstable plants over long horizons.

When the inputs cannot hold an unstable plant, its states grow by many orders of magnitude, and a QP with the states
eliminated keeps no digits of the inputs. A Riccati recursion does: it sees one step at a time, and an input at its
limit has no feedback. The method is a primal-dual interior-point method whose Newton steps are Riccati recursions.

References: Rao, Wright and Rawlings, *Application of interior-point methods to model predictive control*, JOTA 99(3),
1998; Frison and Diehl, *HPIPM*, IFAC 2020 (which has no Python wheel); Mehrotra, SIAM J. Optimization 2(4), 1992.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mpc.checks import Array
from mpc.tolerances import KKT_REPORTED, PRIMAL, ROUNDED_SUM

if TYPE_CHECKING:
    from mpc.stages import QPStage

Arrays = list[Array]


@dataclass(frozen=True, eq=False)
class StagewiseResult:
    """Scaled states and variables per stage, last step and violation [-]."""

    states: Arrays
    variables: Arrays
    step: float
    violation: float

    @property
    def converged(self) -> bool:
        """Whether Newton steps have ended and every row holds."""
        return max(self.step, self.violation) <= KKT_REPORTED


@dataclass(frozen=True, eq=False)
class _Direction:
    """Newton step: feedforward and changes of slacks and multipliers."""

    forward: Arrays
    slacks: Arrays
    multipliers: Arrays


class _Iteration:
    """Iterate with slacks s > 0 and multipliers y > 0."""

    def __init__(self, stages: list[QPStage], start: Array, variables: Arrays):
        self.stages = stages
        self.variables = [v.copy() for v in variables]
        self.states = [start]
        for k, (stage, v) in enumerate(zip(stages, self.variables)):
            x = self.states[k]
            if len(v) > stage.nu:  # the price variable starts above every violation
                over = stage.C[:, : stage.nu] @ v[: stage.nu] + stage.D @ x - stage.d
                v[-1] = 1.0 + float(np.max(over[stage.C[:, -1] < 0], initial=0.0))
            self.states.append(stage.A @ x + stage.B @ v + stage.c)
        self.states.pop()
        values = [st.d - st.C @ v - st.D @ x for st, v, x in zip(stages, self.variables, self.states)]
        self.slacks = [np.maximum(value, 1.0) for value in values]
        rows = max(sum(len(s) for s in self.slacks), 1)
        cost = sum(
            abs(x @ st.Hx @ x / 2 + st.gx @ x) + abs(v @ st.Hv @ v / 2 + st.gv @ v)
            for st, v, x in zip(stages, self.variables, self.states)
        )
        self.multipliers = [max(cost / rows, 1.0) / s for s in self.slacks]
        self.gains: Arrays = [np.zeros(st.B.T.shape) for st in stages]
        self.refresh()

    def refresh(self) -> None:
        """Compute row residuals and recursion gains."""
        self.residuals: Arrays = []
        self.violation = 0.0
        for k, (st, x, v, s) in enumerate(zip(self.stages, self.states, self.variables, self.slacks)):
            terms = np.abs(st.C) @ np.abs(v) + np.abs(st.D) @ np.abs(x) + np.abs(st.d) + s
            r = st.C @ v + st.D @ x + s - st.d
            self.residuals.append(np.where(np.abs(r) <= ROUNDED_SUM * terms, 0.0, r))
            over = np.maximum(np.abs(r) - np.abs(st.C) @ self.noise(k), 0.0)
            self.violation = max(self.violation, float(np.max(over / np.maximum(terms, 1.0), initial=0.0)))
        self.open = [s > ROUNDED_SUM for s in self.slacks]  # the others are at their bounds to all digits
        self.weights = [y / s for y, s in zip(self.multipliers, self.slacks)]
        self._factorise()

    def noise(self, k: int) -> Array:
        """Rounding of the variables of stage k through feedback."""
        return ROUNDED_SUM * np.abs(self.gains[k]) @ np.abs(self.states[k])

    def largest_step(self, direction: _Direction) -> float:
        """Largest change of an input in a Newton step, beyond rounding."""
        over = (np.abs(f) - self.noise(k) for k, f in enumerate(direction.forward))
        return max(float(np.max(change[: st.nu], initial=0.0)) for st, change in zip(self.stages, over))

    def _factorise(self) -> None:
        """Compute gains K and factors of every stage, backwards."""
        count = len(self.stages)
        self.gains = [np.zeros(0) for _ in range(count)]
        self.inverses = [np.zeros(0) for _ in range(count)]
        V = np.zeros_like(self.stages[-1].Hx)
        for k in reversed(range(count)):
            st = self.stages[k]
            w = self.weights[k]
            M = st.Hv + (st.C.T * w) @ st.C + st.B.T @ V @ st.B
            cross = st.B.T @ V @ st.A + (st.C.T * w) @ st.D + st.Hc.T
            inverse = _inverse(M)
            K = -inverse @ cross
            closed = st.A + st.B @ K
            rows = st.D + st.C @ K
            V = st.Hx + closed.T @ V @ closed + K.T @ st.Hv @ K + (rows.T * w) @ rows + 2 * st.Hc @ K
            V = (V + V.T) / 2
            self.gains[k] = K
            self.inverses[k] = inverse

    def direction(self, rho: Arrays) -> _Direction:
        """Newton step for row multipliers `rho`."""
        forward: Arrays = [np.zeros(0)] * len(self.stages)
        v_next = np.zeros(len(self.states[0]))
        for k in reversed(range(len(self.stages))):
            st = self.stages[k]
            K = self.gains[k]
            by_state, by_variables = st.slopes(self.states[k], self.variables[k])
            slope = by_variables + st.C.T @ rho[k]
            forward[k] = -self.inverses[k] @ (slope + st.B.T @ v_next)
            v_next = by_state + st.D.T @ rho[k] + K.T @ slope + (st.A + st.B @ K).T @ v_next
        slacks = []
        multipliers = []
        dx = np.zeros(len(self.states[0]))
        for st, K, f, r, p, y, w in zip(
            self.stages, self.gains, forward, self.residuals, rho, self.multipliers, self.weights
        ):
            dv = f + K @ dx
            move = st.C @ dv + st.D @ dx
            slacks.append(-r - move)
            multipliers.append(p - y + w * move)
            dx = st.A @ dx + st.B @ dv
        return _Direction(forward, slacks, multipliers)

    def longest(self, direction: _Direction) -> float:
        """Longest step, at most 1, that keeps slacks and multipliers positive."""
        length = 1.0
        for now, change in ((self.slacks, direction.slacks), (self.multipliers, direction.multipliers)):
            for a, da, open_ in zip(now, change, self.open):
                shrinking = (da < 0) & open_
                if shrinking.any():
                    length = min(length, float((-a[shrinking] / da[shrinking]).min()))
        return length

    def mean_product(self, direction: _Direction | None = None, length: float = 0.0) -> float:
        """Mean of slack times multiplier over open rows, after a step."""
        total = 0.0
        rows = 0
        for k, (s, y) in enumerate(zip(self.slacks, self.multipliers)):
            if direction is not None:
                s = s + length * direction.slacks[k]
                y = y + length * direction.multipliers[k]
            total += float(s[self.open[k]] @ y[self.open[k]])
            rows += int(self.open[k].sum())
        return total / max(rows, 1)

    def move(self, direction: _Direction, length: float) -> None:
        """Take a step; states follow forwards with feedback."""
        states = [self.states[0]]
        for k, (st, K, f) in enumerate(zip(self.stages, self.gains, direction.forward)):
            self.variables[k] = self.variables[k] + length * f + K @ (states[k] - self.states[k])
            states.append(st.A @ states[k] + st.B @ self.variables[k] + st.c)
        self.states = states[:-1]
        self.slacks = [np.maximum(s + length * ds, ROUNDED_SUM) for s, ds in zip(self.slacks, direction.slacks)]
        self.multipliers = [
            np.maximum(y + length * dy, np.finfo(float).tiny) for y, dy in zip(self.multipliers, direction.multipliers)
        ]
        self.refresh()


def solve_stagewise(stages: list[QPStage], start: Array, variables: Arrays) -> StagewiseResult:
    """Solution from the scaled first state and first variables."""
    at = _Iteration(stages, start, variables)
    best = StagewiseResult(at.states, list(at.variables), np.inf, at.violation)
    waited = 0
    for _ in range(100):
        affine = [w * r for w, r in zip(at.weights, at.residuals)]
        predictor = at.direction(affine)
        step = at.largest_step(predictor)
        if not np.isfinite(step + at.violation):
            break
        waited += 1
        if max(step, at.violation) < max(best.step, best.violation):
            best = StagewiseResult(at.states, list(at.variables), step, at.violation)
            waited = 0
        if max(step, at.violation) <= PRIMAL or (best.converged and waited > 2):
            break
        mean = at.mean_product()
        share = at.mean_product(predictor, at.longest(predictor)) / mean if mean > 0 else 0.0
        target = mean * min(1.0, abs(share)) ** 3
        centred = [
            a + np.where(o, target - ds * dy, 0.0) / s
            for a, ds, dy, s, o in zip(affine, predictor.slacks, predictor.multipliers, at.slacks, at.open)
        ]
        direction = at.direction(centred)
        at.move(direction, min(1.0, 0.995 * at.longest(direction)))  # slacks and multipliers stay positive
    return best


def _inverse(M: Array) -> Array:
    """Inverse of a symmetric positive definite matrix, scaled."""
    scale = 1 / np.sqrt(np.maximum(np.diag(M), np.finfo(float).tiny))
    regular = M * scale * scale[:, None] + ROUNDED_SUM * np.eye(len(M))
    return np.asarray(np.linalg.inv(regular) * scale * scale[:, None])
