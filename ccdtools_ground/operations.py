"""Operations of CasADi functions: which jump, and the sizes of the terms of sums."""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca

JUMPS = {
    ca.OP_SIGN: "sign", ca.OP_FLOOR: "floor", ca.OP_CEIL: "ceil", ca.OP_FMOD: "fmod", ca.OP_REMAINDER: "remainder",
    ca.OP_COPYSIGN: "copysign", ca.OP_IF_ELSE_ZERO: "if_else", ca.OP_LT: "<", ca.OP_LE: "<=", ca.OP_EQ: "==",
    ca.OP_NE: "!=", ca.OP_AND: "and", ca.OP_OR: "or", ca.OP_NOT: "not",
}  # of which derivatives say nothing  # fmt: skip


def operations(function: ca.Function | None) -> set[int]:
    """Operations of a function of scalar instructions, or nothing."""
    if function is None:
        return set()
    if not function.is_a("SXFunction"):
        try:
            function = function.expand()
        except RuntimeError:
            return set()
    return {function.instruction_id(i) for i in range(function.n_instructions())}


def bent_rows(value: Any, z: Any) -> list[int]:
    """Rows that are not affine in z; what may jump is not, though its derivative is constant."""
    slope, given = ca.jacobian(value, z), ca.symvar(value)

    def jumps(row: Any) -> bool:
        """Whether a row has such operations."""
        return bool(JUMPS.keys() & operations(ca.Function("row", given, [row])))

    return [i for i in range(value.numel()) if ca.depends_on(slope[i, :], z) or jumps(value[i])]


def term_sizes(function: ca.Function, *arguments: ca.SX) -> ca.SX:
    """Sizes of the terms in a function's entries, proportional to rounding.

    Of functions that are called from within, the result alone counts.
    """
    steps = range(function.n_instructions())
    if any(function.instruction_id(k) == ca.OP_CALL for k in steps):
        return ca.fabs(function(*arguments))
    work: dict[int, tuple[Any, Any]] = {}
    sizes = ca.SX.zeros(function.nnz_out(0))
    for k in steps:
        op, inputs, outputs = function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
        if op == ca.OP_OUTPUT:
            sizes[outputs[1]] = work[inputs[0]][1]
        elif op == ca.OP_INPUT:
            value = ca.SX(arguments[inputs[0]])[inputs[1]]
            work[outputs[0]] = value, ca.fabs(value)
        elif op == ca.OP_CONST:
            number = ca.SX(function.instruction_constant(k))
            work[outputs[0]] = number, ca.fabs(number)
        else:
            work[outputs[0]] = _sized(op, len(inputs))(*(ca.vertcat(*one) for one in zip(*(work[i] for i in inputs))))
    return sizes


@cache
def _sized(op: int, inputs: int) -> ca.Function:
    """Operation on pairs (value, size of its terms), by its slopes."""
    values, sizes = ca.vertsplit(ca.SX.sym("value", inputs)), ca.SX.sym("size", inputs)
    value = ca.SX.unary(op, *values) if inputs == 1 else ca.SX.binary(op, *values)
    counted = 1 if op in (ca.OP_POW, ca.OP_CONSTPOW) else inputs  # by an exponent, a negative base has no slope
    size = sum(ca.fabs(ca.jacobian(value, values[i])) * sizes[i] for i in range(counted))
    return ca.Function("sized", [ca.vertcat(*values), sizes], [value, ca.fmax(ca.fabs(value), size)])
