"""CasADi functions from a user's, read by argument names."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from math import isnan
from typing import Any

import casadi as ca

from ccdtools_ground.door import brief as brief
from ccdtools_ground.user_functions import stopped
from mpc.exceptions import InputError

Statement = Callable[..., Any]


def compiled(argument: str, given: Any, sizes: dict[str, int], rows: int | None = None) -> ca.Function:
    """Function of columns from a Python function or a `casadi.Function`.

    Its arguments are named after what it gets of the columns in `sizes`, in any order; those of a `casadi.Function`
    without names (i0, i1, …) are the first of them. The result takes all columns and returns a value (rows, 1), dense;
    its instructions are scalar (SX) where CasADi can make them so. An error calls it `argument`.

    Raises
    ------
    InputError
        If it asks for another name, stops, or returns no expression of these columns alone with so many rows.
    """
    own = wanted(argument, given, tuple(sizes))
    try:
        return _traced(argument, given, own, sizes, rows, ca.SX)
    except InputError as first:
        if first.__cause__ is None:  # the function itself ran
            raise
        try:
            return _traced(argument, given, own, sizes, rows, ca.MX)  # interpolants, integrators and the like
        except InputError:
            raise first from first.__cause__


def _traced(argument: str, given: Any, own: tuple[str, ...], sizes: dict[str, int], rows: int | None,
            kind: Any) -> ca.Function:  # fmt: skip
    """Function as `compiled` returns it, in `casadi.SX` or `casadi.MX`."""
    columns = {name: kind.sym(name, size) for name, size in sizes.items()}
    told = ", ".join(f"{name} ({size} rows)" if size > 1 else name for name, size in sizes.items() if size)
    expected = f"a function of {told} (any of them) that returns a CasADi expression"
    arguments = [columns[name] for name in own]
    if not isinstance(given, ca.Function):
        arguments = [_Named(name) if column.is_empty() else column for name, column in zip(own, arguments)]
    try:
        value = given(*arguments)
    except InputError:
        raise
    except Exception as error:  # the function is the user's: whatever it raises is told with what is expected
        raise stopped(argument, given, error, expected) from error
    try:
        parts = list(value) if isinstance(value, list | tuple) else [value]
        expression = ca.densify(ca.vertcat(kind(0, 1), *(ca.vec(kind(part)) for part in parts)))
    except Exception as error:
        raise InputError(argument, f"one that returns {brief(repr(value))}", expected) from error
    missing = [name for name in own if not sizes[name]]
    cure = f"There is no {missing[0]} in this problem." if missing else ""
    if rows is not None and expression.numel() != rows:
        raise InputError(argument, f"{expression.numel()} rows", f"{rows}, a column ({rows}, 1)", cure)
    if not expression.numel():
        raise InputError(argument, "one that returns nothing", expected, cure)
    if rows is None and any(ca.OP_LT <= one.op() <= ca.OP_OR for one in ca.vertsplit(expression)):
        raise InputError(argument, "a comparison", "values: limits are stated as g ≤ 0 or g = 0, such as x[0] - 1")
    named = list(columns.values()), [expression], list(sizes), ["value"]
    function = ca.Function(argument, *named, {"allow_free": True})
    if function.has_free():
        got = f"an expression of {', '.join(function.get_free()[:5])} besides"
        raise InputError(argument, got, f"an expression of {', '.join(sizes)} alone")
    scalar = range(function.n_instructions() if function.is_a("SXFunction") else 0)
    constants = [i for i in scalar if function.instruction_id(i) == ca.OP_CONST]
    if any(isnan(function.instruction_constant(i)) for i in constants):
        cure = "float(), math.sin and the like of a symbol are no number: use ca.sin and the like."
        raise InputError(argument, "an expression with a constant that is NaN", expected, cure)
    return function


def slopes_of(function: ca.Function) -> ca.Function:
    """Derivatives, column by column, of a function of x, u, … by x and u."""
    columns = list(symbols_of(function).values())
    slopes = ca.jacobian(function(*columns), ca.vertcat(*columns[:2]))
    return ca.Function("slopes", columns, [ca.vec(ca.densify(slopes))])


def symbols_of(function: ca.Function) -> dict[str, Any]:
    """Symbols by name for the arguments of a function, SX or MX."""
    kind: Any = ca.SX if function.is_a("SXFunction") else ca.MX
    return {name: kind.sym(name, function.numel_in(i)) for i, name in enumerate(function.name_in())}


class _Named:
    """Placeholder of a missing column; any use raises with its name."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        raise AttributeError(f"there is no {self._name} in this problem")

    def _used(self, *_: Any) -> Any:
        raise IndexError(f"there is no {self._name} in this problem")

    __getitem__ = __pos__ = __neg__ = __abs__ = __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = _used
    __truediv__ = __rtruediv__ = __pow__ = __rpow__ = __matmul__ = __rmatmul__ = _used


def wanted(argument: str, given: Any, names: tuple[str, ...]) -> tuple[str, ...]:
    """Columns that a function asks for, in its order."""
    expected = f"a function whose arguments are named after what it needs of {', '.join(names)}"
    if isinstance(given, ca.Function):
        if given.n_out() != 1:
            raise InputError(argument, f"a casadi.Function with {given.n_out()} results", "one result")
        own = tuple(given.name_in())
        if all(name == f"i{k}" for k, name in enumerate(own)):
            own = names[: given.n_in()]
    elif callable(given) and not isinstance(given, type):
        taken = inspect.signature(given).parameters.values()
        own = tuple(one.name for one in taken if one.name in names or one.default is one.empty)
    else:
        raise InputError(argument, brief(repr(given)), expected)
    strange = [name for name in own if name not in names]
    if strange:
        raise InputError(argument, f"an argument named {strange[0]!r}", expected)
    return own
