"""Transcription of an optimal control problem on a mesh."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ccdtools_ground.door import brief
from mpc.checks import Array, as_count, as_floats
from mpc.exceptions import InputError
from mpc.optimal_control.assembly import Assembly
from mpc.optimal_control.interval import Layout, between, first_duration, first_guess, layout_of, placed, size_of
from mpc.optimal_control.phase import Phase, PhaseFunctions, signal_at
from mpc.optimal_control.phase_equations import PhaseToCome, phase_equations
from mpc.optimal_control.pieces import Clock, itself, link_piece, mean_and_spread, parameter_piece
from mpc.optimal_control.problem import OptimalControlProblem
from mpc.optimal_control.program import NonlinearProgram, PhasePart
from mpc.optimal_control.schemes import Collocation, MultipleShooting, Radau, Scheme


def build(problem: OptimalControlProblem | Phase, scheme: Scheme | None = None, intervals: Any = 20,
          meshes: Any = None) -> NonlinearProgram:  # fmt: skip
    """Transcribe a problem on a mesh.

    Parameters
    ----------
    problem : OptimalControlProblem or Phase
    scheme : Collocation or MultipleShooting
        `Radau(3)` by default. Discrete dynamics are taken as they are, whatever the scheme.
    intervals : int, or one a phase
        Equal ones.
    meshes : list of (N + 1,) arrays, optional
        Rising fractions of each phase from 0 to 1, instead.

    Raises
    ------
    InputError
        If a mesh does not rise from 0 to 1, or something is not finite at the guess: it says what, and when.
    """
    if isinstance(problem, Phase):
        problem = OptimalControlProblem(problem)
    if not isinstance(problem, OptimalControlProblem):
        raise InputError("problem", type(problem).__name__, "an OptimalControlProblem or a Phase")
    scheme = Radau(3) if scheme is None else scheme
    if not isinstance(scheme, Collocation | MultipleShooting):
        raise InputError(
            "scheme", type(scheme).__name__, "Radau(), Trapezoidal(), HermiteSimpson() or MultipleShooting()"
        )
    return _Builder(problem, scheme, _as_meshes(problem, intervals, meshes)).program()


class _Builder:
    """Builder of a program, phase by phase."""

    def __init__(self, problem: OptimalControlProblem, scheme: Scheme, meshes: list[Array]) -> None:
        self.problem = problem
        self.scheme = scheme
        self.meshes = meshes
        self.into = Assembly()

    def program(self) -> NonlinearProgram:
        """Whole program."""
        problem, into = self.problem, self.into
        first_parameters = np.asarray(problem.p_guess)
        layouts = [layout_of(phase, own.nw, self.scheme) for phase, own in zip(problem.phases, problem.functions)]
        firsts = []
        for phase, functions, layout, mesh in zip(problem.phases, problem.functions, layouts, self.meshes):
            firsts.append(into.width)
            into.unknown(*phase_unknowns(phase, functions, first_parameters, layout, mesh))
        durations = [self._duration(phase) for phase in problem.phases]
        parameters = slice(into.width, into.width + problem.parameters)
        self.p = np.arange(parameters.start, parameters.stop)
        low, high = problem.p_bounds
        into.unknown(low, high, first_parameters)
        count = len(problem.phases)
        costs = self._costs_of_scenarios()
        alone = costs.stop > costs.start
        targets = np.arange(1, count + 1) if alone else np.zeros(count, dtype=int)
        weights = np.ones(count) if alone else problem.weights
        parts: list[PhasePart] = []
        for k, (phase, functions) in enumerate(zip(problem.phases, problem.functions)):
            to_come = PhaseToCome(
                k, phase, functions, self.scheme, self.meshes[k], layouts[k], self._clock(k, durations), firsts[k],
                durations[k], self.p, int(targets[k]), float(weights[k]),
            )  # fmt: skip
            parts.append(phase_equations(into, to_come))
            if k and problem.linked:
                self._link(k, self._clock(k, durations), parts[-2], parts[-1])
        self._of_parameters()
        return into.program(problem, tuple(parts), parameters, costs)

    def _costs_of_scenarios(self) -> slice:
        """Append the unknown costs of scenarios that are not summed."""
        problem = self.problem
        count = len(problem.phases)
        first = self.into.width
        if problem.risk == "sum" or count == 1:
            return slice(first, first)
        many = count if problem.risk == "spread" else 1
        self.into.unknown(np.full(many, -np.inf), np.full(many, np.inf), np.zeros(many))
        named = [f"cost of scenario {k + 1}" for k in range(count)]
        self.into.rows("cost of a scenario", -1, named, 1, -np.inf, 0.0, 1.0, 0.0)
        places = np.broadcast_to(np.arange(first, first + many), (count,))
        self.into.piece(itself(), places[None], np.arange(1, count + 1)[None], -np.ones(1))
        objective = itself() if many == 1 else mean_and_spread(problem.weights, problem.spread)
        self.into.piece(objective, places[:many, None], np.zeros((1, 1), dtype=int), np.ones(1))
        return slice(first, first + many)

    def _duration(self, phase: Phase) -> int:
        """Append a free duration; return its place, or −1."""
        if not phase.free_duration:
            return -1
        low, high = phase.duration
        guess = np.array([first_duration(phase)])  # its size, too: bounds of durations are often far away
        self.into.unknown(np.array([low]), np.array([high]), guess, guess)
        return self.into.width - 1

    def _clock(self, k: int, durations: list[int]) -> Clock:
        """Clock of phase k."""
        phases = self.problem.phases
        before = range(k) if self.problem.linked else range(0)
        start = phases[0 if self.problem.linked else k].start_time
        given = sum(phases[i].duration[0] for i in before if durations[i] < 0)
        free = [durations[i] for i in (*before, k) if durations[i] >= 0]
        return Clock(start + given, phases[k].duration[0], np.array(free, dtype=int), durations[k] >= 0)

    def _link(self, k: int, clock: Clock, before: PhasePart, after: PhasePart) -> None:
        """Append that a phase begins where its predecessor ends."""
        link = self.problem.link_functions[k - 1]
        end, begin = before.layout.nx, after.layout.nx
        size = self.into.scale[k][:begin]
        named = [f"link of {name}" for name in self.problem.phases[k].state_names]
        rows = self.into.rows("link", k, named, 1, 0.0, 0.0, size, 0.0)
        at = np.concatenate([
            before.last - before.layout.node + np.arange(end), after.first + np.arange(begin), self.p, clock.free,
        ])  # fmt: skip
        function = link_piece(link, clock, end, begin, self.problem.parameters)
        self.into.piece(function, at[:, None], 1 + np.arange(rows.start, rows.stop)[:, None], np.ones(begin))

    def _of_parameters(self) -> None:
        """Append cost and constraints of the parameters."""
        cost, constraints = self.problem.of_parameters
        count = 0 if constraints is None else constraints.numel_out(0)
        if cost is None and not count:
            return
        rows = self.into.rows("p_constraints", -1, self.problem.p_constraint_names, 1, -np.inf, 0.0, 1.0, 0.0)
        targets = np.concatenate([np.zeros(0 if cost is None else 1), 1 + np.arange(rows.start, rows.stop)]).astype(int)
        function = parameter_piece((cost, constraints), self.problem.parameters)
        self.into.piece(function, self.p[:, None], targets[:, None], np.ones(len(targets)))


def phase_unknowns(phase: Phase, functions: PhaseFunctions, parameters: Array, layout: Layout,
                   mesh: Array) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Bounds, guess and sizes of the unknowns (n,) of a phase."""
    trajectory = first_guess(phase)
    x, u = trajectory(mesh)
    known = [np.where(np.isfinite(side), side, 0.0) for side in (*phase.start, *phase.end)]
    (x_low, x_high), (u_low, u_high) = phase.x_bounds, phase.u_bounds
    inputs, states = size_of(u_low, u_high, u), size_of(x_low, x_high, np.vstack([x, *known]))
    told = [
        (np.isfinite(low) & np.isfinite(high)) | (np.abs(values).max(axis=0, initial=0.0) > 0)
        for low, high, values in ((x_low, x_high, np.vstack([x, *known])), (u_low, u_high, u))
    ]
    if not (told[0].all() and told[1].all()):
        guess = np.concatenate([states, inputs]), np.concatenate(told)
        states, inputs = np.split(_sizes(phase, functions, parameters, mesh, x, u, *guess), [phase.states])
    sizes = states, inputs
    lower, upper, size = (
        placed(layout, mesh, between(np.zeros(1), side[0][None], side[1][None]))
        for side in (*zip(phase.x_bounds, phase.u_bounds), sizes)
    )
    first, last = slice(layout.nx), slice(len(lower) - layout.node, len(lower) - layout.node_inputs)
    for place, (low, high) in ((first, phase.start), (last, phase.end)):
        lower[place] = np.maximum(lower[place], low)
        upper[place] = np.minimum(upper[place], high)
    return lower, upper, np.clip(placed(layout, mesh, trajectory), lower, upper), size


def _sizes(phase: Phase, functions: PhaseFunctions, parameters: Array, mesh: Array, x: Array, u: Array, sizes: Array,
           told: Array) -> Array:  # fmt: skip
    """Sizes (nx + nu,) of states and inputs, some of them told.

    An unknown is as large as a state of known size needs it, to move by that over the phase or as fast as the rest
    of its dynamics makes it; failing that, a state is as large as it moves over the phase.
    """
    n = len(mesh)
    times = phase.start_time + first_duration(phase) * mesh
    p = np.tile(parameters[:, None], (1, n))
    w = signal_at(phase, phase.start_time + phase.duration[0] * mesh)
    columns = [ca.MX.sym(name, functions.dynamics.numel_in(i)) for i, name in enumerate("xuwpt")]
    both = ca.jacobian(functions.dynamics(*columns), ca.vertcat(*columns[:2]))
    slopes = ca.Function("slopes", columns, [ca.vec(ca.densify(both))]).map(n)(x.T, u.T, w.T, p, times[None])
    steep = np.abs(np.asarray(slopes, dtype=float)).max(axis=1).reshape(-1, phase.states).T
    steep = np.where(np.isfinite(steep), steep, 0.0) * (1.0 if phase.discrete else first_duration(phase))
    sizes, told = np.where(told, sizes, 1.0), told.copy()
    for _ in range(len(sizes)):
        with np.errstate(divide="ignore"):
            moves = np.maximum(sizes[: phase.states], (steep * (sizes * told)).max(axis=1))
            needed = np.where(told[: phase.states, None], moves[:, None] / steep, np.inf).min(axis=0)
        found = np.logical_not(told) & np.isfinite(needed)
        if not found.any():
            needed = np.zeros(len(sizes))
            needed[: phase.states] = (steep * (sizes * told)).max(axis=1)
            found = np.logical_not(told) & (needed > 0)
        sizes, told = np.where(found, needed, sizes), told | found
    return sizes


def _as_meshes(problem: OptimalControlProblem, intervals: Any, meshes: Any) -> list[Array]:
    """Mesh fractions of every phase."""
    count = len(problem.phases)
    if meshes is None:
        each = [intervals] * count if np.ndim(intervals) == 0 else list(intervals)
        if len(each) != count:
            raise InputError("intervals", f"{len(each)} numbers", f"{count}, one a phase")
        meshes = [np.linspace(0, 1, as_count("intervals", n) + 1) for n in each]
    if not isinstance(meshes, list | tuple | np.ndarray):
        raise InputError("meshes", brief(repr(meshes)), "a list of meshes, one a phase")
    if len(meshes) != count:
        raise InputError("meshes", f"{len(meshes)} of them", f"{count}, one a phase")
    checked = []
    for phase, given in zip(problem.phases, meshes):
        if phase.discrete:
            given = np.linspace(0, 1, int(phase.duration[0]) + 1)
        mesh = as_floats("meshes", given)
        if mesh.ndim != 1 or len(mesh) < 2 or mesh[0] != 0 or mesh[-1] != 1 or not (np.diff(mesh) > 0).all():
            raise InputError("meshes", mesh, "fractions of the phase that rise from 0 to 1")
        checked.append(mesh)
    return checked
