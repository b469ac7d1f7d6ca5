"""CasADi functions as batched, differentiable torch functions."""

from __future__ import annotations

import warnings
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from ccdtools.exceptions import InputError
from ccdtools.plants.casadi_arrays import Vectorised
from ccdtools.plants.casadi_operations import torch_operations
from ccdtools_ground.door import shown


def to_torch(function: ca.Function) -> TorchFunction:
    """CasADi function on batches of torch tensors, differentiable any number of times.

    Tensors may be of any type and on any device.

    Each scalar instruction of the function becomes one torch operation over the whole batch, so torch differentiates
    it by itself. A function without scalar instructions (it calls an integrator, a solver or C code) is evaluated by
    CasADi point by point, in double precision on the processor, with CasADi's own derivatives; a warning says so, and
    `torch.func` and `vmap` do not take it. As with `torch.where`, the gradient is NaN where a branch that is not taken
    has no derivative: keep its argument in range, as in `if_else(y > 0, sqrt(fmax(y, 1e-9)), 0)`.

    Parameters
    ----------
    function : casadi.Function
        Any number of inputs and outputs, dense or sparse.

    Returns
    -------
    TorchFunction
        Call it with one tensor for each input: (..., n) for a column, (..., r, c) for a matrix, a row too. Leading
        shapes broadcast: give what is common to all points without them. Returns one tensor, or a tuple of them.

    Raises
    ------
    InputError
        `function` is no CasADi function.

    Examples
    --------
    >>> step = to_torch(model.function)  # doctest: +SKIP
    >>> x_next = step(torch.randn(10_000, 4), u, p)  # doctest: +SKIP
    """
    if not isinstance(function, ca.Function):
        raise InputError("function", shown(function), "a casadi.Function")
    if function.n_out() == 0:
        raise InputError("function", f"{function.name()}, which has no output", "at least one output")
    return TorchFunction(function)


class TorchFunction:
    """CasADi function that takes and returns torch tensors; see `to_torch`.

    Attributes
    ----------
    function : casadi.Function
        What is evaluated.
    translated : bool
        Whether torch carries out every instruction; else CasADi is called point by point.
    """

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        try:
            self._tape: Vectorised | None = Vectorised(function, "function")
        except InputError as error:
            self._tape = None
            warnings.warn(
                f"to_torch: CasADi evaluates {function.name()} point by point. {error.cure}".rstrip(), stacklevel=3
            )
        self.translated = self._tape is not None

    def __repr__(self) -> str:
        way = "torch instructions" if self.translated else "CasADi point by point"
        return f"TorchFunction({self.function}, by {way})"

    def __call__(self, *arguments: Tensor) -> Tensor | tuple[Tensor, ...]:
        """Values at the arguments; leading shapes broadcast.

        Raises
        ------
        InputError
            The number of arguments is wrong, one is no floating-point tensor or has the wrong shape, or their types,
            devices or batches do not agree.
        """
        columns = self._columns(arguments)
        out = self._by_torch(columns) if self.translated else self._by_casadi(columns)
        return out[0] if len(out) == 1 else tuple(out)

    def _columns(self, arguments: tuple[Tensor, ...]) -> list[Tensor]:
        """Inputs as (..., entries) each, in CasADi's column order."""
        f = self.function
        names = f.name_in()
        if len(arguments) != f.n_in():
            expected = f"{f.n_in()} tensors: {', '.join(names)}"
            raise InputError("arguments", f"{len(arguments)} of them", expected)
        columns = []
        for i, value in enumerate(arguments):
            rows, width = f.size_in(i)
            shape = (rows,) if width == 1 else (rows, width)
            if not torch.is_tensor(value) or not value.is_floating_point():
                got = f"a tensor of {value.dtype}" if torch.is_tensor(value) else shown(value)
                raise InputError(names[i], got, "a floating-point tensor")
            if tuple(value.shape[max(0, value.ndim - len(shape)) :]) != shape:
                got = f"shape {tuple(value.shape)}"
                raise InputError(names[i], got, f"(..., {', '.join(map(str, shape))})")
            columns.append(value if width == 1 else value.mT.flatten(-2))
        kinds = {(value.dtype, value.device) for value in columns}
        if len(kinds) > 1:
            raise InputError("arguments", " and ".join(sorted(f"{d} on {v}" for d, v in kinds)), "one type and device")
        try:
            torch.broadcast_shapes(*(value.shape[:-1] for value in columns))
        except RuntimeError as error:
            got = " and ".join(str(tuple(value.shape[:-1])) for value in columns)
            raise InputError("arguments", f"batches of shape {got}", "leading shapes that broadcast") from error
        return columns

    def _by_torch(self, columns: list[Tensor]) -> list[Tensor]:
        """Outputs by torch operations."""
        assert self._tape is not None
        f = self.function
        like = columns[0] if columns else torch.zeros((), dtype=torch.float64)
        batch = torch.broadcast_shapes(*(value.shape[:-1] for value in columns))
        # each entry contiguous: a strided one costs every operation on it
        whole = [value.movedim(-1, 0).contiguous().unbind(0) for value in columns]
        entries = [[own[k] for k in f.sparsity_in(i).find()] for i, own in enumerate(whole)]
        outputs = []
        for i, nonzeros in enumerate(self._tape.run(entries, torch_operations(like.dtype))):
            full: list[Any] = [0.0] * f.numel_out(i)
            for k, value in zip(f.sparsity_out(i).find(), nonzeros):
                full[k] = value
            values = [v if torch.is_tensor(v) else like.new_tensor(v) for v in full]
            flat = torch.stack([v.expand(batch) for v in values], -1) if values else like.new_zeros((*batch, 0))
            outputs.append(_shaped(flat, f.size_out(i)))
        return outputs

    def _by_casadi(self, columns: list[Tensor]) -> list[Tensor]:
        """Outputs by CasADi's own evaluation."""
        f = self.function
        batch = torch.broadcast_shapes(*(value.shape[:-1] for value in columns))
        flat = [value.expand(*batch, value.shape[-1]).reshape(batch.numel(), value.shape[-1]) for value in columns]
        outputs = _Called.apply(f, *flat)
        return [_shaped(out.unflatten(0, batch) if batch else out[0], f.size_out(i)) for i, out in enumerate(outputs)]


def _shaped(flat: Tensor, size: tuple[int, int]) -> Tensor:
    """Entries (..., rows · columns), by columns, as (..., rows) or (..., rows, columns)."""
    rows, columns = size
    return flat if columns == 1 else flat.unflatten(-1, (columns, rows)).mT


class _Called(torch.autograd.Function):
    """CasADi function at every row of its inputs (n, entries)."""

    @staticmethod
    def forward(ctx: Any, f: ca.Function, *columns: Tensor) -> tuple[Tensor, ...]:
        """Outputs (n, entries), by columns."""
        ctx.function = f
        points = [value.detach().double().cpu().numpy() for value in columns]
        count = len(points[0]) if points else 1
        out = [np.empty((count, f.numel_out(i))) for i in range(f.n_out())]
        for k in range(count):
            values = f.call([ca.reshape(ca.DM(own[k]), f.size_in(i)) for i, own in enumerate(points)])
            for i, value in enumerate(values):
                out[i][k] = np.asarray(ca.densify(value)).ravel(order="F")
        outputs = tuple(columns[0].new_tensor(own) if columns else torch.as_tensor(own) for own in out)
        ctx.save_for_backward(*columns, *outputs)
        return outputs

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Reverse derivative, itself differentiable."""
        return None, *_Called.apply(ctx.function.reverse(1), *ctx.saved_tensors, *gradients)
