"""CasADi symbols and expressions, checked and pickled."""

from __future__ import annotations

from math import isnan
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from ccdtools.arrays import Immutable
from ccdtools.exceptions import InputError
from ccdtools_ground.door import shown


class Symbolic(Immutable):
    """Base of frozen dataclasses with expressions, copied and pickled with fresh symbols of the same names.

    Attributes
    ----------
    symbol_fields, expression_fields : tuples of str
        Fields that are columns of symbols, and those that are expressions in them.
    """

    symbol_fields: ClassVar[tuple[str, ...]]
    expression_fields: ClassVar[tuple[str, ...]]

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        columns = [state.pop(name) for name in self.symbol_fields]
        expressions = [state.pop(name) for name in self.expression_fields]
        names = [[symbol.name() for symbol in elements(column)] for column in columns]
        return state | {"columns": names, "function": ca.Function("packed", columns, expressions).serialize()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        columns = [ca.vertcat(*map(ca.SX.sym, names)) if names else ca.SX(0, 1) for names in state.pop("columns")]
        expressions = ca.Function.deserialize(state.pop("function")).call(columns)
        super().__setstate__(
            state | dict(zip(self.symbol_fields, columns)) | dict(zip(self.expression_fields, expressions))
        )


def as_symbols(argument: str, value: Any) -> ca.SX:
    """Column of SX symbols; None is an empty one."""
    if value is None:
        return ca.SX(0, 1)
    if not isinstance(value, ca.SX) or not (value.is_empty() or value.is_valid_input()):
        got = f"a {type(value).__name__} that is not symbolic" if isinstance(value, ca.SX) else shown(value)
        raise InputError(argument, got, "a casadi.SX symbol (SX.sym)")
    if value.is_empty():
        return ca.SX(0, 1)
    if value.shape[1] != 1:
        raise InputError(argument, f"shape {value.shape}", "a column of symbols (n, 1)")
    return value


def as_expression(argument: str, value: Any) -> ca.SX:
    """Dense SX expression; a list of scalars is stacked to a column."""
    try:
        with np.errstate(all="ignore"):
            expression = ca.vertcat(*value) if isinstance(value, list | tuple) else ca.SX(value)
            return ca.densify(ca.SX(expression))
    except (NotImplementedError, TypeError, ValueError, RuntimeError):
        raise InputError(argument, shown(value), "a casadi.SX expression, or a list of them") from None


def check_distinct(**symbols: ca.SX) -> None:
    """Raise an `InputError` if a symbol appears twice among the columns."""
    owner: dict[int, str] = {}
    for name, column in symbols.items():
        for symbol in elements(column):
            key = symbol.element_hash()
            if key in owner:
                raise InputError(
                    name, f"the symbol {symbol.name()} again, which is in {owner[key]}", "a symbol of its own"
                )
            owner[key] = name


def check_known(argument: str, expression: ca.SX, **symbols: ca.SX) -> None:
    """Raise an `InputError` if `expression` has symbols outside the columns."""
    known = {symbol.element_hash() for column in symbols.values() for symbol in elements(column)}
    foreign = [symbol.name() for symbol in ca.symvar(expression) if symbol.element_hash() not in known]
    if foreign:
        raise InputError(argument, f"unknown symbols {foreign}", f"only those of {', '.join(symbols)}")


def check_numbers(argument: str, expression: ca.SX) -> None:
    """Raise an `InputError` if `expression` has a NaN constant."""
    function = ca.Function("f", ca.symvar(expression), [expression])
    constants = (i for i in range(function.n_instructions()) if function.instruction_id(i) == ca.OP_CONST)
    if any(isnan(function.instruction_constant(i)) for i in constants):
        cure = "math.sin, float() and the like of a symbol are no number: use ca.sin and the like."
        raise InputError(argument, "an expression with a constant that is NaN", "numbers and symbols", cure)


def elements(column: ca.SX) -> list[ca.SX]:
    """Scalar symbols of a column."""
    return [] if column.is_empty() else ca.vertsplit(column)
