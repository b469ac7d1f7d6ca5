"""Rows that are met without pushing: weak ones, dependent ones, and how far the others are from acting."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from mpc.checks import Array
from mpc.sensitivities.conditions import SOFTENED, Mask, Point
from mpc.sensitivities.linearised import Linearised
from mpc.tolerances import INDEPENDENT, TOGETHER, WEAKLY_ACTIVE


@dataclass(frozen=True, eq=False)
class IdleRows:
    """Rows (m,) that are met but do not push: weak ones, dependent ones, and which of these move along anyway.

    Weak rows that only depend on each other are both: a direction has rates where its quadratic program has a solution
    (Ralph and Dempe, Mathematical Programming 70, 1995).
    """

    weak: Mask
    dependent: Mask
    together: Mask

    @classmethod
    def of(cls, linear: Linearised, point: Point, rates: Array) -> IdleRows:
        """Those at an optimum whose free variables move by rates (n, nt)."""
        met = linear.on_bound & linear.own & ~point.acting
        acting = linear.rows[point.acting][:, linear.free] * linear.scale
        basis = np.linalg.qr(acting.T)[0] if len(acting) else np.zeros((len(linear.scale), 0))
        touched = {linear.labels[i].step for i in np.flatnonzero(linear.on_bound) if linear.labels[i].kind in SOFTENED}
        met &= np.array([label.kind != "slack" or label.step in touched for label in linear.labels], dtype=bool)
        rows = linear.rows[:, linear.free] * linear.scale
        length = np.linalg.norm(rows, axis=1)
        left = rows - rows @ basis @ basis.T
        size = np.linalg.norm(left, axis=1)
        alone = met & (size <= INDEPENDENT * length)
        together = np.zeros_like(met)
        for i in np.flatnonzero(alone):
            together[i] = _moves_along(linear, rates, {int(i): 1.0})
        apart = met & ~alone
        dependent = alone.copy()
        while (found := _vanishing_sum(left / np.where(size > 0, size, 1.0)[:, None], apart)) is not None:
            members = np.array(list(found))
            along = _moves_along(linear, rates, {i: part / size[i] for i, part in found.items()})
            members = members[:1] if along else members
            dependent[members] = True
            together[members] = along
            apart[members] = False
        return cls(met & ~alone, dependent, together)

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


def _vanishing_sum(unit: Array, weak: Mask) -> dict[int, float] | None:
    """A sum with positive parts of weak rows that leaves nothing beside the acting ones; None where there is none.

    Where there is one the multipliers are not unique (Kyparisis, Mathematical Programming 32, 1985).
    """
    rows = np.flatnonzero(weak)
    if not len(rows):
        return None
    both = np.vstack([unit[rows].T, np.ones(len(rows))])
    parts, missed = nnls(both, np.append(np.zeros(len(both) - 1), 1.0), maxiter=30 * len(both))
    return {int(i): float(part) for i, part in zip(rows, parts) if part > 0} if missed <= INDEPENDENT else None


def _moves_along(linear: Linearised, rates: Array, parts: dict[int, float]) -> bool:
    """Whether a sum of rows stays on its bound in all directions as the free variables move by rates (n, nt)."""
    nt = linear.conditions.nt
    terms = [part * np.vstack([linear.rows[i, :nt], linear.rows[i, linear.free][:, None] * rates])
             for i, part in parts.items()]  # fmt: skip
    terms_of_all = np.concatenate(terms)
    return bool((np.abs(terms_of_all.sum(axis=0)) <= TOGETHER * np.abs(terms_of_all).sum(axis=0)).all())
