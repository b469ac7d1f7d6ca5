"""What constraints and unknowns of a program are called, and when they are."""

from __future__ import annotations

from mpc.checks import Array
from mpc.optimal_control.program import NonlinearProgram, Rows
from mpc.optimal_control.unknowns import coordinates


def rows_of(program: NonlinearProgram, row: int) -> Rows:
    """The constraints of one kind that a row belongs to."""
    return next(rows for rows in program.rows if rows.first <= row < rows.last)


def of_phase(program: NonlinearProgram, phase: int) -> str:
    """" of phase 2", where there are several."""
    return f" of phase {phase + 1}" if len(program.parts) > 1 and phase >= 0 else ""


def of_linked_phase(program: NonlinearProgram, phase: int) -> str:
    """The same where phases follow one another; scenarios side by side have their limits in common."""
    return of_phase(program, phase) if program.problem.linked else ""


def limit_of_row(program: NonlinearProgram, row: int) -> str:
    """What limit a constraint belongs to, at whatever time, and in whatever scenario: "path 2"."""
    rows = rows_of(program, row)
    return f"{rows.entries[(row - rows.first) % len(rows.entries)]}{of_linked_phase(program, rows.phase)}"


def name_of_row(program: NonlinearProgram, row: int) -> str:
    """What a constraint is, at whatever time: "path 2 of phase 3"."""
    rows = rows_of(program, row)
    return f"{rows.entries[(row - rows.first) % len(rows.entries)]}{of_phase(program, rows.phase)}"


def describe_row(program: NonlinearProgram, row: int, v: Array) -> str:
    """What a constraint is, and when: "path 2 at t = 0.31"."""
    rows = rows_of(program, row)
    if rows.phase < 0:
        return name_of_row(program, row)
    start, length = program.times(v)[rows.phase]
    return f"{name_of_row(program, row)} at t = {start + length * rows.fractions[row - rows.first]:.6g}"


def describe_unknown(program: NonlinearProgram, index: int, v: Array) -> str:
    """What an unknown is, and when: "bound of u1 at t = 0.31"."""
    for k, (part, (start, length)) in enumerate(zip(program.parts, program.times(v))):
        if index == part.duration:
            return f"bound of the duration{of_phase(program, k)}"
        if not part.first <= index < part.last:
            continue
        own = index - part.first
        numbers, fraction = coordinates(part.layout, part.mesh)
        name = (*part.phase.state_names, *part.phase.input_names)[int(numbers[own])]
        return f"bound of {name}{of_phase(program, k)} at t = {start + length * fraction[own]:.6g}"
    own = index - program.parameters.start
    return f"bound of {program.problem.p_names[own]}" if 0 <= own < program.problem.parameters else "cost of a scenario"
