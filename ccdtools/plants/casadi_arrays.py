"""CasADi functions on batches of NumPy arrays or torch tensors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.exceptions import InputError

_UNARY = {
    ca.OP_NEG: "negative", ca.OP_EXP: "exp", ca.OP_LOG: "log", ca.OP_SQRT: "sqrt", ca.OP_SQ: "square",
    ca.OP_SIN: "sin", ca.OP_COS: "cos", ca.OP_TAN: "tan", ca.OP_ASIN: "arcsin", ca.OP_ACOS: "arccos",
    ca.OP_ATAN: "arctan", ca.OP_SINH: "sinh", ca.OP_COSH: "cosh", ca.OP_TANH: "tanh", ca.OP_FABS: "abs",
    ca.OP_SIGN: "sign", ca.OP_FLOOR: "floor", ca.OP_CEIL: "ceil", ca.OP_INV: "reciprocal", ca.OP_ASINH: "arcsinh",
    ca.OP_ACOSH: "arccosh", ca.OP_ATANH: "arctanh", ca.OP_LOG1P: "log1p", ca.OP_EXPM1: "expm1",
}  # fmt: skip
_BINARY: dict[int, Callable[[Any, Any], Any]] = {
    ca.OP_ADD: lambda a, b: a + b,
    ca.OP_SUB: lambda a, b: a - b,
    ca.OP_MUL: lambda a, b: a * b,
    ca.OP_DIV: lambda a, b: a / b,
    ca.OP_POW: lambda a, b: a**b,
    ca.OP_CONSTPOW: lambda a, b: a**b,
}
_LOGIC: dict[int, Callable[[Any, Any], Any]] = {
    ca.OP_AND: lambda a, b: (a != 0) & (b != 0),
    ca.OP_OR: lambda a, b: (a != 0) | (b != 0),
}
_BINARY_NAMED = {
    ca.OP_FMIN: "minimum", ca.OP_FMAX: "maximum", ca.OP_ATAN2: "arctan2", ca.OP_HYPOT: "hypot",
    ca.OP_COPYSIGN: "copysign", ca.OP_FMOD: "fmod",
}  # fmt: skip
_ARITHMETIC = {ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_TWICE, ca.OP_NOT, ca.OP_IF_ELSE_ZERO, *_BINARY, *_LOGIC}
_COMPARE: dict[int, Callable[[Any, Any], Any]] = {
    ca.OP_LT: lambda a, b: a < b,
    ca.OP_LE: lambda a, b: a <= b,
    ca.OP_EQ: lambda a, b: a == b,
    ca.OP_NE: lambda a, b: a != b,
}


class Vectorised:
    """Evaluates an SX `casadi.Function` elementwise over a batch.

    Each instruction of the function's tape becomes one array operation, so a batch of thousands costs little
    more than one point, and torch tensors keep their gradient.

    Parameters
    ----------
    function : casadi.Function
        SX function with one output, dense vectors in and out.

    Raises
    ------
    InputError
        If the function uses an operation without an array counterpart.
    """

    def __init__(self, function: ca.Function) -> None:
        if not function.is_a("SXFunction"):
            function = function.expand()
        self.n_out = function.numel_out(0)
        self._tape = [
            (
                function.instruction_id(k),
                tuple(function.instruction_input(k)),
                tuple(function.instruction_output(k)),
                function.instruction_constant(k) if function.instruction_id(k) == ca.OP_CONST else 0.0,
            )
            for k in range(function.n_instructions())
        ]
        self._work_size = function.sz_w()
        known = {*_ARITHMETIC, *_UNARY, *_BINARY_NAMED, *_COMPARE}
        unknown = sorted({op for op, *_ in self._tape} - known)
        if unknown:
            names = [name for name in dir(ca) if name.startswith("OP_") and getattr(ca, name) in unknown]
            raise InputError(
                "dynamics", f"the CasADi operations {', '.join(names) or unknown}, which arrays do not have",
                "arithmetic, powers, exp, log, sqrt, trigonometric and hyperbolic functions, abs, sign, min and max",
            )  # fmt: skip

    def __call__(self, *arguments: Any) -> Any:
        """Values (..., n_out) at arguments of shape (..., n_i); leading shapes broadcast."""
        torch_module = _torch_of(arguments)
        xp: Any = torch_module or np
        like: Any = None if torch_module is None else next(a for a in arguments if torch_module.is_tensor(a))
        one: Any = 1.0 if like is None else like.new_ones(())  # of the arguments' precision, not torch's default
        work: list[Any] = [0.0] * self._work_size
        out: list[Any] = [0.0] * self.n_out
        with np.errstate(all="ignore"):
            for op, inputs, outputs, constant in self._tape:
                if op == ca.OP_CONST:
                    work[outputs[0]] = constant
                elif op == ca.OP_INPUT:
                    work[outputs[0]] = arguments[inputs[0]][..., inputs[1]]
                elif op == ca.OP_OUTPUT:
                    out[outputs[1]] = work[inputs[0]]
                elif op in _BINARY:
                    work[outputs[0]] = _BINARY[op](work[inputs[0]], work[inputs[1]])
                elif op == ca.OP_TWICE:
                    work[outputs[0]] = 2 * work[inputs[0]]
                elif op in _COMPARE:
                    work[outputs[0]] = _COMPARE[op](work[inputs[0]], work[inputs[1]]) * one
                elif op in _LOGIC:
                    work[outputs[0]] = _LOGIC[op](work[inputs[0]], work[inputs[1]]) * one
                elif op == ca.OP_NOT:
                    work[outputs[0]] = (work[inputs[0]] == 0) * one
                elif op == ca.OP_IF_ELSE_ZERO:
                    work[outputs[0]] = _if_else_zero(xp, work[inputs[0]], work[inputs[1]], like)
                else:
                    name = _UNARY.get(op) or _BINARY_NAMED[op]
                    values = [work[i] for i in inputs[: 1 if op in _UNARY else 2]]
                    if torch_module is not None:
                        values = [v if torch_module.is_tensor(v) else like.new_tensor(v) for v in values]
                    work[outputs[0]] = getattr(xp, name)(*values)
        shape = np.broadcast_shapes(*(tuple(a.shape[:-1]) for a in arguments))
        if torch_module is None:
            return np.stack([np.broadcast_to(o, shape) for o in out], axis=-1)
        return torch_module.stack(
            [torch_module.as_tensor(o, dtype=like.dtype, device=like.device).expand(shape) for o in out], dim=-1
        )


def _if_else_zero(xp: Any, condition: Any, value: Any, like: Any) -> Any:
    """`value` where `condition`, else 0: selected, not multiplied, so that an unused inf or NaN vanishes."""
    if xp is np:
        return np.where(np.asarray(condition) != 0, value, 0.0)
    condition, value = (v if xp.is_tensor(v) else like.new_tensor(v) for v in (condition, value))
    return xp.where(condition != 0, value, like.new_zeros(()))


def _torch_of(arguments: tuple[Any, ...]) -> Any:
    """The torch module if any argument is a tensor, else None (torch is then never imported)."""
    if all(isinstance(a, np.ndarray) for a in arguments):
        return None
    import torch

    return torch
