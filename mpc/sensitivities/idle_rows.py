"""Rows that are met without pushing: weak ones, dependent ones, and how far the others are from acting."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpc.checks import Array
from mpc.sensitivities.conditions import SOFTENED, Mask, Point
from mpc.sensitivities.linearised import Linearised
from mpc.tolerances import INDEPENDENT, TOGETHER, WEAKLY_ACTIVE


@dataclass(frozen=True, eq=False)
class IdleRows:
    """Rows (m,) that are met but do not push: weak ones, dependent ones, and which of these move along anyway."""

    weak: Mask
    dependent: Mask
    together: Mask

    @classmethod
    def of(cls, linear: Linearised, point: Point, rates: Array) -> IdleRows:
        """Those at an optimum whose free variables move by rates (n, nt)."""
        nt = linear.conditions.nt
        met = linear.on_bound & linear.own & ~point.acting
        acting = linear.rows[point.acting][:, linear.free] * linear.scale
        basis = np.linalg.qr(acting.T)[0] if len(acting) else np.zeros((len(linear.scale), 0))
        touched = {linear.labels[i].step for i in np.flatnonzero(linear.on_bound) if linear.labels[i].kind in SOFTENED}
        met &= np.array([label.kind != "slack" or label.step in touched for label in linear.labels], dtype=bool)
        dependent, together = np.zeros_like(met), np.zeros_like(met)
        for i in np.flatnonzero(met):
            row = linear.rows[i, linear.free] * linear.scale
            length = float(np.linalg.norm(row))
            left = float(np.linalg.norm(row - basis @ (basis.T @ row)))
            if left > INDEPENDENT * length:
                continue
            dependent[i] = True
            parts = linear.rows[i, linear.free][:, None] * rates
            rate = linear.rows[i, :nt] + parts.sum(axis=0)
            size = np.abs(linear.rows[i, :nt]) + np.abs(parts).sum(axis=0)
            together[i] = bool((np.abs(rate) <= TOGETHER * size).all())
        return cls(met & ~dependent, dependent, together)

    def margin(self, linear: Linearised, point: Point) -> float:
        """How far the nearest row is from beginning or ceasing to act, in its unit [-]."""
        idle = self.weak | self.dependent
        worth = linear.worth(linear.multipliers)
        pushing = worth > WEAKLY_ACTIVE
        room = np.where(pushing, worth, -linear.values / linear.units)
        counts = pushing | (linear.own & ~(point.acting | idle))
        counts &= np.array([label.kind != "slack" for label in linear.labels], dtype=bool) | pushing
        if (idle & ~point.acting).any() and not counts.any():
            return 0.0
        return float(np.maximum(room[counts], 0.0).min(initial=np.inf))
