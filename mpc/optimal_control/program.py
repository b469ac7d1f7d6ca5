"""The nonlinear program that a transcription makes of an optimal control problem, to be looked at and solved."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from mpc.checks import Array
from mpc.optimal_control.interval import Layout
from mpc.optimal_control.problem import OptimalControlProblem, Phase, PhaseFunctions
from mpc.optimal_control.schemes import Scheme
from mpc.optimal_control.unknowns import Trajectory, placed

VANISHING = 1e-9  # size of an unknown, beside the one it was given, that tells nothing


@dataclass(frozen=True)
class Rows:
    """Constraints of one kind: their name, their place and where on the mesh they stand.

    Attributes
    ----------
    name : str
    phase : int
        Which one; −1 for what all share.
    first, last : int
        Rows first … last − 1.
    fractions : (last − first,) array
        Of the phase at which each stands.
    entries : tuple of str
        What each row of one point is called.
    """

    name: str
    phase: int
    first: int
    last: int
    fractions: Array
    entries: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class PhasePart:
    """Where the unknowns of a phase stand in the vector of all.

    Attributes
    ----------
    phase, functions, layout, scheme
    mesh : (N + 1,) array
        Of fractions of the phase, from 0 to 1.
    first, last : int
        Its unknowns are first … last − 1: node, interval, node, interval, …, node.
    duration : int
        Index of its duration; −1 where it is given.
    defects, path : slice
        Its rows, interval by interval.
    interval : casadi.Function
    """

    phase: Phase
    functions: PhaseFunctions
    layout: Layout
    scheme: Scheme
    mesh: Array
    first: int
    last: int
    duration: int
    defects: slice
    path: slice
    interval: ca.Function

    @property
    def intervals(self) -> int:
        """N."""
        return len(self.mesh) - 1

    def columns(self, v: Any) -> tuple[Any, Any]:
        """Unknowns (column, N) of intervals and their first nodes, and (node,) of the last, of the vector of all."""
        own = v[self.first : self.last]
        cut = self.layout.column * self.intervals
        if isinstance(own, np.ndarray):
            return own[:cut].reshape(self.intervals, self.layout.column).T, own[cut:]
        return ca.reshape(own[:cut], self.layout.column, self.intervals), own[cut:]


@dataclass(frozen=True, eq=False)
class NonlinearProgram:
    """min f(v) subject to lower ≤ v ≤ upper, row_lower ≤ g(v) ≤ row_upper, in the units of the problem.

    Attributes
    ----------
    problem : OptimalControlProblem
    v, f, g : casadi.MX
    lower, upper, guess, scale : (n,) arrays
        Bounds, where to start, and sizes of the unknowns.
    cost_scale : float
    row_lower, row_upper, row_scale : (m,) arrays
    rows : tuple of Rows
    parts : tuple of PhasePart
    parameters : slice
        Of p among the unknowns.
    expand : bool
        Whether f and g are written out in scalar instructions for the solver.
    """

    problem: OptimalControlProblem
    v: ca.MX
    f: ca.MX
    g: ca.MX
    lower: Array
    upper: Array
    guess: Array
    scale: Array
    row_lower: Array
    row_upper: Array
    row_scale: Array
    rows: tuple[Rows, ...]
    parts: tuple[PhasePart, ...]
    parameters: slice
    expand: bool
    cost_scale: float = 1.0

    def __repr__(self) -> str:
        kinds = ", ".join(f"{part.intervals} intervals of {part.scheme.name}" for part in self.parts)
        return f"NonlinearProgram({self.v.numel()} unknowns, {self.g.numel()} constraints, {kinds})"

    def times(self, v: Array) -> list[tuple[float, float]]:
        """Start and duration of every phase, of the unknowns (n,)."""
        clock, found = 0.0, []
        for k, part in enumerate(self.parts):
            start = clock if k and self.problem.linked else part.phase.start_time
            length = float(v[part.duration]) if part.duration >= 0 else part.phase.duration[0]
            found.append((start, length))
            clock = start + length
        return found


def rescaled(program: NonlinearProgram, v: Array) -> NonlinearProgram:
    """The program with sizes of unknowns, dynamics and cost as they are at unknowns (n,)."""
    scale, row_scale = program.scale.copy(), program.row_scale.copy()
    for part in program.parts:
        layout = part.layout
        own, sizes = v[part.first : part.last], scale[part.first : part.last]
        coordinate = placed(layout, part.mesh, _numbered(layout))
        for i in range(layout.nx + layout.nu):
            largest = np.abs(own[coordinate == i]).max()
            sizes[coordinate == i] = largest if largest > VANISHING * sizes[coordinate == i].max() else 1.0
        rows = part.defects.stop - part.defects.start
        row_scale[part.defects] = np.tile(sizes[: layout.nx], rows // layout.nx)
    slope = ca.Function("slope", [program.v], [ca.gradient(program.f, program.v)])(v)
    size = float(np.abs(np.asarray(slope, dtype=float).ravel() * scale).max(initial=0.0))
    cost_scale = size if np.isfinite(size) and size > 0 else 1.0
    return replace(program, scale=scale, row_scale=row_scale, guess=v, cost_scale=cost_scale)


def _numbered(layout: Layout) -> Trajectory:
    """A trajectory whose values are the numbers of the coordinates: states first, then inputs."""

    def numbers(at: Array) -> tuple[Array, Array]:
        every = np.tile(np.arange(layout.nx + layout.nu, dtype=float), (len(at), 1))
        return every[:, : layout.nx], every[:, layout.nx :]

    return numbers


def _timed(layout: Layout) -> Trajectory:
    """A trajectory whose values are the fractions of the phase."""

    def times(at: Array) -> tuple[Array, Array]:
        return np.tile(at[:, None], (1, layout.nx)), np.tile(at[:, None], (1, layout.nu))

    return times


def describe_row(program: NonlinearProgram, row: int, v: Array) -> str:
    """What a constraint is, and when: "path 2 at t = 0.31"."""
    found = next(rows for rows in program.rows if rows.first <= row < rows.last)
    index = row - found.first
    if found.phase < 0:
        return f"{found.name} {index + 1}"
    start, length = program.times(v)[found.phase]
    path = program.problem.functions[found.phase].path
    if found.entries:
        entry = f" of {found.entries[index % len(found.entries)]}"
    else:
        entry = f" {(index % path.numel_out(0) if found.name == 'path' and path else index) + 1}"
    phase = f" of phase {found.phase + 1}" if len(program.parts) > 1 else ""
    return f"{found.name}{entry}{phase} at t = {start + length * found.fractions[index]:.6g}"


def describe_unknown(program: NonlinearProgram, index: int, v: Array) -> str:
    """What an unknown is, and when: "bound of input 1 at t = 0.31"."""
    for k, (part, (start, length)) in enumerate(zip(program.parts, program.times(v))):
        if not part.first <= index < part.last:
            continue
        own = index - part.first
        layout = part.layout
        coordinate = int(placed(layout, part.mesh, _numbered(layout))[own])
        fraction = placed(layout, part.mesh, _timed(layout))
        name = f"state {coordinate + 1}" if coordinate < layout.nx else f"input {coordinate - layout.nx + 1}"
        phase = f" of phase {k + 1}" if len(program.parts) > 1 else ""
        return f"bound of {name}{phase} at t = {start + length * fraction[own]:.6g}"
    return "bound of a duration" if index < program.parameters.start else "bound of a parameter"
