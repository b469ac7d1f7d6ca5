"""Notes on how a problem's statement may explain a solve's end."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import casadi as ca
import numpy as np

from ccdtools_ground.door import brief
from ccdtools_ground.user_functions import in_words
from mpc.checks import Array
from mpc.exceptions import InputError
from mpc.optimal_control.descriptions import describe_row, of_phase
from mpc.optimal_control.interval import times_of
from mpc.optimal_control.phase import signal_at
from mpc.optimal_control.program import NonlinearProgram, PhasePart
from mpc.tolerances import SHORTEST_DURATION

AWAY = "Give a `guess` away from there, with which the function is finite."
JUMPS = {
    ca.OP_SIGN: "sign", ca.OP_FLOOR: "floor", ca.OP_CEIL: "ceil", ca.OP_LT: "<", ca.OP_LE: "<=", ca.OP_EQ: "==",
    ca.OP_NE: "!=", ca.OP_IF_ELSE_ZERO: "if_else", ca.OP_FMOD: "fmod",
}  # fmt: skip
KINKS = {ca.OP_FABS: "fabs", ca.OP_FMIN: "fmin", ca.OP_FMAX: "fmax"}


def check_at_guess(program: NonlinearProgram) -> None:
    """Raise unless cost and constraints are finite at the guess."""
    expected = "finite values where the solution starts from"
    try:
        f, g = (np.asarray(value, dtype=float).ravel() for value in program.derivatives.values(program.guess))
    except RuntimeError as error:  # of an integrator
        raise InputError("guess", f"one that stops with {in_words(error)[0]}", expected, AWAY) from error
    if np.isfinite(f).all() and np.isfinite(g).all():
        return
    got = next(functions_not_finite(program, program.guess), "")
    if not got:  # within an integrator's step
        wrong = np.flatnonzero(~np.isfinite(g))
        what = describe_row(program, int(wrong[0]), program.guess) if len(wrong) else "the cost"
        got = f"{g[wrong[0]] if len(wrong) else f[0]:g} in {what}, between the points of the mesh"
    raise InputError("guess", got, expected, AWAY)


def functions_not_finite(program: NonlinearProgram, v: Array) -> Iterator[str]:
    """Functions that are not finite at unknowns (n,), and where first."""
    p = v[program.parameters]
    for k, (part, clock) in enumerate(zip(program.parts, program.times(v))):
        named = {
            "dynamics": [f"dynamics of {name}" for name in part.phase.state_names],
            "stage_cost": ["stage_cost"], "path": part.functions.path_names,
            "terminal_cost": ["terminal_cost"], "boundary": part.functions.boundary_names,
        }  # fmt: skip
        on_the_way, at_the_end = _along(program, part, v, clock), _at_ends(part, v, clock)
        for name, entries in named.items():
            of = at_the_end if name in ("terminal_cost", "boundary") else on_the_way
            found = _first(getattr(part.functions, name), entries, of | {"p": p}, of_phase(program, k))
            if found:
                yield found
    for name, function in zip(("p_cost", "p_constraints"), program.problem.of_parameters):
        entries = ["p_cost"] if name == "p_cost" else program.problem.p_constraint_names
        found = _first(function, entries, {"p": p}, "")
        if found:
            yield found


def _along(program: NonlinearProgram, part: PhasePart, v: Array, clock: tuple[float, float]) -> dict[str, Array]:
    """Columns at all points of a phase's intervals."""
    *_, states, inputs = part.unknowns(v)
    at = times_of(part.layout.points, part.mesh).T.ravel()
    w = signal_at(part.phase, part.phase.start_time + part.phase.duration[0] * at).T
    return {"x": np.hstack(states), "u": np.hstack(inputs), "w": w, "t": (clock[0] + clock[1] * at)[None]}


def _at_ends(part: PhasePart, v: Array, clock: tuple[float, float]) -> dict[str, Array]:
    """Columns at both ends of a phase."""
    first, last = part.first, part.last - part.layout.node
    x0, x = v[first : first + part.layout.nx], v[last : last + part.layout.nx]
    return {"x0": x0[:, None], "x": x[:, None], "t0": np.full((1, 1), clock[0]), "t": np.full((1, 1), sum(clock))}


def _first(function: ca.Function | None, entries: Sequence[str], columns: dict[str, Array], phase: str) -> str:
    """First time of a non-finite function, in words, or ""."""
    if function is None:
        return ""
    n = max((value.shape[1] for value in columns.values() if value.ndim == 2), default=1)
    given = {name: value if value.ndim == 2 else np.tile(value[:, None], (1, n)) for name, value in columns.items()}
    needed = [given[name] for name in function.name_in()]
    values = np.asarray(function.map(n)(*needed), dtype=float).reshape(-1, n)
    wrong = np.argwhere(~np.isfinite(values))
    if not len(wrong):
        return ""
    times = given["t"][0] if "t" in given else np.zeros(n)
    row, i = wrong[np.argmin(times[wrong[:, 1]])]
    when = f" at t = {times[i]:.6g}" if "t" in given else ""
    where = ", ".join(
        f"{name} = {brief('[' + ', '.join(f'{entry:.4g}' for entry in given[name][:, i]) + ']')}"
        for name in function.name_in() if name not in ("t", "t0") and given[name].size
    )  # fmt: skip
    return f"{values[row, i]:g} in {entries[row]}{phase}{when}, where {where}"


def notes_of(program: NonlinearProgram, v: Array, solved: bool) -> tuple[str, ...]:
    """Notes on shortest durations, jumps, kinks and coarse meshes."""
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
        if found <= least * (1 + SHORTEST_DURATION):
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
    """Operations of a function of scalar instructions, or nothing."""
    if function is None:
        return set()
    if not function.is_a("SXFunction"):
        try:
            function = function.expand()
        except RuntimeError:
            return set()
    return {function.instruction_id(i) for i in range(function.n_instructions())}


def undefined(program: NonlinearProgram, v: Array) -> tuple[str, ...]:
    """Constraints that are not finite at unknowns (n,) or the guess."""
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
