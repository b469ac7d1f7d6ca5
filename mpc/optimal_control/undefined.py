"""Which function of a problem is not finite, and where."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import casadi as ca
import numpy as np

from mpc.checks import Array
from mpc.exceptions import InputError
from mpc.optimal_control.descriptions import describe_row, of_phase
from mpc.optimal_control.functions import brief
from mpc.optimal_control.interval import times_of
from mpc.optimal_control.phase import signal_at
from mpc.optimal_control.program import NonlinearProgram, PhasePart

AWAY = "Give a `guess` away from there, with which the function is finite."


def check_at_guess(program: NonlinearProgram) -> None:
    """Raise an `InputError` unless cost and constraints are finite at the guess: it says which, when and where."""
    f, g = (np.asarray(value, dtype=float).ravel() for value in program.derivatives.values(program.guess))
    if np.isfinite(f).all() and np.isfinite(g).all():
        return
    expected = "finite values where the solution starts from"
    got = next(functions_not_finite(program, program.guess), "")
    if not got:  # within an integrator's step
        wrong = np.flatnonzero(~np.isfinite(g))
        what = describe_row(program, int(wrong[0]), program.guess) if len(wrong) else "the cost"
        got = f"{g[wrong[0]] if len(wrong) else f[0]:g} in {what}, between the points of the mesh"
    raise InputError("guess", got, expected, AWAY)


def functions_not_finite(program: NonlinearProgram, v: Array) -> Iterator[str]:
    """Functions that are not finite at unknowns (n,), each with the first time, and states, inputs and so on there."""
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
    """Columns at all points of the intervals of a phase."""
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
    """The first time at which a function is not finite, in words; nothing where it is."""
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
        f"{name} = {_shown(given[name][:, i])}"
        for name in function.name_in() if name not in ("t", "t0") and given[name].size
    )  # fmt: skip
    return f"{values[row, i]:g} in {entries[row]}{phase}{when}, where {where}"


def _shown(value: Any) -> str:
    """A column, with four digits each."""
    return brief("[" + ", ".join(f"{entry:.4g}" for entry in value) + "]")
