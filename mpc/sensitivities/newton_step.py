"""A Newton step on the optimality conditions of a plan, with the acting rows held."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpc.checks import Array
from mpc.sensitivities.conditions import Point
from mpc.sensitivities.linearised import Linearised
from mpc.sensitivities.plan_sensitivity import null_directions
from mpc.tolerances import DEFINITE, WEAKLY_ACTIVE


@dataclass(frozen=True, eq=False)
class NewtonStep:
    """Moves by θ = (x, p, u_prev) and, in the last column, to the optimum.

    Attributes
    ----------
    linear : Linearised
        The conditions that it is a step on.
    point : Point
        Where it begins.
    moves : (n, nt + 1) array
        Of the free inputs and slacks.
    pushes : (number of acting rows, nt + 1) array
        Of their multipliers.
    """

    linear: Linearised
    point: Point
    moves: Array
    pushes: Array

    @classmethod
    def of(cls, linear: Linearised, point: Point) -> NewtonStep | None:
        """The step at a point; None at a saddle.

        The acting rows are independent: of dependent ones a basic solution has multipliers on a part only.
        """
        at, nt = linear.conditions.columns, linear.conditions.nt
        acting = np.flatnonzero(point.acting)
        d = linear.scale
        rows = linear.rows[acting]
        G = rows[:, linear.free] * d
        length = np.linalg.norm(G, axis=1)
        length[length == 0] = 1.0
        G = G / length[:, None]
        H = linear.H * d * d[:, None]
        residual = linear.gradient[linear.free] + linear.multipliers @ linear.rows[:, linear.free] + linear.F_gap
        right = -np.column_stack([linear.F, residual]) * d[:, None]
        missed = rows[:, at["gap"]].ravel() + linear.values[acting]
        at_rows = -np.column_stack([rows[:, :nt], missed]) / length[:, None]
        first = np.linalg.lstsq(G, at_rows, rcond=None)[0] if len(G) else np.zeros_like(right)
        Z = null_directions(G)
        if Z.shape[1]:
            reduced = Z.T @ H @ Z
            reduced = (reduced + reduced.T) / 2
            if not np.isfinite(reduced).all() or np.linalg.eigvalsh(reduced)[0] < DEFINITE:
                return None
            first = first + Z @ np.linalg.solve(reduced, Z.T @ (right - H @ first))
        pushes = np.linalg.lstsq(G.T, right - H @ first, rcond=None)[0] if len(G) else np.zeros((0, nt + 1))
        return cls(linear, point, first * d[:, None], pushes / length[:, None])

    @property
    def size(self) -> float:
        """How far it goes, in sizes of inputs and states [-]."""
        linear = self.linear
        problem = linear.conditions.problem
        inputs, states = self._of_plan
        extent = np.where(problem.input_extent > 0, problem.input_extent, np.abs(inputs).max(initial=0.0))
        own = np.maximum(np.abs(linear.U[:, :, linear.conditions.columns["value"]]).max(axis=(0, 2)), extent)
        size = float(np.abs(inputs / np.where(own > 0, own, 1.0)).max(initial=0.0))
        size = max(size, float(np.abs(states / problem.state_extent).max()))
        return size if np.isfinite(size) else np.inf

    @property
    def _of_plan(self) -> tuple[Array, Array]:
        """Moves of inputs and states to the optimum."""
        linear, at = self.linear, self.linear.conditions.columns
        move = self.moves[: at["z"].stop - at["z"].start, -1]
        inputs, states = (form[:, :, at["z"]] @ move + form[:, :, at["gap"]][:, :, 0] for form in (linear.U, linear.X))
        return inputs, states

    def after(self) -> Point:
        """The point after it; rows that it would pass act from then on, those that would pull do not."""
        linear, point = self.linear, self.point
        inputs, states = self._of_plan
        multipliers = np.zeros(len(linear.rows))
        multipliers[point.acting] = linear.multipliers[point.acting] + self.pushes[:, -1]
        at = linear.conditions.columns
        move = self.moves[:, -1]
        values = linear.values + linear.rows[:, at["gap"]].ravel() + linear.rows[:, linear.free] @ move
        passed = (values > WEAKLY_ACTIVE * linear.units) & ~point.acting & linear.own
        acting = linear.acting(multipliers) | passed
        slacks = point.slacks + move[at["z"].stop - at["z"].start :]
        return Point(point.inputs + inputs, point.states + states, slacks, np.where(acting, multipliers, 0.0), acting)
