"""CasADi functions on batches of arrays or tensors."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, TypeAlias

import casadi as ca
import numpy as np

from ccdtools.exceptions import InputError

if TYPE_CHECKING:
    from ccdtools.arrays import Array

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


class Vectorised:
    """CasADi function of scalar instructions, for batches of arrays, tensors or expressions.

    A batch of thousands costs little more than one point, and torch tensors keep their gradient.

    Parameters
    ----------
    function : casadi.Function
        SX function, or one that CasADi can expand into scalar instructions. To be called it needs one output, and dense
        vectors in and out.
    argument : str
        What an error calls it.

    Attributes
    ----------
    instructions : list of (operation, places of its inputs, places of its outputs, number that a constant is)

    Raises
    ------
    InputError
        If the function cannot be expanded, or has an operation without an array counterpart.
    """

    def __init__(self, function: ca.Function, argument: str = "dynamics") -> None:
        if not function.is_a("SXFunction"):
            try:
                function = function.expand()
            except RuntimeError as error:
                raise InputError(
                    argument, f"{function.name()}, which has no scalar instructions", "an SX function",
                    "It calls an integrator, a solver or an external function.",
                ) from error  # fmt: skip
        steps = range(function.n_instructions())
        unknown = sorted({function.instruction_id(k) for k in steps} - KNOWN)
        if unknown:
            names = [name for name in dir(ca) if name.startswith("OP_") and getattr(ca, name) in unknown]
            raise InputError(
                argument, f"the CasADi operations {', '.join(names) or unknown}, which arrays do not have",
                "arithmetic, powers, exp, log, sqrt, erf, trigonometric and hyperbolic functions, abs, sign, min, max",
                "It has operations without an array counterpart.",
            )  # fmt: skip
        self.function = function
        self._work_size = function.sz_w()
        self.instructions = [self._instruction(k) for k in steps]

    def _instruction(self, k: int) -> tuple[int, tuple[int, ...], tuple[int, ...], float]:
        """Operation, places of inputs and outputs, and value of a constant."""
        f = self.function
        op = f.instruction_id(k)
        number = float(f.instruction_constant(k)) if op == ca.OP_CONST else 0.0
        return op, tuple(f.instruction_input(k)), tuple(f.instruction_output(k)), number

    def run(
        self, entries: Sequence[Sequence[Any]], operations: Operations, constant: Callable[[float], Any] = float
    ) -> list[list[Any]]:
        """Nonzeros of each output from those of each input; `constant` converts numbers."""
        work: list[Any] = [0.0] * self._work_size
        out: list[list[Any]] = [[constant(0.0)] * self.function.nnz_out(i) for i in range(self.function.n_out())]
        for op, inputs, outputs, number in self.instructions:
            if op == ca.OP_INPUT:
                work[outputs[0]] = entries[inputs[0]][inputs[1]]
            elif op == ca.OP_OUTPUT:
                out[outputs[0]][outputs[1]] = work[inputs[0]]
            elif op == ca.OP_CONST:
                work[outputs[0]] = constant(number)
            elif len(inputs) == 1:
                work[outputs[0]] = operations[op](work[inputs[0]])
            else:
                work[outputs[0]] = operations[op](work[inputs[0]], work[inputs[1]])
        return out

    def __call__(self, *arguments: Any) -> Any:
        """Values (..., n_out) at arguments (..., n_i); leading shapes broadcast."""
        shape = np.broadcast_shapes(*(tuple(a.shape[:-1]) for a in arguments))
        entries = [[a[..., i] for i in range(a.shape[-1])] for a in arguments]
        if all(isinstance(a, np.ndarray) for a in arguments):  # torch is then never imported
            with np.errstate(all="ignore"):
                out = self.run(entries, numpy_operations())[0]
            return np.stack([np.broadcast_to(o, shape) for o in out], axis=-1)
        import torch

        like = next(a for a in arguments if torch.is_tensor(a))
        out = self.run(entries, torch_operations(like.dtype))[0]
        return torch.stack([torch.as_tensor(o, dtype=like.dtype, device=like.device).expand(shape) for o in out], -1)

    def in_place(self, arguments: Sequence[Array]) -> tuple[Array, Callable[[], None]]:
        """Values (n_out, n), and a function that computes them anew in place.

        Two to three times as fast as operations that return new arrays.

        Parameters
        ----------
        arguments : sequence of (n_i, n) or (n_i,) arrays
            A row for every entry, or one number for all of the n runs. They are looked up at every call.
        """
        runs = next(a.shape[1] for a in arguments if a.ndim == 2)
        out = np.empty((self.function.numel_out(0), runs))
        room = np.empty((self._work_size, runs))
        value: list[Any] = [0.0] * len(room)
        calls: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []
        for op, inputs, outputs, number in self.instructions:
            if op == ca.OP_INPUT:
                value[outputs[0]] = arguments[inputs[0]][inputs[1]]
            elif op == ca.OP_CONST:
                value[outputs[0]] = number
            elif op == ca.OP_OUTPUT:
                calls.append((np.copyto, (out[outputs[1]], value[inputs[0]])))
            else:
                calls.append((_into_room(op), (*(value[i] for i in inputs), room[outputs[0]])))
                value[outputs[0]] = room[outputs[0]]

        def run() -> None:
            """Carry out the instructions."""
            with np.errstate(all="ignore"):
                for call, operands in calls:
                    call(*operands)

        return out, run


def check_sizes(sizes: Sequence[int], arguments: Sequence[Any]) -> None:
    """Raise an `InputError` unless x, u, w and p have these last axes."""
    for name, size, value in zip("xuwp", sizes, arguments):
        if len(value.shape) == 0 or value.shape[-1] != size:
            raise InputError(name, f"shape {tuple(value.shape)}", f"(..., {size})")


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
    infix = {
        ca.OP_ADD: "+", ca.OP_SUB: "-", ca.OP_MUL: "*", ca.OP_DIV: "/", ca.OP_POW: "**", ca.OP_CONSTPOW: "**",
    }  # fmt: skip
    truths = {
        ca.OP_LT: "{} < {}", ca.OP_LE: "{} <= {}", ca.OP_EQ: "{} == {}", ca.OP_NE: "{} != {}", ca.OP_NOT: "{} == 0",
        ca.OP_AND: "({} != 0) & ({} != 0)", ca.OP_OR: "({} != 0) | ({} != 0)",
    }  # fmt: skip
    table = {op: f"{{}} {sign} {{}}" for op, sign in infix.items()}
    table |= {op: f"1.0 if {test} else 0.0" for op, test in truths.items()}
    table |= {op: f"np.{name}({{}})" for op, name in _UNARY.items()}
    table |= {op: f"np.{name}({{}}, {{}})" for op, name in _BINARY.items()}
    return table | {
        ca.OP_NEG: "-{}", ca.OP_TWICE: "{0} + {0}", ca.OP_SQ: "{0} * {0}", ca.OP_INV: "1.0 / {}", ca.OP_ASSIGN: "{}",
        ca.OP_LIFT: "{}", ca.OP_REMAINDER: "{0} - {1} * np.rint({0} / {1})",
        ca.OP_IF_ELSE_ZERO: "{1} if {0} != 0 else 0.0",
    }  # fmt: skip


def can_be_compiled(function: ca.Function) -> bool:
    """Whether every operation of a function has a text."""
    moved = (ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT)
    return all(op in moved or op in texts_of_operations() for op, *_ in Vectorised(function).instructions)


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
def _into_room(op: int) -> Callable[..., Any]:
    """(operands, out) → an operation that writes to `out`."""
    if op in _IN_PLACE:
        return _IN_PLACE[op]
    plain = numpy_operations()[op]
    return plain if isinstance(plain, np.ufunc) else lambda *operands: np.copyto(operands[-1], plain(*operands[:-1]))
