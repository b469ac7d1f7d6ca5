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
from ccdtools.plants.casadi_arrays import Tape
from ccdtools.plants.in_place import InPlace, as_rows
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
        self._sizes = [step.substep.numel_in(i) for i in range(4)]

    @cached_property
    def _of_sample(self) -> Native:
        """Slopes of the whole sample, of few runs."""
        return Native(_slopes_of(self._step.function))

    @cached_property
    def _of_part(self) -> Tape:
        """Slopes of a part of the sample, of many."""
        return Tape(_slopes_of(self._step.substep))

    def __call__(self, x: Tensor, u: Tensor, w: Tensor, p: Tensor) -> Tensor:
        """Next states (n, nx)."""
        out: Tensor = _Taken.apply(self, x, u, w, p)
        return out

    def advanced(self, x: Array, held: tuple[Array, ...]) -> tuple[Array, list[Array]]:
        """x⁺ (n, nx), and of many runs the states (nx, n) before each part of the sample, and at its end."""
        if len(x) <= FEW:
            return self._step.rows(x, held), []
        states = self._step.path(x, held)
        return states[-1].T, states

    def slopes(self, x: Array, held: tuple[Array, ...], states: list[Array], multiplier: Array) -> list[Array]:
        """Products (n, ·) of the multiplier (n, nx) with ∂x⁺/∂x, ∂x⁺/∂u, ∂x⁺/∂w and ∂x⁺/∂p."""
        found = self._back(states, held, multiplier) if states else self._of_sample(x, *held, multiplier)
        return np.split(found, np.cumsum(self._sizes)[:-1], axis=1)

    def _back(self, states: list[Array], held: tuple[Array, ...], multiplier: Array) -> Array:
        """The same side by side, part by part from the end of the sample."""
        state = np.empty_like(states[0])
        factor = as_rows(multiplier)
        part = InPlace(self._of_part, [state, *map(as_rows, held), factor])
        total = np.zeros_like(part.out)
        for before in reversed(states[:-1]):
            state[:] = before
            part.run()
            factor[:] = part.out[: len(state)]
            total += part.out
        total[: len(state)] = factor
        return total.T


def _slopes_of(step: ca.Function) -> ca.Function:
    """(x, u, w, p, m) → the slopes of m'x⁺ by x, u, w and p, one below the other."""
    arguments: list[Any] = [ca.SX.sym(name, *step.size_in(i)) for i, name in enumerate("xuwp")]
    multiplier = ca.SX.sym("m", *step.size_out(0))
    slopes = ca.gradient(ca.dot(multiplier, step(*arguments)), ca.vertcat(*arguments))
    return ca.Function("slopes", [*arguments, multiplier], [ca.densify(slopes)])


class _Taken(torch.autograd.Function):
    """A step of NumPy arrays within a torch graph."""

    @staticmethod
    def forward(ctx: Any, step: PathwiseStep, *tensors: Tensor) -> Tensor:
        """x⁺ (n, nx)."""
        x, *held = (tensor.detach().double().numpy() for tensor in tensors)
        ctx.step = step
        ctx.held = tuple(held)
        ctx.x = x
        ctx.shapes = tuple(tensor.shape for tensor in tensors)
        after, ctx.states = step.advanced(x, ctx.held)
        return tensors[0].new_tensor(after)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Slopes by x, u, w and p; summed over what is common to all runs."""
        found = ctx.step.slopes(ctx.x, ctx.held, ctx.states, gradient.double().numpy())
        out = [part.sum(axis=0) if len(shape) == 1 else part for part, shape in zip(found, ctx.shapes)]
        return None, *(gradient.new_tensor(part) for part in out)
