"""Notes on how a problem's statement may explain a solve's end."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product

import casadi as ca
import numpy as np

from ccdtools_ground.door import brief
from ccdtools_ground.operations import JUMPS, operations
from ccdtools_ground.user_functions import in_words
from mpc.checks import Array
from mpc.exceptions import InputError
from mpc.optimal_control.descriptions import describe_row, of_phase
from mpc.optimal_control.interval import times_of
from mpc.optimal_control.phase import signal_along
from mpc.optimal_control.program import NonlinearProgram
from mpc.tolerances import SHORTEST_DURATION

AWAY = "Give a `guess` away from there, with which the function is finite."
KINKS = {ca.OP_FABS: "fabs", ca.OP_FMIN: "fmin", ca.OP_FMAX: "fmax"}
ROUGH = ("dynamics", "stage_cost", "path", "terminal_cost", "boundary", "sample_cost")  # functions that may be so


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
        values = np.concatenate([g, f])
        i = int(np.flatnonzero(~np.isfinite(values))[0])
        what = describe_row(program, i, program.guess) if i < len(g) else "the cost"
        got = f"{values[i]:g} in {what}, between the points of the mesh"
    raise InputError("guess", got, expected, AWAY)


def functions_not_finite(program: NonlinearProgram, v: Array) -> Iterator[str]:
    """Functions that are not finite at unknowns (n,), and where first."""
    p = v[program.parameters, None]
    for k, (part, (start, length)) in enumerate(zip(program.parts, program.times(v))):
        phase, f, of = part.phase, part.functions, of_phase(program, k)
        nodes, _, states, inputs = part.unknowns(v)
        x = nodes[: part.layout.nx]
        at = times_of(part.layout.points, part.mesh).T.ravel()
        w = signal_along(phase, at[:, None]).T
        along = {"x": np.hstack(states), "u": np.hstack(inputs), "w": w, "t": (start + length * at)[None], "p": p}
        clock = np.array([[start]]), np.array([[start + length]])
        at_end = signal_along(phase, np.ones((1, 1))).T
        ends = {"x0": x[:, :1], "x": x[:, -1:], "w": at_end, "t0": clock[0], "t": clock[1], "p": p}
        yield from _first(f.dynamics, [f"dynamics of {name}" for name in phase.state_names], along, of)
        yield from _first(f.stage_cost, ["stage_cost"], along, of)
        yield from _first(f.path, f.path_names, along, of)
        yield from _first(f.terminal_cost, ["terminal_cost"], ends, of)
        yield from _first(f.boundary, f.boundary_names, ends, of)
        if f.sample_cost is not None:
            times, known, w, places = part.samples
            sampled = {"x": v[places].T, "w": w.T, "p": p, "t": (start + times)[None], "y": known.T}
            yield from _first(f.sample_cost, ["sample_cost"], sampled, of)
    cost, constraints = program.problem.of_parameters
    yield from _first(cost, ["p_cost"], {"p": p}, "")
    yield from _first(constraints, program.problem.p_constraint_names, {"p": p}, "")


def _first(function: ca.Function | None, entries: Sequence[str], columns: dict[str, Array],
           phase: str) -> Iterator[str]:  # fmt: skip
    """First time at which a function of columns (·, n) or (·, 1) is not finite, in words."""
    if function is None:
        return
    given = {name: columns[name] for name in function.name_in()}
    values = np.asarray(function(*given.values()), dtype=float)
    wrong = np.argwhere(~np.isfinite(values))
    if not len(wrong):
        return
    times = given.pop("t", np.full((1, values.shape[1]), np.nan))[0]
    row, i = wrong[np.argmin(times[wrong[:, 1]])]
    when = "" if np.isnan(times[i]) else f" at t = {times[i]:.6g}"
    shown = {name: value[:, i if value.shape[1] > 1 else 0] for name, value in given.items() if name != "t0"}
    where = ", ".join(
        f"{name} = {brief('[' + ', '.join(f'{entry:.4g}' for entry in value) + ']')}"
        for name, value in shown.items() if value.size
    )  # fmt: skip
    yield f"{values[row, i]:g} in {entries[row]}{phase}{when}, where {where}"


def notes_of(program: NonlinearProgram, v: Array, solved: bool) -> Iterator[str]:
    """Notes on durations, jumps, kinks and coarse meshes."""
    for k, part in enumerate(program.parts):
        if part.duration >= 0 and v[part.duration] <= part.phase.duration[0] * (1 + SHORTEST_DURATION):
            yield (
                f"The duration of phase {k + 1} came down to its lower bound {part.phase.duration[0]:g}: without that "
                "bound it might run to zero."
            )
    named = product(enumerate(program.problem.functions), ROUGH)
    for (k, functions), function in named:
        name, found = f"{function}{of_phase(program, k)}", operations(getattr(functions, function))
        jumps = sorted({JUMPS[one] for one in found & JUMPS.keys()})
        kinks = sorted({KINKS[one] for one in found & KINKS.keys()})
        if jumps:
            yield (
                f"The {name} may jump ({', '.join(jumps)}), where derivatives say nothing: make it "
                "smooth, such as tanh(x/ε) for sign, or cut the problem into phases where it jumps."
            )
        elif kinks and not solved:
            what = ", ".join(kinks)
            cure = "round them, such as sqrt(x² + ε²) for fabs; for a cost |u| take u = a − b, a, b ≥ 0, at a + b"
            yield f"The {name} has kinks ({what}): {cure}."
    free = int((program.lower < program.upper).sum())
    equations = int((program.row_lower == program.row_upper).sum())
    if equations > free and not solved:
        yield f"The mesh has {equations} equations for {free} free unknowns: take more intervals or a higher degree."


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
