"""From an optimal control problem and a mesh to a nonlinear program."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from mpc.checks import Array, as_count, as_floats
from mpc.exceptions import InputError
from mpc.optimal_control.interval import Layout, interval_function, layout_of, times_of
from mpc.optimal_control.phase import Phase, PhaseFunctions, signal_at
from mpc.optimal_control.problem import OptimalControlProblem
from mpc.optimal_control.program import NonlinearProgram, PhasePart, Rows, describe_row
from mpc.optimal_control.schemes import Collocation, MultipleShooting, Radau, Scheme
from mpc.optimal_control.unknowns import between, first_duration, first_guess, placed, size_of

LARGEST = 400_000  # instructions that are written out one by one; beyond, intervals stay calls of one function


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


class _Builder:
    """Collects unknowns and constraints, phase by phase."""

    def __init__(self, problem: OptimalControlProblem, scheme: Scheme, meshes: list[Array]) -> None:
        self.problem = problem
        self.scheme = scheme
        self.meshes = meshes
        self.lower: list[Array] = []
        self.upper: list[Array] = []
        self.guess: list[Array] = []
        self.scale: list[Array] = []
        self.rows: list[Rows] = []
        self.g: list[Any] = []
        self.bounds: list[tuple[Array, Array, Array]] = []
        self.height = 0

    def program(self) -> NonlinearProgram:
        """The whole."""
        problem = self.problem
        layouts = [
            layout_of(phase, own.nw, self.scheme) for phase, own in zip(problem.phases, problem.functions)
        ]  # fmt: skip
        places, first = [], 0
        for phase, layout, mesh in zip(problem.phases, layouts, self.meshes):
            last = first + layout.column * (len(mesh) - 1) + layout.node
            self._unknowns_of(phase, layout, mesh)
            places.append((first, last))
            first = last
        durations = []
        for phase in problem.phases:
            durations.append(first if phase.free_duration else -1)
            if phase.free_duration:
                low, high = phase.duration
                self._unknown(np.array([low]), np.array([high]), np.array([first_duration(phase)]))
                first += 1
        parameters = slice(first, first + problem.parameters)
        low, high = problem.p_bounds
        self._unknown(low, high, np.asarray(problem.p_guess))
        worst = parameters.stop if problem.risk == "worst" and len(problem.phases) > 1 else -1
        if worst >= 0:
            self._unknown(np.array([-np.inf]), np.array([np.inf]), np.array([0.0]))
        size = parameters.stop + (worst >= 0)
        v = ca.MX.sym("v", size)
        p = v[parameters]
        parts: list[PhasePart] = []
        costs: list[Any] = []
        ends: list[Any] = []
        clock: Any = ca.MX(0)
        for k, (phase, functions, layout, mesh) in enumerate(
            zip(problem.phases, problem.functions, layouts, self.meshes)
        ):
            start = clock if k and problem.linked else ca.MX(phase.start_time)
            length = v[durations[k]] if durations[k] >= 0 else ca.MX(phase.duration[0])
            part, cost, end = self._phase(k, functions, layout, mesh, places[k], durations[k], v, p, start, length)
            parts.append(part)
            costs.append(cost)
            if k and problem.linked:
                self._link(k, parts[k - 1], ends[k - 1], part.columns(v)[0][: layout.nx, 0], p)
            ends.append(end)
            clock = start + length
        cost_of_p, constraints_of_p = problem.of_parameters
        if worst >= 0:
            self._row("cost of a scenario", -1, ca.vertcat(*costs) - v[worst], -np.inf, 0.0, 1.0, [0.0], ())
            f = v[worst]
        else:
            f = sum(float(weight) * cost for weight, cost in zip(problem.weights, costs))
        if cost_of_p is not None:
            f = f + cost_of_p(p)
        if constraints_of_p is not None:
            self._row("p_constraints", -1, constraints_of_p(p), -np.inf, 0.0, 1.0, [0.0], ())
        program = self._assembled(v, f, tuple(parts), parameters)
        check_at_guess(program)
        return program

    def _assembled(self, v: ca.MX, f: Any, parts: tuple[PhasePart, ...], parameters: slice) -> NonlinearProgram:
        """The program of what was collected."""
        none = [np.zeros(0)]
        low, high, scale = (np.concatenate([sides[i] for sides in self.bounds] + none) for i in range(3))
        scalar = all(part.interval.is_a("SXFunction") for part in parts)
        work = sum(part.interval.n_instructions() * part.intervals for part in parts) if scalar else LARGEST
        return NonlinearProgram(
            problem=self.problem,
            v=v,
            f=ca.MX(f),
            g=ca.vertcat(*self.g),
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
            expand=work < LARGEST,
        )

    def _unknown(self, lower: Array, upper: Array, guess: Array, scale: Array | None = None) -> None:
        """Append unknowns."""
        self.lower.append(lower)
        self.upper.append(upper)
        self.guess.append(guess)
        self.scale.append(size_of(lower, upper, guess) if scale is None else scale)

    def _unknowns_of(self, phase: Phase, layout: Layout, mesh: Array) -> None:
        """Append the unknowns of a phase, with where they start from."""
        trajectory = first_guess(phase)
        x, u = trajectory(mesh)
        known = [np.where(np.isfinite(side), side, 0.0) for side in (*phase.start, *phase.end)]
        (x_low, x_high), (u_low, u_high) = phase.x_bounds, phase.u_bounds
        sizes = size_of(x_low, x_high, np.vstack([x, *known])), size_of(u_low, u_high, u)
        lower, upper, size = (
            placed(layout, mesh, between(np.zeros(1), side[0][None], side[1][None]))
            for side in (*zip(phase.x_bounds, phase.u_bounds), sizes)
        )
        first, last = slice(layout.nx), slice(len(lower) - layout.node, len(lower) - layout.node_inputs)
        for place, (low, high) in ((first, phase.start), (last, phase.end)):
            lower[place] = np.maximum(lower[place], low)
            upper[place] = np.minimum(upper[place], high)
        self._unknown(lower, upper, np.clip(placed(layout, mesh, trajectory), lower, upper), size)

    def _phase(self, k: int, functions: PhaseFunctions, layout: Layout, mesh: Array, place: tuple[int, int],
               duration: int, v: ca.MX, p: Any, start: Any, length: Any) -> tuple[PhasePart, Any, Any]:  # fmt: skip
        """Append the equations of a phase; its part, its cost and the state at its end."""
        phase, N = self.problem.phases[k], len(mesh) - 1
        interval = interval_function(phase, functions, self.scheme, layout, self.problem.parameters)
        part = PhasePart(phase, functions, layout, self.scheme, mesh, *place, duration, slice(0), slice(0), interval)
        columns, last = part.columns(v)
        nodes = ca.horzcat(columns[: layout.node, :], last)
        x, node_inputs = nodes[: layout.nx, :], nodes[layout.nx :, :]
        own = columns[layout.node :, :]
        unit = 1.0 if phase.discrete else length
        times = start + length * ca.DM(mesh).T
        steps = unit * ca.DM(np.diff(mesh)).T if not phase.discrete else ca.DM.ones(1, N)
        fractions = times_of(layout.points, mesh)
        given = signal_at(phase, phase.start_time + phase.duration[0] * times_of(layout.signals, mesh).ravel())
        w = given.reshape(N, -1).T
        arguments = (
            x[:, :N],
            node_inputs[:, :N],
            own,
            x[:, 1:],
            node_inputs[:, 1:],
            ca.repmat(p, 1, N),
            times[:, :N],
            steps,
            w,
        )
        defects, costs, path = interval.map(N)(*arguments) if N > 1 else interval(*arguments)
        size = np.asarray(self.scale[k])[: layout.nx]
        many = defects.numel() // N
        first = self.height
        after = [c for c in layout.points if c > 0] or [1.0]
        places = (mesh[:-1, None] + np.diff(mesh)[:, None] * np.asarray(after)).repeat(layout.nx, axis=1)
        self._row(
            "dynamics",
            k,
            ca.vec(defects),
            0.0,
            0.0,
            np.tile(size, N * many // layout.nx),
            places.ravel(),
            phase.state_names,
        )
        part_defects = slice(first, self.height)
        first = self.height
        cost = ca.sum2(costs)
        x_end = x[:, N]
        if functions.path is not None:
            self._path_rows(k, functions, layout, path, fractions, x, node_inputs, own, p, start, length, w, N)
        part_path = slice(first, self.height)
        end_time = start + length
        if functions.terminal_cost is not None:
            cost = cost + functions.terminal_cost(x_end, p, end_time)
        if functions.boundary is not None:
            value = functions.boundary(x[:, 0], x_end, start, end_time, p)
            self._row("boundary", k, value, *functions.boundary_bounds, 1.0, np.ones(value.numel()), ())
        part = PhasePart(
            phase, functions, layout, self.scheme, mesh, *place, duration, part_defects, part_path, interval
        )
        return part, cost, x_end

    def _path_rows(self, k: int, functions: PhaseFunctions, layout: Layout, path: Any, fractions: Array, x: Any,
                   node_inputs: Any, own: Any, p: Any, start: Any, length: Any, w: Array, N: int) -> None:  # fmt: skip
        """Append what is kept along a phase: at the points of every interval, and at the end that these leave out."""
        assert functions.path is not None
        count = functions.path.numel_out(0)
        low, high = functions.path_bounds
        held = isinstance(self.scheme, MultipleShooting) or self.problem.phases[k].discrete
        inside = fractions if held else fractions[:, np.asarray(layout.points) > 0]
        places = inside.ravel().repeat(count)
        times = len(places) // count
        self._row("path", k, ca.vec(path), np.tile(low, times), np.tile(high, times), 1.0, places, ())
        if held:
            end = (x[:, N], own[:, N - 1], w[-layout.nw :, N - 1] if layout.nw else w[:, 0], p, start + length)
            self._row("path", k, functions.path(*end), low, high, 1.0, np.ones(count), ())
            return
        u = node_inputs[:, 0] if layout.node_inputs else ca.DM.zeros(layout.nu)
        begin = functions.path(x[:, 0], u, w[: layout.nw, 0], p, start)
        kept = (
            np.arange(count)
            if layout.node_inputs
            else np.flatnonzero(np.logical_not(_depends_on_input(functions.path)))
        )
        if len(kept):
            self._row("path", k, begin[kept.tolist()], low[kept], high[kept], 1.0, np.zeros(len(kept)), ())

    def _link(self, k: int, before: PhasePart, end: Any, begin: Any, p: Any) -> None:
        """Append that a phase begins where the one before it ends."""
        value = end if self.problem.link is None else self.problem.link_function(k - 1)(end, p)
        size = np.asarray(self.scale[k])[: begin.numel()]
        self._row("link", k, value - begin, 0.0, 0.0, size, np.zeros(begin.numel()), self.problem.phases[k].state_names)

    def _row(self, name: str, phase: int, value: Any, low: Any, high: Any, scale: Any, fractions: Any,
             entries: tuple[str, ...]) -> None:  # fmt: skip
        """Append constraints."""
        count = value.numel()
        self.g.append(value)
        full = tuple(np.array(np.broadcast_to(np.asarray(b, dtype=float), (count,))) for b in (low, high, scale))
        self.bounds.append(full)  # type: ignore[arg-type]
        places = np.array(np.broadcast_to(np.asarray(fractions, dtype=float), (count,)))
        self.rows.append(Rows(name, phase, self.height, self.height + count, places, tuple(entries)))
        self.height += count


def _depends_on_input(path: ca.Function) -> Array:
    """Which values of a path function depend on the input: with points that leave out 0 there is none at the start."""
    pattern = path.jac_sparsity(0, 1)
    depends = np.zeros(path.numel_out(0), dtype=bool)
    depends[list(pattern.row())] = True
    return depends


def check_at_guess(program: NonlinearProgram) -> None:
    """Raise an `InputError` unless cost and constraints are finite at the guess: it says which, and when."""
    values = ca.Function("values", [program.v], [program.f, program.g])(program.guess)
    f, g = (np.asarray(value, dtype=float).ravel() for value in values)
    wrong = np.flatnonzero(~np.isfinite(g))
    if len(wrong):
        got = f"{g[wrong[0]]:g} in {describe_row(program, int(wrong[0]), program.guess)}"
        raise InputError(
            "guess", got, "finite values where the solution starts from", "Give a `guess` away from the singular point."
        )
    if not np.isfinite(f[0]):
        raise InputError("guess", f"a cost of {f[0]:g}", "a finite one where the solution starts from")
