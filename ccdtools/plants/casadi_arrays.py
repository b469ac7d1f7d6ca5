"""CasADi functions on batches of arrays or tensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from ccdtools.exceptions import InputError
from ccdtools.plants.casadi_operations import KNOWN, Operations, into_room, numpy_operations, torch_operations
from ccdtools.plants.symbols import as_expression, check_known
from ccdtools_ground.door import brief, shown
from ccdtools_ground.user_functions import stopped

if TYPE_CHECKING:
    from ccdtools.arrays import Array

Sizes = tuple[int, ...]


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
        out: list[list[Any]] = [[constant(0.0)] * self.function.nnz_out(i) for i in range(self.function.n_out())]
        _carry_out(self.instructions, entries, operations, constant, out)
        return out

    def to_dict(self) -> dict[str, Any]:
        """Function of columns as plain values, for `function_of`."""
        names = {getattr(ca, name): name for name in dir(ca) if name.startswith("OP_")}
        f = self.function
        return {
            "arguments": [f.numel_in(i) for i in range(f.n_in())], "values": [f.nnz_out(i) for i in range(f.n_out())],
            "instructions": [[names[op], *rest] for op, *rest in self.instructions],
        }  # fmt: skip

    def lines(
        self, names: Sequence[str], texts: dict[int, str], line: str, constant: Callable[[float], str]
    ) -> tuple[list[str], list[list[str]]]:
        """Source text, a line an operation, and names of the outputs.

        Parameters
        ----------
        names : sequence of str
            Each argument's entry, with a place for its number, such as "x[{}]".
        texts : dict of str
            Operations, with a place for each operand.
        line : str
            An assignment, with places for name and value.
        constant : callable
            Text of a number.
        """
        entries = [
            [name.format(j) for j in range(self.function.numel_in(i))]
            for i, name in zip(range(self.function.n_in()), names)
        ]
        written: list[str] = []

        def put(text: str, *operands: str) -> str:
            """Name of a new line's value."""
            name = f"v{len(written)}"
            written.append(line.format(name, text.format(*operands)))
            return name

        operations: Operations = {op: partial(put, text) for op, text in texts.items()}
        return written, self.run(entries, operations, lambda number: f"({constant(number)})")

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
        room = np.empty((self.function.sz_w(), runs))
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
                calls.append((into_room(op), (*(value[i] for i in inputs), room[outputs[0]])))
                value[outputs[0]] = room[outputs[0]]

        def run() -> None:
            """Carry out the instructions."""
            with np.errstate(all="ignore"):
                for call, operands in calls:
                    call(*operands)

        return out, run


def _carry_out(
    instructions: Sequence[tuple[int, Sequence[int], Sequence[int], float]], entries: Sequence[Sequence[Any]],
    operations: Operations, constant: Callable[[float], Any], out: list[list[Any]],
) -> None:  # fmt: skip
    """Write the nonzeros of each output to `out`."""
    work: dict[int, Any] = {}
    for op, inputs, outputs, number in instructions:
        if op == ca.OP_INPUT:
            work[outputs[0]] = entries[inputs[0]][inputs[1]]
        elif op == ca.OP_OUTPUT:
            out[outputs[0]][outputs[1]] = work[inputs[0]]
        elif op == ca.OP_CONST:
            work[outputs[0]] = constant(number)
        else:
            work[outputs[0]] = operations[op](*(work[i] for i in inputs))


def function_of(values: dict[str, Any]) -> ca.Function:
    """Function of columns from its plain values.

    Nothing of a file but arithmetic is carried out.

    Raises
    ------
    KeyError, IndexError, TypeError, ValueError
        If they are not what `Vectorised.to_dict` gives.
    """
    instructions = [(getattr(ca, str(name), None), *rest) for name, *rest in values["instructions"]]
    arguments = [ca.SX.sym(f"v{i}", size) for i, size in enumerate(values["arguments"])]
    operations: Operations = {op: partial((ca.SX.unary, ca.SX.binary)[len(inputs) - 1], op)
                              for op, inputs, *_ in instructions if op in KNOWN and inputs}  # fmt: skip
    out = [[ca.SX(0)] * size for size in values["values"]]
    _carry_out(instructions, [ca.vertsplit(column) for column in arguments], operations, ca.SX, out)
    return ca.Function("read", arguments, [ca.vertcat(*entries) for entries in out])


def check_sizes(sizes: Sequence[int], arguments: Sequence[Any]) -> None:
    """Raise an `InputError` unless x, u, w and p have these last axes."""
    for name, size, value in zip("xuwp", sizes, arguments):
        if len(value.shape) == 0 or value.shape[-1] != size:
            raise InputError(name, f"shape {tuple(value.shape)}", f"(..., {size})")


class SymbolicFunction:
    """Function of CasADi columns, for arrays and tensors of any batch.

    What is pickled are its expressions for the sizes that it was used with, so that a lambda is no obstacle.

    Parameters
    ----------
    argument : str
        What an error calls it.
    given : callable
        On CasADi SX columns: a Python function, or a `casadi.Function`.
    names : tuple of str
        Of its arguments.
    """

    def __init__(self, argument: str, given: Any, names: tuple[str, ...]) -> None:
        self.argument = argument
        self.names = names
        self._given = given
        self._functions: dict[Sizes, ca.Function] = {}
        self._compiled: dict[Sizes, Vectorised] = {}
        self._at_rest: dict[tuple[str, Sizes], ca.Function] = {}

    def function(self, *sizes: int) -> ca.Function:
        """`casadi.Function` of columns of these sizes.

        Raises
        ------
        InputError
            If it cannot be evaluated on them, or gives no expression of them alone.
        """
        if sizes not in self._functions:
            self._functions[sizes] = self._made(sizes)
        return self._functions[sizes]

    def scalar(self, *sizes: int) -> Vectorised:
        """Function with one value (..., 1) on arrays or tensors (..., size).

        Raises
        ------
        InputError
            Besides, if it has more than one value.
        """
        function = self.function(*sizes)
        if function.numel_out(0) != 1:
            raise InputError(self.argument, f"{function.numel_out(0)} values", "one, a scalar expression")
        return self.vector(*sizes)

    def vector(self, *sizes: int) -> Vectorised:
        """Function with values (..., m) on arrays or tensors (..., size)."""
        if sizes not in self._compiled:
            self._compiled[sizes] = Vectorised(self.function(*sizes), self.argument)
        return self._compiled[sizes]

    def depends(self, *sizes: int) -> bool:
        """Whether it depends on any of its arguments."""
        function = self.function(*sizes)
        columns = [ca.SX.sym(name, size) for name, size in zip(self.names, sizes)]
        return bool(ca.depends_on(ca.simplify(function(*columns)), ca.vertcat(*columns)))

    @property
    def values(self) -> int:
        """Number of values, for the sizes used first."""
        return next(iter(self._functions.values())).numel_out(0)

    def hessian(self, *sizes: int) -> ca.Function:
        """Hessian at 0 by all arguments but the last, a function of the last."""
        return self._derived("hessian", sizes, lambda value, free: [ca.hessian(value, free)[0]])

    def linear(self, *sizes: int) -> ca.Function:
        """Value and Jacobian at 0 by all arguments but the last, a function of the last."""
        return self._derived("linear", sizes, lambda value, free: [value, ca.jacobian(value, free)])

    def _derived(self, name: str, sizes: Sizes, make: Callable[[ca.SX, ca.SX], list[ca.SX]]) -> ca.Function:
        """Derivatives at rest, as a function of the last argument."""
        if (name, sizes) not in self._at_rest:
            columns = [ca.SX.sym(name, size) for name, size in zip(self.names, sizes)]
            free = ca.vertcat(*columns[:-1])
            parts = make(self.function(*sizes)(*columns), free)
            at_rest = [ca.substitute(ca.densify(part), free, ca.SX.zeros(free.shape)) for part in parts]
            self._at_rest[name, sizes] = ca.Function(name, [columns[-1]], at_rest)
        return self._at_rest[name, sizes]

    def _made(self, sizes: Sizes) -> ca.Function:
        """The function for new sizes."""
        columns = [ca.SX.sym(name, size) for name, size in zip(self.names, sizes)]
        expected = f"a function of {', '.join(self.names)} that returns a CasADi expression"
        if self._given is None:
            known = " or ".join(map(str, self._functions))
            raise InputError(self.argument, f"sizes {sizes}", f"{known}, those that it was stored with")
        try:
            value = self._given(*columns)
        except Exception as error:
            raise stopped(self.argument, self._given, error, expected) from error
        expression = ca.vec(as_expression(self.argument, value))
        check_known(self.argument, expression, **dict(zip(self.names, columns)))
        return ca.Function(self.argument, columns, [expression], list(self.names), ["value"])

    def __str__(self) -> str:
        """The expression, for the sizes used first."""
        for function in self._functions.values():
            columns = [ca.SX.sym(name, function.numel_in(i)) for i, name in enumerate(self.names)]
            text = " ".join(str(function(*columns)).split())
            return brief(text, 200)  # characters
        return f"{self.argument}({', '.join(self.names)})"

    def serialized(self) -> dict[str, str]:
        """Expressions of the function as text, by sizes."""
        return {str(sizes): function.serialize() for sizes, function in self._functions.items()}

    def as_given(self) -> tuple[Any, ...]:
        """Function as it was given, whatever sizes it was used with."""
        return self.argument, self.names, self._given or self.serialized()

    def __getstate__(self) -> dict[str, Any]:
        given = self._given if isinstance(self._given, ca.Function) or not self._functions else None
        return {"argument": self.argument, "names": self.names, "functions": self._functions, "given": given}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["argument"], state["given"], state["names"])  # type: ignore[misc]
        self._functions = dict(state["functions"])


def as_symbolic(argument: str, value: Any, names: tuple[str, ...]) -> SymbolicFunction:
    """`value` as a function of these CasADi columns.

    Raises
    ------
    InputError
        If it is not callable, or a `casadi.Function` with another number of arguments.
    """
    if isinstance(value, SymbolicFunction):
        return value
    expected = f"a function of {', '.join(names)} on CasADi columns"
    if not callable(value) or isinstance(value, type):
        raise InputError(argument, shown(value), expected, "Such as lambda p: 3 * p[0] + p[1] ** 2.")
    if isinstance(value, ca.Function) and (value.n_in() != len(names) or value.n_out() != 1):
        raise InputError(argument, f"{value.n_in()} arguments and {value.n_out()} results", f"{expected}, one result")
    return SymbolicFunction(argument, value, names)
