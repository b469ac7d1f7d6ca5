"""What a problem's statement may have to do with how a solve ended."""

from __future__ import annotations

from collections.abc import Iterator

import casadi as ca
import numpy as np

from mpc.checks import Array
from mpc.optimal_control.descriptions import describe_row
from mpc.optimal_control.program import NonlinearProgram
from mpc.optimal_control.undefined import functions_not_finite

JUMPS = {
    ca.OP_SIGN: "sign", ca.OP_FLOOR: "floor", ca.OP_CEIL: "ceil", ca.OP_LT: "<", ca.OP_LE: "<=", ca.OP_EQ: "==",
    ca.OP_NE: "!=", ca.OP_IF_ELSE_ZERO: "if_else", ca.OP_FMOD: "fmod",
}  # fmt: skip
KINKS = {ca.OP_FABS: "fabs", ca.OP_FMIN: "fmin", ca.OP_FMAX: "fmax"}
AT_BOUND = 1e-4  # of a duration, of its lower bound


def notes_of(program: NonlinearProgram, v: Array, solved: bool) -> tuple[str, ...]:
    """Durations that came down to their least; functions that may jump; and, if not solved, kinks and coarse meshes."""
    return (*_shortest(program, v), *_rough(program, not solved), *(() if solved else _too_coarse(program)))


def _too_coarse(program: NonlinearProgram) -> Iterator[str]:
    """Meshes with more equations than unknowns."""
    free = int((program.lower < program.upper).sum())
    equations = int((program.row_lower == program.row_upper).sum())
    if equations > free:
        yield f"The mesh has {equations} equations for {free} free unknowns: take more intervals or a higher degree."


def _shortest(program: NonlinearProgram, v: Array) -> Iterator[str]:
    """Durations at their lower bounds."""
    for k, part in enumerate(program.parts):
        if part.duration < 0:
            continue
        least, found = part.phase.duration[0], v[part.duration]
        if found <= least * (1 + AT_BOUND):
            yield (
                f"The duration of phase {k + 1} came down to its lower bound {least:g}: without that bound it might "
                "run to zero."
            )


def _rough(program: NonlinearProgram, of_kinks: bool) -> Iterator[str]:
    """Functions with operations that jump or have kinks."""
    for k, functions in enumerate(program.problem.functions):
        of_phase = f" of phase {k + 1}" if len(program.parts) > 1 else ""
        for name in ("dynamics", "stage_cost", "path", "terminal_cost", "boundary"):
            found = operations(getattr(functions, name))
            jumps = sorted({JUMPS[one] for one in found & JUMPS.keys()})
            kinks = sorted({KINKS[one] for one in found & KINKS.keys()})
            if jumps:
                yield (
                    f"The {name}{of_phase} may jump ({', '.join(jumps)}), where derivatives say nothing: make it "
                    "smooth, such as tanh(x/ε) for sign, or cut the problem into phases where it jumps."
                )
            elif kinks and of_kinks:
                what = ", ".join(kinks)
                cure = "round them, such as sqrt(x² + ε²) for fabs; for a cost |u| take u = a − b, a, b ≥ 0, at a + b"
                yield f"The {name}{of_phase} has kinks ({what}): {cure}."


def operations(function: ca.Function | None) -> set[int]:
    """The operations of a function that is made of scalar instructions, or of calls of such functions."""
    if function is None:
        return set()
    if not function.is_a("SXFunction"):
        try:
            function = function.expand()
        except RuntimeError:
            return set()
    return {function.instruction_id(i) for i in range(function.n_instructions())}


def undefined(program: NonlinearProgram, v: Array) -> tuple[str, ...]:
    """Constraints whose values or derivatives are not finite at unknowns (n,), or at the guess."""
    for at in (v, program.guess):
        named = tuple(functions_not_finite(program, at))
        if named:
            return named
        g, slope = program.derivatives.jacobian[1](at)
        f, of_cost = program.derivatives.jacobian[0](at)
        values = np.asarray(g, dtype=float).ravel()
        rows = set(np.flatnonzero(~np.isfinite(values)).tolist())
        slopes = slope.sparse().tocoo()
        steep = set(slopes.row[~np.isfinite(slopes.data)].tolist())
        found = [describe_row(program, int(row), at) for row in sorted(rows)[:1]]
        found += [f"the derivative of {describe_row(program, int(row), at)}" for row in sorted(steep - rows)[:1]]
        if not np.isfinite(float(f)):
            found.append("the cost")
        elif not np.isfinite(np.asarray(of_cost, dtype=float)).all():
            found.append("the derivative of the cost")
        if found:
            return tuple(found)
    return ("second derivatives",)
