"""What rounding may make of the value of an expression.

References
----------
Higham, "Accuracy and Stability of Numerical Algorithms", SIAM, 2002, chapter 3.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from ccdtools.arrays import Array

EPSILON = 2.0**-52


def rounding(function: ca.Function, v: ca.SX, lower: Array, upper: Array) -> ca.SX:
    """What rounding may make of the constraints at a point of the unit box, (ng,), as an expression.

    To first order, every intermediate result being off by a part of the machine's precision. Of functions that are
    called from within, the result alone counts.
    """
    if any(function.instruction_id(k) == ca.OP_CALL for k in range(function.n_instructions())):
        return EPSILON * ca.fabs(ca.densify(function(ca.DM(lower) + v * ca.DM(upper - lower))))
    work: list[Any] = [None] * function.sz_w()
    off: list[ca.SX] = []
    out = [ca.SX(0)] * function.numel_out(0)
    p = [low + v[i] * (high - low) for i, (low, high) in enumerate(zip(lower, upper))]

    def rounded(value: ca.SX) -> ca.SX:
        """An intermediate result, with its relative error beside it."""
        off.append(ca.SX.sym("off"))
        return value * (1 + off[-1])

    p = [rounded(entry) for entry in p]
    for k in range(function.n_instructions()):
        op = function.instruction_id(k)
        into, of = function.instruction_output(k), function.instruction_input(k)
        if op == ca.OP_CONST:
            work[into[0]] = ca.SX(function.instruction_constant(k))
        elif op == ca.OP_INPUT:
            work[into[0]] = p[of[1]]
        elif op == ca.OP_OUTPUT:
            out[into[1]] = work[of[0]]
        elif len(of) == 1:
            work[into[0]] = rounded(ca.SX.unary(op, work[of[0]]))
        else:
            work[into[0]] = rounded(ca.SX.binary(op, work[of[0]], work[of[1]]))
    errors = ca.vertcat(*off)
    slopes = ca.substitute(ca.jacobian(ca.vertcat(*out), errors), errors, ca.DM.zeros(len(off)))
    return EPSILON * ca.sum2(ca.fabs(ca.densify(slopes)))
