"""The step of a sampled model as one torch operation with its own first derivative: for long episodes.

Torch records every instruction of a step; here one record holds a whole sample. Of few runs both ways go by CasADi's
own machine, of many by NumPy. That is many times faster, and once differentiable.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.plants.casadi_arrays import Vectorised
from ccdtools.plants.native import FEW, Native
from ccdtools.plants.runge_kutta import ExplicitStep


class PathwiseStep:
    """(x, u, w, p) → x⁺ of torch tensors (n, ·), p (np,) or (n, np), by an explicit step; in double precision inside.

    Parameters
    ----------
    step : ExplicitStep
    """

    def __init__(self, step: ExplicitStep) -> None:
        self._step = step
        self._edges = np.cumsum([step.substep.numel_in(i) for i in range(4)])[:-1]

    @cached_property
    def _forward(self) -> Vectorised:
        """A part of the sample, on many runs."""
        return Vectorised(self._step.substep)

    @cached_property
    def _reverse(self) -> Vectorised:
        """Slopes of a part of the sample, on many runs."""
        return Vectorised(_slopes_of(self._step.substep))

    @cached_property
    def _whole_reverse(self) -> Native:
        """Slopes of the whole sample, on few runs."""
        return Native(_slopes_of(self._step.function))

    def __call__(self, x: Tensor, u: Tensor, w: Tensor, p: Tensor) -> Tensor:
        """Next states (n, nx)."""
        out: Tensor = _Taken.apply(self, x, u, w, p)
        return out

    def path(self, x: Array, held: tuple[Array, ...]) -> list[Array]:
        """States (n, nx) before each part of the sample, and at its end; of few runs, before and after the sample."""
        if len(x) <= FEW:
            return [x, self._step.native(x, *held)]
        states = [x]
        for _ in range(self._step.substeps):
            states.append(self._forward(states[-1], *held))
        return states

    def slopes(self, states: list[Array], held: tuple[Array, ...], multiplier: Array) -> list[Array]:
        """Products (n, ·) of the multiplier (n, nx) with ∂x⁺/∂x, ∂x⁺/∂u, ∂x⁺/∂w and ∂x⁺/∂p."""
        if len(multiplier) <= FEW:
            return np.split(self._whole_reverse(states[0], *held, multiplier), self._edges, axis=1)
        rest = 0.0
        for x in reversed(states[:-1]):
            found = self._reverse(x, *held, multiplier)
            multiplier = found[:, : self._edges[0]]
            rest = rest + found[:, self._edges[0] :]
        return [multiplier, *np.split(rest, self._edges[1:] - self._edges[0], axis=1)]


def _slopes_of(step: ca.Function) -> ca.Function:
    """(x, u, w, p, m) → the slopes of m'x⁺ by x, u, w and p, stacked."""
    arguments: list[Any] = [ca.SX.sym(name, *step.size_in(i)) for i, name in enumerate("xuwp")]
    multiplier = ca.SX.sym("m", *step.size_out(0))
    slopes = ca.gradient(ca.dot(multiplier, step(*arguments)), ca.vertcat(*arguments))
    return ca.Function("reverse", [*arguments, multiplier], [ca.densify(slopes)])


class _Taken(torch.autograd.Function):
    """A step of NumPy arrays within a torch graph."""

    @staticmethod
    def forward(ctx: Any, step: PathwiseStep, *tensors: Tensor) -> Tensor:
        """x⁺ (n, nx)."""
        x, *held = (tensor.detach().double().numpy() for tensor in tensors)
        ctx.step = step
        ctx.held = tuple(held)
        ctx.states = step.path(x, ctx.held)
        ctx.shapes = tuple(tensor.shape for tensor in tensors)
        return tensors[0].new_tensor(ctx.states[-1])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Slopes by x, u, w and p; summed over what is common to all runs."""
        found = ctx.step.slopes(ctx.states, ctx.held, gradient.double().numpy())
        out = [part.sum(axis=0) if len(shape) == 1 else part for part, shape in zip(found, ctx.shapes)]
        return None, *(gradient.new_tensor(part) for part in out)
