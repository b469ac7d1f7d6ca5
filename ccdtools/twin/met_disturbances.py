"""Disturbances of a nonlinear model that explain logged errors."""

from __future__ import annotations

import casadi as ca
import numpy as np
import torch

from ccdtools.arrays import Array, Indices
from ccdtools.plants.sampled_model import SampledModel
from ccdtools.plants.simulated_model import SimulatedModel
from ccdtools.twin.budgets import DERIVATIVES_AT_ONCE
from ccdtools.twin.residuals import Residuals
from ccdtools.twin.tolerances import LARGEST_UNTOLD, SETTLED_STEP, TOLD, UNTOLD


def met_disturbances(model: SampledModel | SimulatedModel, log: Residuals, scale: Array) -> Array:
    """Disturbances ŵ (n, T, nw) that fit the log best in units of `scale` (nx,).

    It is zero where w has no effect. Where the effect is less than a tenth of the largest in the log, ŵ is at most
    twice as large as where it is more: a small effect would make large disturbances, that another state would feel, of
    what has another cause.
    """
    if model.nw == 0:
        return np.zeros((*log.x.shape[:2], 0))
    fit = _LeastSquares(model, log, scale)
    found = fit.improved(np.zeros((fit.samples, model.nw)))
    for start in _starts(model, fit):
        other = fit.improved(np.broadcast_to(start, found.shape))
        found = np.where((fit.distance(other) < fit.distance(found) - SETTLED_STEP * fit.size)[:, None], other, found)
    return fit.bounded(found).reshape(*log.x.shape[:2], model.nw)


class _LeastSquares:
    """Gauss–Newton least squares of all samples, with steps shortened until they improve."""

    def __init__(self, model: SampledModel | SimulatedModel, log: Residuals, scale: Array) -> None:
        self._model = model
        self._scale = scale
        _, self.x, self.u, _, e_next = log.columns()
        self.p = log.p
        self._reached = model.undisturbed(log.p)(self.x, self.u) + e_next
        self.samples = len(self.x)
        self.size = np.linalg.norm(e_next / scale, axis=1)  # of the errors, in scaled states
        self._everyone: Indices = np.arange(self.samples)

    def distance(self, w: Array) -> Array:
        """Distance (N,) between modelled and logged next states."""
        return np.asarray(np.linalg.norm(self._residual(w, self._everyone), axis=1))

    def improved(self, w: Array) -> Array:
        """Improved disturbances (N, nw), none farther from the log than before."""
        w = w.copy()
        longest = np.linalg.norm(self._effects(w, self._everyone), axis=1).max(axis=0)
        if not (longest > 0).any():
            return w
        lengths = np.where(longest > 0, longest, np.inf)
        some: Indices = self._everyone
        part = np.ones(self.samples)  # of a whole step
        for _ in range(30):
            effects = self._effects(w[some], some) / lengths
            residual = self._residual(w[some], some)
            whole = _least_squares(effects, residual)
            moving = np.linalg.norm(np.einsum("nij,nj->ni", effects, whole), axis=1) > SETTLED_STEP * self.size[some]
            if not moving.any():
                break
            some = some[moving]
            tried = w[some] + part[some][:, None] * whole[moving] / lengths
            better = np.linalg.norm(self._residual(tried, some), axis=1) < np.linalg.norm(residual[moving], axis=1)
            w[some[better]] = tried[better]
            part[some] = np.where(better, 1.0, part[some] / 4)
        return w

    def bounded(self, w: Array) -> Array:
        """Disturbances (N, nw), bounded by well-told ones; zero where that fits better."""
        effect = np.linalg.norm(self._effects(w, self._everyone), axis=1)
        told = (effect >= TOLD * effect.max(axis=0)) & (effect > 0)
        bound = LARGEST_UNTOLD * np.where(told, np.abs(w), 0.0).max(axis=0)
        within = np.where(effect > UNTOLD * effect.max(axis=0), np.clip(w, -bound, bound), 0.0)
        return np.where((self.distance(within) < self.size)[:, None], within, 0.0)

    def effect_of(self, w: Array, some: Indices) -> Array:
        """Move (k, m) of scaled next states by disturbances (k, 1, nw)."""
        with np.errstate(all="ignore"):
            moved = (self._next_states(w, some) - self._next_states(np.zeros_like(w[:1]), some)) / self._scale
            return np.asarray(np.nan_to_num(np.sqrt(np.square(moved).sum(axis=-1)), nan=np.inf))

    def _next_states(self, w: Array, some: Indices) -> Array:
        with np.errstate(all="ignore"):
            return np.asarray(self._model.advance(self.x[some], self.u[some], w, self.p))

    def _residual(self, w: Array, some: Indices) -> Array:
        """Logged minus modelled next states, scaled; infinite where not finite."""
        with np.errstate(all="ignore"):
            left = (self._reached[some] - self._next_states(w, some)) / self._scale
            return np.where(np.isfinite(np.square(left)), left, np.inf)

    def _effects(self, w: Array, some: Indices) -> Array:
        """Scaled slopes ∂x⁺/∂w (m, nx, nw), zero where not finite."""
        p = torch.tensor(self.p)
        parts = []
        for first in range(0, len(some), DERIVATIVES_AT_ONCE):
            chosen = some[first : first + DERIVATIVES_AT_ONCE]
            if isinstance(self._model, SimulatedModel):
                by_w = self._model.by_disturbance(
                    self.x[chosen], self.u[chosen], w[first : first + len(chosen)], self.p
                )
                parts.append(by_w / self._scale[:, None])
                continue
            at = torch.tensor(w[first : first + DERIVATIVES_AT_ONCE], requires_grad=True)
            after = self._model.pathwise(torch.tensor(self.x[chosen]), torch.tensor(self.u[chosen]), at, p)
            rows = [torch.autograd.grad(after[:, i].sum(), at, retain_graph=True)[0] for i in range(after.shape[1])]
            parts.append(torch.stack(rows, 1).numpy() / self._scale[:, None])
        return np.nan_to_num(np.concatenate(parts), nan=0.0, posinf=0.0, neginf=0.0)


def _starts(model: SampledModel | SimulatedModel, fit: _LeastSquares) -> list[Array]:
    """Starts (nw,) per channel and sign, besides zero; none if affine in w."""
    if isinstance(model, SampledModel):  # of a simulator it is not known
        plant = model.plant
        if not ca.depends_on(ca.jacobian(plant.dynamics, plant.w), plant.w):
            return []
    some = np.unique(np.linspace(0, fit.samples - 1, min(64, fit.samples)).round().astype(int))
    usual = np.median(fit.size)
    sizes = np.logspace(-12, 12, 97)  # in whatever unit; the least that moves states as far as errors do is taken
    starts = []
    for channel in np.eye(model.nw):
        moved = np.sort(fit.effect_of(sizes[:, None, None] * channel, some), axis=1)[:, len(some) // 2]
        enough = np.flatnonzero(np.isfinite(moved) & (moved >= usual))
        if len(enough):
            starts += [sizes[enough[0]] * channel, -sizes[enough[0]] * channel]
    return starts


def _least_squares(M: Array, b: Array) -> Array:
    """Shortest z (m, nw) minimising |M z − b|, without directions of hardly any effect."""
    U, values, V = np.linalg.svd(M, full_matrices=False)
    inverse = np.where(values > UNTOLD, 1.0 / np.maximum(values, UNTOLD), 0.0)
    along = np.einsum("nik,ni->nk", U, np.nan_to_num(b, nan=0.0, posinf=0.0, neginf=0.0))
    return np.asarray(np.einsum("nkj,nk->nj", V, inverse * along))
