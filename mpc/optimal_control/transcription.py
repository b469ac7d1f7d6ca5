"""Transcription of an optimal control problem on a mesh."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from ccdtools_ground.door import as_instance
from mpc.checks import Array, as_count, as_floats
from mpc.exceptions import InputError
from mpc.optimal_control.algebraic import collocated, eliminated
from mpc.optimal_control.derivatives import Derivatives
from mpc.optimal_control.interval import Layout, first_duration, layout_of, phase_unknowns, sized, times_of
from mpc.optimal_control.notes import check_at_guess
from mpc.optimal_control.phase import Phase, signal_along
from mpc.optimal_control.pieces import Numbers, Piece, interval_function, kind_of, piece_of
from mpc.optimal_control.problem import OptimalControlProblem
from mpc.optimal_control.program import NonlinearProgram, PhasePart, Rows, with_costs_of_scenarios, with_sizes_of_rows
from mpc.optimal_control.schemes import Collocation, MultipleShooting, Radau, Scheme
from mpc.tolerances import COST_ROUNDING, LEAST_INTERVAL


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
    as_instance("problem", problem, OptimalControlProblem, "an OptimalControlProblem or a Phase")
    scheme = Radau(3) if scheme is None else scheme
    expected = "Radau(), Trapezoidal(), HermiteSimpson() or MultipleShooting()"
    as_instance("scheme", scheme, (Collocation, MultipleShooting), expected)
    if any(phase.algebraic is not None for phase in problem.phases):
        unknown = isinstance(scheme, Collocation)  # z at the points; else an expression
        stated = [
            phase if phase.algebraic is None
            else (collocated if unknown and not phase.discrete else eliminated)(phase, problem.parameters)
            for phase in problem.phases
        ]  # fmt: skip
        problem = replace(problem, phases=stated)
    program = _Assembly(problem, scheme, _as_meshes(problem, intervals, meshes)).program()
    check_at_guess(program)
    return with_sizes_of_rows(with_costs_of_scenarios(program))


class _Assembly:
    """Unknowns, constraints and pieces of a program, collected phase by phase."""

    def __init__(self, problem: OptimalControlProblem, scheme: Scheme, meshes: list[Array]) -> None:
        self.problem = problem
        self.scheme = scheme
        self.meshes = meshes
        self.unknowns: list[tuple[Array, ...]] = []  # both bounds, guesses, sizes, and where they are counted from
        self.bounds: list[tuple[Array, ...]] = []  # of constraints, and their sizes
        self.kinds: list[Rows] = []
        self.pieces: list[Piece] = []

    def program(self) -> NonlinearProgram:
        """Whole program, its rows not yet sized."""
        problem = self.problem
        p_guess = np.asarray(problem.p_guess)
        layouts = [layout_of(phase, own.nw, self.scheme) for phase, own in zip(problem.phases, problem.functions)]
        firsts = [
            self._unknown(*phase_unknowns(phase, functions, p_guess, layout, mesh))
            for phase, functions, layout, mesh in zip(problem.phases, problem.functions, layouts, self.meshes)
        ]
        durations = [-1] * len(problem.phases)
        for k, phase in enumerate(problem.phases):
            if phase.free_duration:
                low, high = phase.duration
                guess = np.array([first_duration(phase)])  # its size, too: bounds of durations are often far away
                durations[k] = self._unknown(np.array([low]), np.array([high]), guess, guess, 0 * guess)
        low, high = problem.p_bounds
        first = self._unknown(low, high, p_guess)
        self.p = first + np.arange(problem.parameters)
        costs = self._costs_of_scenarios()
        alone = costs.stop > costs.start
        parts: list[PhasePart] = []
        for k, phase in enumerate(problem.phases):
            before = range(k) if problem.linked else range(0)
            start = problem.phases[0 if problem.linked else k].start_time
            start += sum(problem.phases[i].duration[0] for i in before if durations[i] < 0)
            free = np.array([durations[i] for i in (*before, k) if durations[i] >= 0], dtype=int)
            defects, path, interval = self._rows_of_intervals(k, layouts[k])
            part = PhasePart(phase, problem.functions[k], layouts[k], self.scheme, self.meshes[k], firsts[k], start,
                             free, defects, path, interval)  # fmt: skip
            parts.append(part)
            cost = (1 + k, 1.0) if alone else (0, float(problem.weights[k]))
            self._intervals(part, *cost)
            self._path_at_an_end(k, part, *cost)
            self._ends(k, part, *cost)
            self._samples(part, *cost)
            if k and problem.linked:
                self._link(k, *parts[-2:])
        self._of_parameters()
        lower, upper, guess, scale, centre = (np.concatenate(sides) for sides in zip(*self.unknowns))
        row_lower, row_upper, row_scale = (np.concatenate(sides) for sides in zip(*self.bounds))
        return NonlinearProgram(
            problem=problem, lower=lower, upper=upper, guess=guess, scale=scale, centre=centre, row_lower=row_lower,
            row_upper=row_upper, row_scale=row_scale, row_centre=0 * row_scale,
            rows=tuple(self.kinds), parts=tuple(parts),
            parameters=slice(first, first + len(self.p)), costs=costs,
            derivatives=Derivatives(self.pieces, len(lower), len(row_lower)),
        )  # fmt: skip

    def _unknown(self, lower: Array, upper: Array, guess: Array, *told: Array) -> int:
        """Append unknowns; return the place of the first."""
        first = sum(len(lower) for lower, *_ in self.unknowns)
        size, centre = told or sized(lower, upper, guess)
        self.unknowns.append((lower, upper, guess, np.nan_to_num(size, nan=1.0), centre))
        return first

    def _rows(self, name: str, phase: int, entries: Sequence[str], fractions: Any, low: Any, high: Any,
              scale: Any) -> slice:  # fmt: skip
        """Append constraints `entries` at fractions of a phase; return their places."""
        at = np.ravel(fractions)
        each = np.broadcast_arrays(low, high, scale, np.zeros(len(entries)))[:3]
        sides = tuple(np.tile(side.astype(float), len(at)) for side in each)
        first = self.kinds[-1].last if self.kinds else 0
        own = slice(first, first + len(sides[0]))
        self.bounds.append(sides)
        if own.stop > first:
            self.kinds.append(Rows(name, phase, first, own.stop, at.repeat(len(entries)), tuple(entries)))
        return own

    def _piece(self, values: Callable[..., Any], places: dict[str, Numbers], rows: Numbers, *functions: Any,
               factors: Array | None = None, data: Array | None = None) -> None:  # fmt: skip
        """Append values that `functions` make of unknowns to rows of [f; g]."""
        self.pieces.append(piece_of(values, kind_of(*functions), places, rows, factors=factors, data=data))

    def _costs_of_scenarios(self) -> slice:
        """Append the unknown costs of scenarios that are not summed, and their spread where it counts.

        The spread is the s of least (variance/s + s)/2: a root in the cost has a kink where all costs are equal.
        """
        problem, count = self.problem, len(self.problem.phases)
        weights = problem.weights
        worst = problem.risk == "worst" or weights.min() * (1 + problem.spread**2) >= weights.sum()
        many = 0 if problem.risk == "sum" or count == 1 else 1 if worst else count
        first = self._unknown(np.full(many, -np.inf), np.full(many, np.inf), np.zeros(many))
        if not many:
            return slice(first, first)
        if not worst:
            self._unknown(np.zeros(1), np.full(1, np.inf), np.ones(1))
        named = [f"cost of scenario {k + 1}" for k in range(count)]
        self._rows("cost of a scenario", -1, named, 0.0, -np.inf, 0.0, 1.0)
        places = np.broadcast_to(np.arange(first, first + many), (1, count))
        self._piece(lambda z, data: [z], {"z": places}, 1 + np.arange(count)[None], factors=-np.ones(1))

        def objective(z: Any, data: Any) -> list[Any]:
            if worst:
                return [z]
            z, spread = z[:-1], z[-1]
            parts = ca.DM(weights / weights.sum())
            mean = ca.dot(parts, z)
            variance = ca.dot(parts, (z - mean) ** 2) + COST_ROUNDING**2 * ca.dot(parts, z**2)
            return [mean + problem.spread / 2 * (variance / spread + spread)]

        unknowns = many + (not worst)
        self._piece(objective, {"z": first + np.arange(unknowns)}, np.zeros(1, dtype=int))
        return slice(first, first + unknowns)

    def _rows_of_intervals(self, k: int, layout: Layout) -> tuple[slice, slice, ca.Function]:
        """Append the constraints of a phase's intervals; return their places and their function."""
        phase, functions, mesh = self.problem.phases[k], self.problem.functions[k], self.meshes[k]
        after = [c for c in layout.points if c > 0]
        named = [f"dynamics of {name}" for name in phase.state_names]
        size = self.unknowns[k][3][: layout.nx]
        defects = self._rows("dynamics", k, named, times_of(after or [1.0], mesh), 0.0, 0.0, size)
        kept_at = times_of(after or [0.0], mesh)
        path = self._rows("path", k, functions.path_names, kept_at, *functions.path_bounds, 1.0)
        return defects, path, interval_function(phase, functions, self.scheme, layout, len(self.p))

    def _intervals(self, part: PhasePart, target: int, weight: float) -> None:
        """Append costs and equations of a phase's intervals."""
        phase, layout, N = part.phase, part.layout, part.intervals
        signals = signal_along(phase, times_of(layout.signals, part.mesh)).T

        def values(p: Any, free: Any, data: Any, **own: Any) -> list[Any]:
            start, length = part.clock(free)
            step = 1.0 if phase.discrete else length * data[1]
            defects, cost, path = part.interval(*own.values(), p, start + length * data[0], step, data[2:])
            return [cost, defects, path]

        cuts = np.cumsum([layout.nx, layout.node_inputs, layout.own, layout.nx])
        begins = part.first + layout.column * np.arange(N)
        own = [at[:, None] + begins for at in np.split(np.arange(layout.column + layout.node), cuts)]
        places = dict(zip(("x", "v", "own", "x_next", "v_next"), own)) | {"p": self.p, "free": part.free}
        equations = [_numbers(rows).reshape(N, -1).T for rows in (part.defects, part.path)]
        rows = np.vstack([np.full((1, N), target), *equations])
        factors = np.where(np.arange(len(rows)) > 0, 1.0, weight)
        data = np.vstack([part.mesh[:-1], np.diff(part.mesh), signals])
        self._piece(values, places, rows, part.interval, factors=factors, data=data)
        if part.functions.path is not None:
            every, shares = np.arange(len(part.functions.path_names)), part.shares
            kept = shares[:, layout.points[0] == 0 :] if shares.shape[1] > 1 else shares
            self._soften(part, part.path, every, kept.ravel(), target, weight)

    def _path_at_an_end(self, k: int, part: PhasePart, target: int, weight: float) -> None:
        """Append path limits at the end that the intervals leave out."""
        path, layout = part.functions.path, part.layout
        if path is None:
            return
        low, high = part.functions.path_bounds
        kept = np.arange(len(low))
        if layout.points == (0.0,):  # with the input that is held last, where it acts
            fraction, share = 1.0, 1 - part.mesh[-2]
            node = part.last - layout.node
            inputs = node - layout.nu + np.arange(layout.nu * part.phase.held)
        else:
            fraction, share = 0.0, part.shares[0, 0] if layout.points[0] == 0 else 0.0
            node = part.first
            inputs = node + layout.nx + np.arange(layout.node_inputs)
            if not share:  # the start is given no time, so no price counts there
                kept = kept[np.isinf(part.functions.path_prices[:, kept]).all(axis=0)]
        if not len(inputs):
            kept = np.setdiff1d(kept, path.jac_sparsity(0, 1).row())
        if not len(kept):
            return

        def values(x: Any, u: Any, p: Any, free: Any, data: Any) -> list[Any]:
            start, length = part.clock(free)
            given = u if u.numel() == layout.nu else ca.DM.zeros(layout.nu)
            return [path(x, given, data, p, start + fraction * length)[kept.tolist()]]

        names = [part.functions.path_names[i] for i in kept]
        rows = self._rows("path", k, names, fraction, low[kept], high[kept], 1.0)
        places = {"x": node + np.arange(layout.nx), "u": inputs} | {"p": self.p, "free": part.free}
        self._piece(values, places, _numbers(rows), path, data=signal_along(part.phase, np.array([[fraction]])).T)
        self._soften(part, rows, kept, np.array([share]), target, weight)

    def _soften(self, part: PhasePart, rows: slice, entries: Numbers, share: Array, target: int,
                weight: float) -> None:  # fmt: skip
        """Let priced path limits `entries`, each at points of so large a part of the phase, be violated."""
        prices = part.functions.path_prices[:, entries]
        numbers = np.arange(rows.start, rows.stop).reshape(-1, len(entries))
        for side, sign in zip(part.functions.path_bounds, (1.0, -1.0)):
            soft = np.flatnonzero(np.isfinite(prices).all(axis=0) & np.isfinite(side[entries]))
            if not len(soft):
                continue
            count = len(share) * len(soft)
            first = self._unknown(np.zeros(count), np.full(count, np.inf), np.zeros(count))
            data = np.vstack([share.repeat(len(soft)), np.tile(prices[:, soft], len(share))])

            def values(e: Any, free: Any, data: Any) -> list[Any]:
                time = 1.0 if part.phase.discrete else part.clock(free)[1] * data[0]
                return [time * (data[1] * e + data[2] * e**2), e]

            targets = np.vstack([np.full((1, count), target), 1 + numbers[:, soft].reshape(1, -1)])
            places = {"e": first + np.arange(count)[None], "free": part.free[:, None]}
            self._piece(values, places, targets, factors=np.array([weight, sign]), data=data)

    def _ends(self, k: int, part: PhasePart, target: int, weight: float) -> None:
        """Append a phase's terminal cost and boundary conditions."""
        cost, boundary = part.functions.terminal_cost, part.functions.boundary
        if cost is None and boundary is None:
            return

        def values(x0: Any, x: Any, p: Any, free: Any, data: Any) -> list[Any]:
            start, length = part.clock(free)
            found = [] if cost is None else [cost(x, data, p, start + length)]
            return found if boundary is None else [*found, boundary(x0, x, data, start, start + length, p)]

        names = part.functions.boundary_names
        rows = _numbers(self._rows("boundary", k, names, 1.0, *part.functions.boundary_bounds, 1.0))
        targets = rows if cost is None else np.append(target, rows)
        factors = np.where(targets == target, weight, 1.0)
        node = np.arange(part.layout.nx)
        nodes = {"x0": part.first + node, "x": part.last - part.layout.node + node}
        places, signal = nodes | {"p": self.p, "free": part.free}, signal_along(part.phase, np.ones((1, 1))).T
        self._piece(values, places, targets, cost, boundary, factors=factors, data=signal)

    def _samples(self, part: PhasePart, target: int, weight: float) -> None:
        """Append a phase's cost at its samples."""
        cost, layout = part.functions.sample_cost, part.layout
        if cost is None:
            return
        times, known, signals, at = part.samples

        def values(x: Any, p: Any, free: Any, data: Any) -> list[Any]:
            at = data[1 : 1 + layout.nw], p, part.clock(free)[0] + data[0]
            return [cost(x, *at, data[1 + layout.nw :])]

        places = {"x": at.T, "p": self.p[:, None], "free": part.free[:, None]}
        rows, data = np.full((1, len(times)), target), np.vstack([times, signals.T, known.T])
        self._piece(values, places, rows, cost, factors=np.array([weight]), data=data)

    def _link(self, k: int, before: PhasePart, after: PhasePart) -> None:
        """Append that a phase begins where its predecessor ends."""
        link = self.problem.link_functions[k - 1]

        def values(end: Any, begin: Any, p: Any, free: Any, data: Any) -> list[Any]:
            return [(end if link is None else link(end, p, after.clock(free)[0])) - begin]

        named = [f"link of {name}" for name in after.phase.state_names]
        rows = self._rows("link", k, named, 0.0, 0.0, 0.0, self.unknowns[k][3][: after.layout.nx])
        end = before.last - before.layout.node + np.arange(before.layout.nx)
        places = {"end": end, "begin": after.first + np.arange(after.layout.nx)} | {"p": self.p, "free": after.free}
        self._piece(values, places, _numbers(rows), link)

    def _of_parameters(self) -> None:
        """Append cost and constraints of the parameters."""
        functions = self.problem.of_parameters
        cost = functions[0]
        rows = _numbers(self._rows("p_constraints", -1, self.problem.p_constraint_names, 0.0, -np.inf, 0.0, 1.0))
        targets = rows if cost is None else np.append(0, rows)
        if len(targets):
            stated = [function for function in functions if function is not None]
            self._piece(lambda p, data: [function(p) for function in stated], {"p": self.p}, targets, *stated)


def _numbers(rows: slice) -> Numbers:
    """Numbers of constraints in [f; g]."""
    return 1 + np.arange(rows.start, rows.stop)


def _as_meshes(problem: OptimalControlProblem, intervals: Any, meshes: Any) -> list[Array]:
    """Mesh fractions of every phase."""
    count = len(problem.phases)
    if meshes is None:
        several = getattr(intervals, "ndim", hasattr(intervals, "__len__"))
        each = list(intervals) if several else [intervals] * count
        if len(each) != count:
            raise InputError("intervals", f"{len(each)} numbers", f"{count}, one a phase")
        meshes = [np.linspace(0, 1, as_count("intervals", n) + 1) for n in each]
    as_instance("meshes", meshes, (list, tuple, np.ndarray), "a list of meshes, one a phase")
    if len(meshes) != count:
        raise InputError("meshes", f"{len(meshes)} of them", f"{count}, one a phase")
    checked = []
    for phase, given in zip(problem.phases, meshes):
        if phase.discrete:
            given = np.linspace(0, 1, int(phase.duration[0]) + 1)
        mesh = as_floats("meshes", given)
        if mesh.ndim != 1 or len(mesh) < 2 or mesh[0] != 0 or mesh[-1] != 1 or not (np.diff(mesh) > 0).all():
            raise InputError("meshes", mesh, "fractions of the phase that rise from 0 to 1")
        checked.append(_with_samples(phase, mesh))
    return checked


def _with_samples(phase: Phase, mesh: Array) -> Array:
    """Mesh with the samples of a phase among its points."""
    if phase.samples is None or phase.discrete:
        return mesh
    own = phase.samples[0] / phase.duration[0]
    apart = np.abs(mesh[:, None] - own).min(axis=1) > LEAST_INTERVAL
    apart[[0, -1]] = True
    inner = own[(own > LEAST_INTERVAL) & (own < 1 - LEAST_INTERVAL)]
    return np.sort(np.concatenate([mesh[apart], inner]))
