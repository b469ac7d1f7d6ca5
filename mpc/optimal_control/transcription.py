"""From an optimal control problem and a mesh to a nonlinear program."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from mpc.checks import Array, as_count, as_floats
from mpc.exceptions import InputError
from mpc.optimal_control.derivatives import Derivatives
from mpc.optimal_control.interval import Layout, interval_function, layout_of, times_of
from mpc.optimal_control.phase import Phase, signal_at
from mpc.optimal_control.piece import Numbers, Piece
from mpc.optimal_control.pieces import (
    Clock,
    end_piece,
    interval_piece,
    link_piece,
    parameter_piece,
    path_piece,
    piece_function,
)
from mpc.optimal_control.problem import OptimalControlProblem
from mpc.optimal_control.program import (
    NonlinearProgram,
    PhasePart,
    Rows,
    with_costs_of_scenarios,
    with_sizes_of_rows,
)
from mpc.optimal_control.schemes import Collocation, MultipleShooting, Radau, Scheme
from mpc.optimal_control.undefined import check_at_guess
from mpc.optimal_control.unknowns import between, first_duration, first_guess, placed, size_of


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
    return _Builder(problem, scheme, _meshes(problem, intervals, meshes)).program()


def _meshes(problem: OptimalControlProblem, intervals: Any, meshes: Any) -> list[Array]:
    """Fractions of every phase."""
    count = len(problem.phases)
    if meshes is None:
        each = [intervals] * count if np.ndim(intervals) == 0 else list(intervals)
        if len(each) != count:
            raise InputError("intervals", f"{len(each)} numbers", f"{count}, one a phase")
        meshes = [np.linspace(0, 1, as_count("intervals", n) + 1) for n in each]
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

ROUND = 1e-12  # of the squares: where all scenarios cost the same, their spread has a slope all the same
TINY = 1e-300


class _Builder:
    """Collects unknowns, constraints and pieces, phase by phase."""

    def __init__(self, problem: OptimalControlProblem, scheme: Scheme, meshes: list[Array]) -> None:
        self.problem = problem
        self.scheme = scheme
        self.meshes = meshes
        self.lower: list[Array] = []
        self.upper: list[Array] = []
        self.guess: list[Array] = []
        self.scale: list[Array] = []
        self.rows: list[Rows] = []
        self.bounds: list[tuple[Array, Array, Array]] = []
        self.pieces: list[Piece] = []
        self.height = 0

    def program(self) -> NonlinearProgram:
        """The whole."""
        problem = self.problem
        layouts = [layout_of(phase, own.nw, self.scheme) for phase, own in zip(problem.phases, problem.functions)]
        firsts = []
        for k, (phase, layout, mesh) in enumerate(zip(problem.phases, layouts, self.meshes)):
            firsts.append(self.width)
            self._unknowns_of(k, phase, layout, mesh)
        durations = [self._duration(phase) for phase in problem.phases]
        parameters = slice(self.width, self.width + problem.parameters)
        self.p = np.arange(parameters.start, parameters.stop)
        low, high = problem.p_bounds
        self._unknown(low, high, np.asarray(problem.p_guess))
        count = len(problem.phases)
        costs = self._costs_of_scenarios()
        alone = costs.stop > costs.start
        targets = np.arange(1, count + 1) if alone else np.zeros(count, dtype=int)
        weights = np.ones(count) if alone else problem.weights
        parts: list[PhasePart] = []
        for k in range(count):
            clock = self._clock(k, durations)
            part = self._phase(k, layouts[k], firsts[k], durations[k], clock, int(targets[k]), float(weights[k]))
            if k and problem.linked:
                self._link(k, parts[-1], part)
            parts.append(part)
        self._of_parameters()
        return self._assembled(tuple(parts), parameters, costs)

    def _costs_of_scenarios(self) -> slice:
        """Append what the costs of scenarios are known by, where these are not summed: the largest, or each of them."""
        problem = self.problem
        count = len(problem.phases)
        first = self.width
        if problem.risk == "sum" or count == 1:
            return slice(first, first)
        many = count if problem.risk == "spread" else 1
        self._unknown(np.full(many, -np.inf), np.full(many, np.inf), np.zeros(many))
        named = [f"cost of scenario {k + 1}" for k in range(count)]
        self._rows("cost of a scenario", -1, named, 1, -np.inf, 0.0, 1.0, 0.0)
        places = np.broadcast_to(np.arange(first, first + many), (count,))
        self._piece(_itself(), places[None], np.arange(1, count + 1)[None], -np.ones(1))
        objective = _itself() if many == 1 else _mean_and_spread(problem.weights, problem.spread)
        self._piece(objective, places[:many, None], np.zeros((1, 1), dtype=int), np.ones(1))
        return slice(first, first + many)

    @property
    def width(self) -> int:
        """Unknowns so far."""
        return sum(map(len, self.lower))

    def _assembled(self, parts: tuple[PhasePart, ...], parameters: slice, costs: slice) -> NonlinearProgram:
        """The program of what was collected, sized by what it is at the guess."""
        none = [np.zeros(0)]
        low, high, scale = (np.concatenate([sides[i] for sides in self.bounds] + none) for i in range(3))
        derivatives = Derivatives(self.pieces, self.width, self.height)
        v = ca.MX.sym("v", self.width)
        f, g = derivatives.expressions(v)
        program = NonlinearProgram(
            problem=self.problem,
            v=v,
            f=f,
            g=g,
            lower=np.concatenate(self.lower),
            upper=np.concatenate(self.upper),
            guess=np.concatenate(self.guess),
            scale=np.concatenate(self.scale),
            row_lower=low,
            row_upper=high,
            row_scale=scale,
            rows=tuple(self.rows),
            parts=parts,
            parameters=parameters,
            costs=costs,
            derivatives=derivatives,
        )
        check_at_guess(program)
        return with_sizes_of_rows(with_costs_of_scenarios(program))

    def _unknown(self, lower: Array, upper: Array, guess: Array, scale: Array | None = None) -> None:
        """Append unknowns."""
        self.lower.append(lower)
        self.upper.append(upper)
        self.guess.append(guess)
        self.scale.append(size_of(lower, upper, guess) if scale is None else scale)

    def _unknowns_of(self, k: int, phase: Phase, layout: Layout, mesh: Array) -> None:
        """Append the unknowns of a phase, with where they start from."""
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
            states, inputs = np.split(self._sizes(k, phase, mesh, x, u, *guess), [phase.states])
        sizes = states, inputs
        lower, upper, size = (
            placed(layout, mesh, between(np.zeros(1), side[0][None], side[1][None]))
            for side in (*zip(phase.x_bounds, phase.u_bounds), sizes)
        )
        first, last = slice(layout.nx), slice(len(lower) - layout.node, len(lower) - layout.node_inputs)
        for place, (low, high) in ((first, phase.start), (last, phase.end)):
            lower[place] = np.maximum(lower[place], low)
            upper[place] = np.minimum(upper[place], high)
        self._unknown(lower, upper, np.clip(placed(layout, mesh, trajectory), lower, upper), size)

    def _sizes(self, k: int, phase: Phase, mesh: Array, x: Array, u: Array, sizes: Array, told: Array) -> Array:
        """Sizes (nx + nu,) of states and inputs, some of them told: the others by how the dynamics join them.

        An unknown is as large as a state of known size needs it, to move by that over the phase or as fast as the rest
        of its dynamics makes it; failing that, a state is as large as it moves over the phase.
        """
        functions, n = self.problem.functions[k], len(mesh)
        times = phase.start_time + first_duration(phase) * mesh
        p = np.tile(np.asarray(self.problem.p_guess)[:, None], (1, n))
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

    def _duration(self, phase: Phase) -> int:
        """Append a duration that is free; its place, or −1."""
        if not phase.free_duration:
            return -1
        low, high = phase.duration
        self._unknown(np.array([low]), np.array([high]), np.array([first_duration(phase)]))
        return self.width - 1

    def _clock(self, k: int, durations: list[int]) -> Clock:
        """When phase k is."""
        phases = self.problem.phases
        before = range(k) if self.problem.linked else range(0)
        start = phases[0 if self.problem.linked else k].start_time
        given = sum(phases[i].duration[0] for i in before if durations[i] < 0)
        free = [durations[i] for i in (*before, k) if durations[i] >= 0]
        return Clock(start + given, phases[k].duration[0], np.array(free, dtype=int), durations[k] >= 0)

    def _phase(self, k: int, layout: Layout, first: int, duration: int, clock: Clock, target: int,
               weight: float) -> PhasePart:  # fmt: skip
        """Append the equations of a phase, whose cost is added to row `target` of [f; g]."""
        phase, functions, mesh = self.problem.phases[k], self.problem.functions[k], self.meshes[k]
        N, shared = len(mesh) - 1, np.concatenate([self.p, clock.free])
        interval = interval_function(phase, functions, self.scheme, layout, self.problem.parameters)
        of_defects, of_path = interval.numel_out("defects"), interval.numel_out("path")
        after = [c for c in layout.points if c > 0] or [1.0]
        size = np.tile(self.scale[k][: layout.nx], N * of_defects // layout.nx)
        places = times_of(after, mesh).ravel().repeat(layout.nx)
        named = [f"dynamics of {name}" for name in phase.state_names]
        defects = self._rows("dynamics", k, named, len(size) // layout.nx, 0.0, 0.0, size, places)
        low, high = functions.path_bounds
        held = isinstance(self.scheme, MultipleShooting) or phase.discrete
        kept_at = [c for c in layout.points if held or c > 0]
        times = N * len(kept_at)
        places = times_of(kept_at, mesh).ravel().repeat(len(low))
        low, high = np.tile(low, times), np.tile(high, times)
        path = self._rows("path", k, functions.path_names, times, low, high, 1.0, places)
        signals = signal_at(phase, phase.start_time + phase.duration[0] * times_of(layout.signals, mesh).ravel())
        w = signals.reshape(N, -1).T
        self._piece(
            interval_piece(interval, layout, clock, self.problem.parameters, phase.discrete),
            np.vstack([
                first + np.arange(layout.column + layout.node)[:, None] + layout.column * np.arange(N),
                np.tile(shared[:, None], (1, N)),
            ]),
            1 + np.vstack([
                np.full((1, N), target - 1),
                np.arange(defects.start, defects.stop).reshape(N, -1).T,
                np.arange(path.start, path.stop).reshape(N, of_path).T,
            ]),
            np.concatenate([[weight], np.ones(of_defects + of_path)]),
            np.vstack([mesh[:-1], np.diff(mesh), w]),
        )  # fmt: skip
        last = first + layout.column * N + layout.node
        if functions.path is not None:
            self._path_at_an_end(k, layout, clock, first, shared, w, 1.0 if held else 0.0)
        if functions.terminal_cost is not None or functions.boundary is not None:
            targets, factors = [], []
            if functions.terminal_cost is not None:
                targets.append(np.array([target]))
                factors.append(np.array([weight]))
            if functions.boundary is not None:
                count = functions.boundary.numel_out(0)
                rows = self._rows("boundary", k, functions.boundary_names, 1, *functions.boundary_bounds, 1.0, 1.0)
                targets.append(1 + np.arange(rows.start, rows.stop))
                factors.append(np.ones(count))
            ends = np.concatenate([first + np.arange(layout.nx), last - layout.node + np.arange(layout.nx), shared])
            function = end_piece(functions, clock, layout.nx, self.problem.parameters)
            self._piece(function, ends[:, None], np.concatenate(targets)[:, None], np.concatenate(factors))
        return PhasePart(
            phase, functions, layout, self.scheme, mesh, first, last, duration, defects, path, interval
        )  # fmt: skip

    def _path_at_an_end(self, k: int, layout: Layout, clock: Clock, first: int, shared: Numbers, w: Array,
                        fraction: float) -> None:  # fmt: skip
        """Append what is kept along a phase at that of its ends which its intervals leave out."""
        functions = self.problem.functions[k]
        assert functions.path is not None
        low, high = functions.path_bounds
        N = len(self.meshes[k]) - 1
        if fraction == 1:  # with the input that is held last
            kept = np.arange(len(low))
            node = first + layout.column * N
            inputs = node - layout.column + layout.node + np.arange(layout.nu)
            signal = w[-layout.nw :, -1] if layout.nw else w[:0, 0]
        else:
            known = np.ones(len(low)) if layout.node_inputs else np.logical_not(_depends_on_input(functions.path))
            kept = np.flatnonzero(known)
            node = first
            inputs = node + layout.nx + np.arange(layout.node_inputs)
            signal = w[: layout.nw, 0]
        if not len(kept):
            return
        names = [functions.path_names[i] for i in kept]
        rows = self._rows("path", k, names, 1, low[kept], high[kept], 1.0, fraction)
        function = path_piece(functions, clock, layout, self.problem.parameters, fraction, kept)
        at = np.concatenate([node + np.arange(layout.nx), inputs, shared])
        self._piece(function, at[:, None], 1 + np.arange(rows.start, rows.stop)[:, None], np.ones(len(kept)),
                    signal[:, None])  # fmt: skip

    def _link(self, k: int, before: PhasePart, after: PhasePart) -> None:
        """Append that a phase begins where the one before it ends."""
        link = None if self.problem.link is None else self.problem.link_function(k - 1)
        end, begin = before.layout.nx, after.layout.nx
        size = self.scale[k][:begin]
        named = [f"link of {name}" for name in self.problem.phases[k].state_names]
        rows = self._rows("link", k, named, 1, 0.0, 0.0, size, 0.0)
        at = np.concatenate([before.last - before.layout.node + np.arange(end), after.first + np.arange(begin), self.p])
        function = link_piece(link, end, begin, self.problem.parameters)
        self._piece(function, at[:, None], 1 + np.arange(rows.start, rows.stop)[:, None], np.ones(begin))

    def _of_parameters(self) -> None:
        """Append cost and constraints of the parameters."""
        cost, constraints = self.problem.of_parameters
        count = 0 if constraints is None else constraints.numel_out(0)
        if cost is None and not count:
            return
        rows = self._rows("p_constraints", -1, self.problem.p_constraint_names, 1, -np.inf, 0.0, 1.0, 0.0)
        targets = np.concatenate([np.zeros(0 if cost is None else 1), 1 + np.arange(rows.start, rows.stop)]).astype(int)
        function = parameter_piece((cost, constraints), self.problem.parameters)
        self._piece(function, self.p[:, None], targets[:, None], np.ones(len(targets)))

    def _piece(self, function: ca.Function, unknowns: Numbers, rows: Numbers, factors: Array,
               data: Array | None = None) -> None:  # fmt: skip
        """Append a piece."""
        given = np.zeros((0, unknowns.shape[1])) if data is None else data
        self.pieces.append(Piece(function, unknowns, given, rows, factors))

    def _rows(self, name: str, phase: int, entries: Sequence[str], points: int, low: Any, high: Any, scale: Any,
              fractions: Any) -> slice:  # fmt: skip
        """Append constraints, those called `entries` at so many points; their places."""
        count = len(entries) * points
        first, last = self.height, self.height + count
        low, high, scale, places = (
            np.array(np.broadcast_to(np.asarray(b, dtype=float), (count,))) for b in (low, high, scale, fractions)
        )
        self.bounds.append((low, high, scale))
        if count:
            self.rows.append(Rows(name, phase, first, last, places, tuple(entries)))
        self.height = last
        return slice(first, last)


def _itself() -> ca.Function:
    """A number, as a piece."""
    return piece_function(lambda z, data: [z], True, {"z": 1}, 0)


def _mean_and_spread(weights: Array, spread: float) -> ca.Function:
    """The weighted mean of numbers and so many times their standard deviation, as a piece."""
    parts = ca.DM(weights / weights.sum())

    def value(z: Any, data: Any) -> list[Any]:
        mean = ca.dot(parts, z)
        variance = ca.dot(parts, (z - mean) ** 2)
        return [mean + spread * ca.sqrt(variance + ROUND * ca.dot(parts, z**2) + TINY)]

    return piece_function(value, True, {"z": len(weights)}, 0)


def _depends_on_input(path: ca.Function) -> Array:
    """Which values of a path function depend on the input: with points that leave out 0 there is none at the start."""
    pattern = path.jac_sparsity(0, 1)
    depends = np.zeros(path.numel_out(0), dtype=bool)
    depends[list(pattern.row())] = True
    return depends
