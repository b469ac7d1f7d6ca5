"""The step of a sampled model as one torch operation with its own first derivative, by NumPy: for long episodes.

Torch records every instruction of a step; here one record holds a whole sample, and both ways are the instructions of
CasADi on arrays. That is several times faster, and once differentiable.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.plants.casadi_arrays import Vectorised
from ccdtools.plants.runge_kutta import ExplicitStep


class PathwiseStep:
    """(x, u, w, p) → x⁺ of torch tensors (n, ·), p (np,) or (n, np), by an explicit step; in double precision inside.

    Parameters
    ----------
    step : ExplicitStep
    """

    def __init__(self, step: ExplicitStep) -> None:
        self.substeps = step.substeps
        self.forward = Vectorised(step.substep)
        arguments: list[Any] = [ca.SX.sym(name, *step.substep.size_in(i)) for i, name in enumerate("xuwp")]
        multiplier = ca.SX.sym("m", *step.substep.size_out(0))
        product = ca.dot(multiplier, step.substep(*arguments))
        slopes = [ca.densify(ca.gradient(product, argument)) for argument in arguments]
        stacked = ca.cse(ca.vertcat(*slopes))
        self.reverse = Vectorised(ca.Function("reverse", [*arguments, multiplier], [stacked]))
        self.sizes = tuple(argument.numel() for argument in arguments)

    def __call__(self, x: Tensor, u: Tensor, w: Tensor, p: Tensor) -> Tensor:
        """Next states (n, nx)."""
        out: Tensor = _Taken.apply(self, x, u, w, p)
        return out

    def path(self, x: Array, held: tuple[Array, ...]) -> list[Array]:
        """States (n, nx) before each part of the sample, and at its end."""
        states = [x]
        for _ in range(self.substeps):
            states.append(self.forward(states[-1], *held))
        return states

    def slopes(self, states: list[Array], held: tuple[Array, ...], multiplier: Array) -> list[Array]:
        """Products (n, ·) of the multiplier (n, nx) with ∂x⁺/∂x, ∂x⁺/∂u, ∂x⁺/∂w and ∂x⁺/∂p."""
        edges = np.cumsum(self.sizes)[:-1]
        rest = [np.zeros((len(multiplier), size)) for size in self.sizes[1:]]
        for x in reversed(states[:-1]):
            multiplier, *more = np.split(self.reverse(x, *held, multiplier), edges, axis=1)
            rest = [total + part for total, part in zip(rest, more)]
        return [multiplier, *rest]


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
