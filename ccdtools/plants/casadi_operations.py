"""Operations of CasADi on arrays, on tensors, and as text."""

from __future__ import annotations

import operator
from collections.abc import Callable
from functools import cache
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

Operations: TypeAlias = dict[int, Callable[..., Any]]

_ARITHMETIC: Operations = {
    ca.OP_ADD: operator.add, ca.OP_SUB: operator.sub, ca.OP_MUL: operator.mul, ca.OP_DIV: operator.truediv,
    ca.OP_POW: operator.pow, ca.OP_CONSTPOW: operator.pow, ca.OP_NEG: operator.neg,
    ca.OP_TWICE: lambda a: a + a, ca.OP_SQ: lambda a: a * a, ca.OP_INV: lambda a: 1.0 / a,
    ca.OP_ASSIGN: lambda a: a, ca.OP_LIFT: lambda a, guess: a,
}  # fmt: skip
_LOGIC: Operations = {
    ca.OP_LT: operator.lt, ca.OP_LE: operator.le, ca.OP_EQ: operator.eq, ca.OP_NE: operator.ne,
    ca.OP_AND: lambda a, b: (a != 0) & (b != 0), ca.OP_OR: lambda a, b: (a != 0) | (b != 0),
    ca.OP_NOT: lambda a: a == 0,
}  # fmt: skip
_UNARY = {
    ca.OP_EXP: "exp", ca.OP_LOG: "log", ca.OP_SQRT: "sqrt", ca.OP_SIN: "sin", ca.OP_COS: "cos", ca.OP_TAN: "tan",
    ca.OP_ASIN: "arcsin", ca.OP_ACOS: "arccos", ca.OP_ATAN: "arctan", ca.OP_SINH: "sinh", ca.OP_COSH: "cosh",
    ca.OP_TANH: "tanh", ca.OP_ASINH: "arcsinh", ca.OP_ACOSH: "arccosh", ca.OP_ATANH: "arctanh", ca.OP_FABS: "abs",
    ca.OP_SIGN: "sign", ca.OP_FLOOR: "floor", ca.OP_CEIL: "ceil", ca.OP_LOG1P: "log1p", ca.OP_EXPM1: "expm1",
}  # fmt: skip
_SPECIAL = {ca.OP_ERF: "erf", ca.OP_ERFINV: "erfinv"}
_BINARY = {
    ca.OP_FMIN: "fmin", ca.OP_FMAX: "fmax", ca.OP_ATAN2: "arctan2", ca.OP_HYPOT: "hypot", ca.OP_COPYSIGN: "copysign",
    ca.OP_FMOD: "fmod",
}  # fmt: skip
_IN_PLACE: Operations = {
    ca.OP_ADD: np.add, ca.OP_SUB: np.subtract, ca.OP_MUL: np.multiply, ca.OP_DIV: np.divide, ca.OP_NEG: np.negative,
    ca.OP_SQ: np.square, ca.OP_TWICE: lambda a, out: np.add(a, a, out),
    ca.OP_INV: lambda a, out: np.divide(1.0, a, out),
}  # fmt: skip
KNOWN = {
    ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_REMAINDER, ca.OP_IF_ELSE_ZERO,
    *_ARITHMETIC, *_LOGIC, *_UNARY, *_SPECIAL, *_BINARY,
}  # fmt: skip


@cache
def numpy_operations() -> Operations:
    """CasADi operations on NumPy arrays."""
    from scipy import special

    table: Operations = {op: _returning(float, call) for op, call in _LOGIC.items()}
    table |= _ARITHMETIC
    table |= {op: getattr(np, name) for op, name in {**_UNARY, **_BINARY}.items()}
    table |= {op: getattr(special, name) for op, name in _SPECIAL.items()}
    table[ca.OP_REMAINDER] = lambda a, b: a - b * np.rint(a / b)
    # selected, not multiplied, so that an unused inf or NaN vanishes
    table[ca.OP_IF_ELSE_ZERO] = lambda condition, a: np.where(np.asarray(condition) != 0, a, 0.0)
    return table


@cache
def texts_of_operations() -> dict[int, str]:
    """CasADi operations on numbers, as Python text that Numba compiles."""
    table = _texts("{1} if {0} else {2}", "1.0", "0.0")
    table |= {op: f"np.{name}({{}})" for op, name in _UNARY.items()}
    table |= {op: f"np.{name}({{}}, {{}})" for op, name in _BINARY.items()}
    return table | {
        ca.OP_POW: "{} ** {}", ca.OP_CONSTPOW: "{} ** {}", ca.OP_REMAINDER: "{0} - {1} * np.rint({0} / {1})",
    }  # fmt: skip


@cache
def c_operations(scalar: str) -> dict[int, str]:
    """CasADi operations on numbers of a type, as C99 text."""
    suffix = "f" if scalar == "float" else ""
    names = {getattr(ca, name): name.removeprefix("OP_").lower() for name in dir(ca) if name.startswith("OP_")}
    names[ca.OP_CONSTPOW] = names[ca.OP_POW]
    table = _texts("{0} ? {1} : {2}", "1", "0")
    table |= {op: f"{names[op]}{suffix}({{}})" for op in (*_UNARY, ca.OP_ERF)}
    table |= {op: f"{names[op]}{suffix}({{}}, {{}})" for op in (*_BINARY, ca.OP_POW, ca.OP_CONSTPOW, ca.OP_REMAINDER)}
    return table | {ca.OP_SIGN: "(real)(({0} > 0) - ({0} < 0))"}


def _texts(chosen: str, one: str, zero: str) -> dict[int, str]:
    """Arithmetic and logic as text, with a language's choice."""
    infix = {ca.OP_ADD: "+", ca.OP_SUB: "-", ca.OP_MUL: "*", ca.OP_DIV: "/"}
    truths = {
        ca.OP_LT: "{} < {}", ca.OP_LE: "{} <= {}", ca.OP_EQ: "{} == {}", ca.OP_NE: "{} != {}", ca.OP_NOT: "{} == 0",
        ca.OP_AND: "({} != 0) & ({} != 0)", ca.OP_OR: "({} != 0) | ({} != 0)",
    }  # fmt: skip
    table = {op: f"{{}} {sign} {{}}" for op, sign in infix.items()}
    table |= {op: chosen.format(test, one, zero) for op, test in truths.items()}
    return table | {
        ca.OP_NEG: "-{}", ca.OP_TWICE: "{0} + {0}", ca.OP_SQ: "{0} * {0}", ca.OP_INV: f"{one} / {{}}",
        ca.OP_ASSIGN: "{}", ca.OP_LIFT: "{}", ca.OP_IF_ELSE_ZERO: chosen.format("{0} != 0", "{1}", zero),
    }  # fmt: skip


@cache
def torch_operations(dtype: Any) -> Operations:
    """CasADi operations on torch tensors of one type and numbers."""
    import torch

    def together(call: Callable[..., Any]) -> Callable[..., Any]:
        """Call with numbers made tensors, given at least one tensor."""

        def both(a: Any, b: Any) -> Any:
            like = a if torch.is_tensor(a) else b
            return call(*(v if torch.is_tensor(v) else like.new_tensor(v) for v in (a, b)))

        return both

    table: Operations = {op: _returning(dtype, call) for op, call in _LOGIC.items()}
    table |= _ARITHMETIC
    table |= {op: getattr(torch, name) for op, name in {**_UNARY, **_SPECIAL}.items()}
    table |= {op: together(getattr(torch, name)) for op, name in _BINARY.items()}
    table[ca.OP_REMAINDER] = lambda a, b: a - b * torch.round(a / b).detach()
    table[ca.OP_IF_ELSE_ZERO] = together(lambda condition, a: torch.where(condition != 0, a, a.new_zeros(())))
    return table


def _returning(kind: Any, call: Callable[..., Any]) -> Callable[..., Any]:
    """A comparison that returns 0.0 and 1.0."""
    if kind is float:
        return lambda *values: call(*values) * 1.0
    return lambda *values: call(*values).to(kind)


@cache
def into_room(op: int) -> Callable[..., Any]:
    """(operands, out) → an operation that writes to `out`."""
    if op in _IN_PLACE:
        return _IN_PLACE[op]
    plain = numpy_operations()[op]
    return plain if isinstance(plain, np.ufunc) else lambda *operands: np.copyto(operands[-1], plain(*operands[:-1]))
