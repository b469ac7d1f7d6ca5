"""Step of a sampled model as one torch operation.

It is for long episodes.

Torch records every instruction of a step; here one record holds a whole sample. Of few runs both ways go by CasADi's
own machine, of many by NumPy. That is many times faster, and once differentiable.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ccdtools.arrays import Array
from ccdtools.exceptions import InputError
from ccdtools.plants.casadi_arrays import check_sizes


def pathwise(step: Any, x: Tensor, u: Tensor, w: Tensor, p: Tensor) -> Tensor:
    """Next states (n, nx) of torch tensors (n, ·), in double precision.

    The step is an `ExplicitStep` or a `SimulatedModel`.

    Raises
    ------
    InputError
        If a size is wrong, or the rows of one are not as many as those of x.
    """
    check_sizes(step.sizes, (x, u, w, p))
    for name, given in zip("xuwp", (x, u, w, p)):
        if len(given.shape) != 2 and (name == "x" or len(given.shape) != 1):
            raise InputError(name, f"shape {tuple(given.shape)}", "rows (n, ·), or one (·,) for all but x")
        if len(given.shape) == 2 and len(given) != len(x):
            raise InputError(name, f"{len(given)} rows", f"{len(x)}, as many as x has")
    out: Tensor = _Taken.apply(step, x, u, w, p)
    return out


class _Taken(torch.autograd.Function):
    """Step of NumPy arrays within a torch graph."""

    @staticmethod
    def forward(ctx: Any, step: Any, *tensors: Tensor) -> Tensor:
        """x⁺ (n, nx)."""
        x, *held = _arrays(*tensors)
        ctx.step = step
        ctx.save_for_backward(*tensors)  # torch then refuses slopes at what has been overwritten since
        few = len(x) <= step.few_rows
        ctx.states = [] if few else step.path(x, tuple(held))
        return tensors[0].new_tensor(step.rows(x, tuple(held)) if few else ctx.states[-1].T)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Slopes by x, u, w and p, summed where shared."""
        given = ctx.saved_tensors  # once: within a torch checkpoint they are recomputed when asked for
        multiplier, x, *held = _arrays(gradient, *given)
        found = ctx.step.slopes(x, tuple(held), ctx.states, multiplier)
        out = [part.sum(axis=0) if one.ndim == 1 else part for part, one in zip(found, given)]
        return None, *(gradient.new_tensor(part) for part in out)


def _arrays(*tensors: Tensor) -> tuple[Array, ...]:
    """Tensors as arrays in double precision."""
    return tuple(tensor.detach().double().numpy() for tensor in tensors)
