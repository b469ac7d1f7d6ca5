"""Step of a sampled model as one torch operation.

It is for long episodes.

Torch records every instruction of a step; here one record holds a whole sample. Of few runs both ways go by CasADi's
own machine, of many by NumPy. That is many times faster, and once differentiable.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.exceptions import InputError
from ccdtools.plants.casadi_arrays import Vectorised, check_sizes
from ccdtools.plants.on_rows import as_rows, on_rows
from ccdtools.plants.runge_kutta import ExplicitStep
from ccdtools.plants.tolerances import FEW_ROWS


class PathwiseStep:
    """Step (x, u, w, p) → x⁺ of torch tensors (n, ·), in double precision.

    Parameters
    ----------
    step : ExplicitStep
    """

    def __init__(self, step: ExplicitStep) -> None:
        self._step = step
        self._sizes = [step.substep.numel_in(i) for i in range(4)]

    @cached_property
    def _of_sample(self) -> Callable[..., Array]:
        """Slopes of the whole sample, for few runs."""
        return on_rows(_slopes_of(self._step.function))

    @cached_property
    def _of_part(self) -> Vectorised:
        """Slopes of a part of the sample, for many runs."""
        return Vectorised(_slopes_of(self._step.substep))

    def __call__(self, x: Tensor, u: Tensor, w: Tensor, p: Tensor) -> Tensor:
        """Next states (n, nx).

        Raises
        ------
        InputError
            If a size is wrong, or the rows of one are not as many as those of x.
        """
        check_sizes(self._step.substep, (x, u, w, p))
        for name, given in zip("xuwp", (x, u, w, p)):
            if len(given.shape) != 2 and (name == "x" or len(given.shape) != 1):
                raise InputError(name, f"shape {tuple(given.shape)}", "rows (n, ·), or one (·,) for all but x")
            if len(given.shape) == 2 and len(given) != len(x):
                raise InputError(name, f"{len(given)} rows", f"{len(x)}, as many as x has")
        out: Tensor = _Taken.apply(self, x, u, w, p)
        return out

    def advanced(self, x: Array, held: tuple[Array, ...]) -> tuple[Array, list[Array]]:
        """x⁺ (n, nx), and for many runs the states (nx, n) between parts."""
        if len(x) <= FEW_ROWS:
            return self._step.rows(x, held), []
        states = self._step.path(x, held)
        return states[-1].T, states

    def slopes(self, x: Array, held: tuple[Array, ...], states: list[Array], multiplier: Array) -> list[Array]:
        """Products (n, ·) of the multiplier (n, nx) with ∂x⁺/∂x, ∂x⁺/∂u, ∂x⁺/∂w, ∂x⁺/∂p."""
        ends = np.cumsum(self._sizes)[:-1]
        if not states:
            return np.split(self._of_sample(x, *held, multiplier), ends, axis=1)
        state = np.empty_like(states[0])
        factor = as_rows(multiplier)
        found, part = self._of_part.in_place([state, *map(as_rows, held), factor])
        total = np.zeros_like(found)
        for before in reversed(states[:-1]):  # part by part backwards
            state[:] = before
            part()
            factor[:] = found[: len(state)]
            total += found
        total[: len(state)] = factor
        return np.split(total.T, ends, axis=1)


def _slopes_of(step: ca.Function) -> ca.Function:
    """(x, u, w, p, m) → slopes of m'x⁺ by x, u, w and p, stacked."""
    arguments: list[Any] = [ca.SX.sym(name, *step.size_in(i)) for i, name in enumerate("xuwp")]
    multiplier = ca.SX.sym("m", *step.size_out(0))
    slopes = ca.gradient(ca.dot(multiplier, step(*arguments)), ca.vertcat(*arguments))
    return ca.Function("slopes", [*arguments, multiplier], [ca.densify(slopes)])


class _Taken(torch.autograd.Function):
    """Step of NumPy arrays within a torch graph."""

    @staticmethod
    def forward(ctx: Any, step: PathwiseStep, *tensors: Tensor) -> Tensor:
        """x⁺ (n, nx)."""
        x, *held = _arrays(*tensors)
        ctx.step = step
        ctx.save_for_backward(*tensors)  # torch then refuses slopes at what has been overwritten since
        after, ctx.states = step.advanced(x, tuple(held))
        return tensors[0].new_tensor(after)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Slopes by x, u, w and p, summed where shared."""
        return None, *_Slopes.apply(ctx.step, ctx.states, gradient, *ctx.saved_tensors)


class _Slopes(torch.autograd.Function):
    """Slopes of a step, without second derivatives."""

    @staticmethod
    def forward(ctx: Any, step: PathwiseStep, states: list[Array], *tensors: Tensor) -> tuple[Tensor, ...]:
        """Slopes in the shapes of x, u, w and p."""
        multiplier, x, *held = _arrays(*tensors)
        found = step.slopes(x, tuple(held), states, multiplier)
        out = [part.sum(axis=0) if one.ndim == 1 else part for part, one in zip(found, tensors[1:])]
        return tuple(tensors[0].new_tensor(part) for part in out)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, ...]:
        """Raise, as zero would be wrong."""
        raise RuntimeError("`pathwise` is differentiable once; `advance` of the model has second derivatives")


def _arrays(*tensors: Tensor) -> tuple[Array, ...]:
    """Tensors as arrays in double precision."""
    return tuple(tensor.detach().double().numpy() for tensor in tensors)
