"""User's functions of CasADi columns, compiled and checked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca

from ccdtools.exceptions import InputError
from ccdtools.plants.casadi_arrays import Vectorised
from ccdtools.plants.symbols import as_expression, check_known
from ccdtools_ground.door import brief, shown
from ccdtools_ground.user_functions import stopped

Sizes = tuple[int, ...]


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
            self._compiled[sizes] = Vectorised(self.function(*sizes))
        return self._compiled[sizes]

    def depends(self, *sizes: int) -> bool:
        """Whether it depends on any of its arguments."""
        function = self.function(*sizes)
        columns = [_column(name, size) for name, size in zip(self.names, sizes)]
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
            columns = [_column(name, size) for name, size in zip(self.names, sizes)]
            free = ca.vertcat(*columns[:-1])
            parts = make(self.function(*sizes)(*columns), free)
            at_rest = [ca.substitute(ca.densify(part), free, ca.SX.zeros(free.shape)) for part in parts]
            self._at_rest[name, sizes] = ca.Function(name, [columns[-1]], at_rest)
        return self._at_rest[name, sizes]

    def _made(self, sizes: Sizes) -> ca.Function:
        """The function for new sizes."""
        columns = [_column(name, size) for name, size in zip(self.names, sizes)]
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
            columns = [_column(name, function.numel_in(i)) for i, name in enumerate(self.names)]
            text = " ".join(str(function(*columns)).split())
            return brief(text, 200)  # characters
        return f"{self.argument}({', '.join(self.names)})"

    def serialized(self) -> dict[str, str]:
        """Expressions of the function as text, by sizes."""
        return {str(sizes): function.serialize() for sizes, function in self._functions.items()}

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


def _column(name: str, size: int) -> ca.SX:
    """Symbols (size, 1)."""
    return ca.SX.sym(name, size) if size else ca.SX(0, 1)
