"""Nonlinear program of a transcribed optimal control problem."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from mpc.budgets import SHAKEN
from mpc.checks import Array
from mpc.optimal_control.derivatives import Derivatives
from mpc.optimal_control.interval import Layout, at_points, coordinates, counted_from
from mpc.optimal_control.phase import Phase, PhaseFunctions, signal_along
from mpc.optimal_control.pieces import Numbers, piece_of
from mpc.optimal_control.problem import OptimalControlProblem
from mpc.optimal_control.schemes import Collocation, Scheme
from mpc.tolerances import COST_ROUNDING, LEAST_INTERVAL, LEAST_MOVE, NEGLIGIBLE, ROUNDED_SUM, VIOLATION_PRICE


@dataclass(frozen=True)
class Rows:
    """Constraints of one kind: rows first … last − 1."""

    name: str
    phase: int  # which one; −1 for what all share
    first: int
    last: int
    fractions: Array  # (last − first,): of the phase, at which each stands
    entries: tuple[str, ...]  # what each row of one point is called, after which they repeat


@dataclass(frozen=True, eq=False)
class PhasePart:
    """Places of a phase's unknowns in the vector of all."""

    phase: Phase
    functions: PhaseFunctions
    layout: Layout
    scheme: Scheme
    mesh: Array  # (N + 1,): of fractions of the phase, from 0 to 1
    first: int  # its unknowns are first … last − 1: node, interval, node, interval, …, node
    start: float  # its start, less the free durations before it
    free: Numbers  # (k,): unknowns that are free durations before it, and last its own if that is free
    defects: slice  # its rows, interval by interval
    path: slice
    interval: ca.Function

    @property
    def intervals(self) -> int:
        """Number N of intervals."""
        return len(self.mesh) - 1

    @property
    def last(self) -> int:
        """Place after its last unknown."""
        return self.first + self.layout.column * self.intervals + self.layout.node

    @property
    def duration(self) -> int:
        """Place of its duration; −1 where that is given."""
        return int(self.free[-1]) if self.phase.free_duration else -1

    def clock(self, free: Any) -> tuple[Any, Any]:
        """Start and duration from the free durations (k,)."""
        before = len(self.free) - self.phase.free_duration
        start = self.start + sum(free[i] for i in range(before))
        return start, free[before] if self.phase.free_duration else self.phase.duration[0]

    @property
    def shares(self) -> Array:
        """Parts (N, points) of a phase that points stand for in integrals."""
        lengths, scheme = np.diff(self.mesh)[:, None], self.scheme
        if self.phase.discrete or not isinstance(scheme, Collocation):
            return lengths
        shares = np.asarray(lengths * scheme.matrix[-1])
        if scheme.points[0] == 0:  # a node belongs to both its intervals
            shares[:-1, -1] += shares[1:, 0]
        return shares

    @cached_property
    def coordinates(self) -> tuple[Numbers, Array]:
        """Coordinates (n,) of its unknowns, states before inputs, and fractions of the phase."""
        return coordinates(self.layout, self.mesh)

    @property
    def samples(self) -> tuple[Array, Array, Array, Numbers]:
        """Times (n,) from its start, data, signals and places (n, ·) of the states at its samples."""
        times, known = self.phase.samples
        fractions = times / self.phase.duration[0]
        interval = np.searchsorted(self.mesh, fractions - LEAST_INTERVAL)
        places = self.first + self.layout.column * interval[:, None] + np.arange(self.layout.nx)
        return times, known, signal_along(self.phase, fractions[:, None]), places

    def unknowns(self, v: Array) -> tuple[Array, Array, list[Array], list[Array]]:
        """Unknowns of nodes (node, N + 1), intervals (own, N), states, inputs at points."""
        nx, node, cut = self.layout.nx, self.layout.node, self.first + self.layout.column * self.intervals
        columns = v[self.first : cut].reshape(self.intervals, self.layout.column).T
        nodes, own = np.column_stack([columns[:node], v[cut : self.last]]), columns[node:]
        x, shared = nodes[:nx], nodes[nx:]
        return nodes, own, *at_points(self.layout, x[:, :-1], shared[:, :-1], own, x[:, 1:], shared[:, 1:])


@dataclass(frozen=True, eq=False)
class SizedProgram:
    """Bounds and sizes of a program, which is what a solver needs of it.

    Unknowns are `centre` plus `scale` times what the solver sees, and rows alike: what it allows them beyond a bound
    grows with the bound.
    """

    lower: Array
    upper: Array
    scale: Array
    centre: Array
    row_lower: Array
    row_upper: Array
    row_scale: Array
    row_centre: Array
    derivatives: Derivatives
    cost_scale: float = field(default=1.0, kw_only=True)

    @property
    def limited(self) -> Numbers:
        """Rows that have a bound."""
        return np.flatnonzero(np.isfinite(self.row_lower) | np.isfinite(self.row_upper))


@dataclass(frozen=True, eq=False)
class NonlinearProgram(SizedProgram):
    """Nonlinear program min f(v) with bounds on v and g(v).

    Attributes
    ----------
    problem : OptimalControlProblem
    v, f, g : casadi.MX
        Unknowns, cost and constraints.
    lower, upper, guess, scale, centre : (n,) arrays
        Bounds, where to start, and sizes of the unknowns, counted from `centre`.
    cost_scale : float
    row_lower, row_upper, row_scale, row_centre : (m,) arrays
    rows : tuple of Rows
    parts : tuple of PhasePart
    parameters : slice
        Of p among the unknowns.
    costs : slice
        Of the largest cost of a scenario, or the costs of all and their spread, among the unknowns; empty for a sum.
    derivatives : Derivatives
        Values and derivatives of f and g as functions of v.
    """

    problem: OptimalControlProblem
    guess: Array
    rows: tuple[Rows, ...]
    parts: tuple[PhasePart, ...]
    parameters: slice
    costs: slice

    def __repr__(self) -> str:
        kinds = ", ".join(f"{part.intervals} intervals of {part.scheme.name}" for part in self.parts)
        return f"NonlinearProgram({len(self.lower)} unknowns, {len(self.row_lower)} constraints, {kinds})"

    @property
    def v(self) -> ca.MX:
        """Unknowns (n,)."""
        return self.derivatives.v

    @property
    def f(self) -> ca.MX:
        """Cost."""
        return self.derivatives.f

    @property
    def g(self) -> ca.MX:
        """Constraints (m,)."""
        return self.derivatives.g

    def times(self, v: Array) -> list[tuple[float, float]]:
        """Start and duration of every phase, from unknowns (n,)."""
        return [(float(start), float(length)) for start, length in (part.clock(v[part.free]) for part in self.parts)]


def rescaled(
    program: NonlinearProgram, v: Array, *, centred: bool = False, unbounded: bool = False
) -> NonlinearProgram:  # fmt: skip
    """Program with unknowns, dynamics and cost sized at unknowns (n,).

    If `centred`, at a solution, what moves by less than a hundredth of its size is counted from nearer by. If
    `unbounded` bounds tell no size either, however little anything moves beside them.
    """
    scale, row_scale, centre = program.scale.copy(), program.row_scale.copy(), program.centre.copy()
    negligible = ROUNDED_SUM if unbounded else NEGLIGIBLE
    for part in program.parts:
        layout = part.layout
        own, sizes, about = (each[part.first : part.last] for each in (v, scale, centre))
        coordinate, _ = part.coordinates
        for i in range(layout.nx + layout.nu):
            one = coordinate == i
            values, least = own[one], negligible * sizes[one].max()
            size = np.ptp(values) / LEAST_MOVE
            moves = size > np.sqrt(np.finfo(float).eps) * np.abs(values).max()
            if centred and moves and size < np.abs(values - about[one]).max():
                about[one], least = counted_from(values.min(), values.max(), size), 0.0
            largest = np.abs(values - about[one]).max()
            if largest > least:
                sizes[one] = largest
        rows = part.defects.stop - part.defects.start
        row_scale[part.defects] = np.tile(sizes[: layout.nx], rows // layout.nx)
    places = slice(program.costs.stop or None)  # violations, which vanish where limits are kept, stand behind
    own = np.concatenate([np.arange(part.first, part.last) for part in program.parts])
    loose = np.setdiff1d(np.arange(len(v))[places], own)
    loose = loose[~(np.isfinite(program.lower) & np.isfinite(program.upper))[loose] | unbounded]
    large = np.abs((v - centre)[loose])
    scale[loose] = np.where(large > negligible * scale[loose], large, scale[loose])
    slope = np.asarray(program.derivatives.jacobian[0](v)[1], dtype=float).ravel()
    size = float(np.abs(slope * scale * (program.lower < program.upper))[places].max(initial=0.0))
    cost_scale = size if np.isfinite(size) and size > 0 else 1.0
    return with_sizes_of_rows(
        replace(program, scale=scale, row_scale=row_scale, centre=centre, guess=v, cost_scale=cost_scale)
    )


def longer(program: NonlinearProgram, v: Array) -> Iterator[Array]:
    """Unknowns with longer free durations, up to their bounds; none where all are given."""
    free = [part.duration for part in program.parts if part.duration >= 0]
    upper = program.upper[free]
    for share in (0.5, 1.0) if free else ():
        other = v.copy()
        other[free] = v[free] * np.where(np.isfinite(upper), (upper / v[free]) ** share, 100.0**share)
        yield other


def sized_as(program: NonlinearProgram, other: NonlinearProgram) -> NonlinearProgram:
    """Program with the sizes that states, inputs and parameters have in another of the same phases."""
    scale, centre = program.scale.copy(), program.centre.copy()
    for own, its in ((scale, other.scale), (centre, other.centre)):
        own[program.parameters] = its[other.parameters]
        for part, same in zip(program.parts, other.parts):
            numbers, _ = part.coordinates
            _, first = np.unique(same.coordinates[0], return_index=True)  # as all points of a coordinate have
            own[part.first : part.last] = its[same.first : same.last][first][numbers]
            if min(part.duration, same.duration) >= 0:
                own[part.duration] = its[same.duration]
    return replace(program, scale=scale, centre=centre)


def with_sizes_of_rows(program: NonlinearProgram) -> NonlinearProgram:
    """Program with constraints sized by their change over the unknowns' sizes.

    One size for all points of an entry, that of the point where it changes most; of unknowns that are held only where
    it depends on no other. Each is counted from near that of its bounds which is nearest to its value.
    """
    row_scale = program.row_scale.copy()
    values, slope = program.derivatives.jacobian[1](program.guess)
    slope, value = abs(slope.sparse()), np.nan_to_num(np.asarray(values, dtype=float).ravel())
    sizes = program.scale * (program.lower < program.upper), program.scale
    steepest = [slope.multiply(size[None]).max(axis=1).toarray().ravel() for size in sizes]
    for rows in program.rows:
        if rows.name in ("dynamics", "link"):
            continue
        own = [each[rows.first : rows.last].reshape(-1, len(rows.entries)) for each in steepest]
        free, held = (each.max(axis=0) for each in own)
        size = np.where(free > 0, free, held)
        size = np.where(np.isfinite(size) & (size > 0), size, 1.0)
        row_scale[rows.first : rows.last] = np.tile(size, len(own[0]))
    low, high = program.row_lower, program.row_upper
    bound = np.where(np.abs(value - low) < np.abs(high - value), low, high)
    bound = np.where(np.isfinite(bound), bound, 0.0)
    return replace(program, row_scale=row_scale, row_centre=counted_from(bound, bound, row_scale))


def with_costs_of_scenarios(program: NonlinearProgram) -> NonlinearProgram:
    """Program with scenario costs evaluated at the guess."""
    own = program.costs
    if own.stop == own.start:
        return program
    guess, scale = program.guess.copy(), program.scale.copy()
    guess[own] = costs_of_scenarios(program, guess)
    scale[own] = np.where(np.isfinite(guess[own]) & (guess[own] != 0), np.abs(guess[own]), 1.0)
    return replace(program, guess=guess, scale=scale)


def costs_of_scenarios(program: NonlinearProgram, v: Array) -> Array:
    """Scenario costs at unknowns (n,): the largest, or each and then their spread."""
    count = len(program.parts)
    g = np.asarray(program.derivatives.values(v)[1], dtype=float).ravel()
    own = v[program.costs]
    each: Array = g[:count] + own[:count]
    if len(own) == 1:
        return np.atleast_1d(each.max())
    parts = program.problem.weights / program.problem.weights.sum()
    about = each - parts @ each
    spread = np.sqrt(parts @ about**2 + COST_ROUNDING**2 * (parts @ each**2))
    return np.concatenate([each, [spread]])


def elastic(program: NonlinearProgram, start: Array) -> NonlinearProgram:
    """Program with the sum of scaled violations as cost."""
    n, m = len(program.lower), len(program.row_lower)
    pieces = [
        replace(piece, factors=np.where(piece.of_cost, 0.0, piece.factors)) for piece in program.derivatives.pieces
    ]
    places = np.arange(m)[None]
    pieces.append(piece_of(
        lambda above, below, data: [(above + below) / data, above - below], ca.SX,
        {"above": n + places, "below": n + m + places}, np.vstack([0 * places, 1 + places]),
        factors=np.array([1.0, -1.0]), data=program.row_scale[None],
    ))  # fmt: skip
    derivatives = Derivatives(pieces, n + 2 * m, m)
    g = np.asarray(program.derivatives.values(start)[1], dtype=float).ravel()
    g = np.where(np.isfinite(g), g, 0.0)
    above, below = np.maximum(g - program.row_upper, 0.0), np.maximum(program.row_lower - g, 0.0)
    return replace(
        program, derivatives=derivatives, costs=slice(0, 0), cost_scale=1.0,
        lower=np.concatenate([program.lower, np.zeros(2 * m)]),
        upper=np.concatenate([program.upper, np.full(2 * m, np.inf)]),
        guess=np.concatenate([start, above, below]),
        scale=np.concatenate([program.scale, program.row_scale, program.row_scale]),
        centre=np.append(program.centre, np.zeros(2 * m)),
    )  # fmt: skip


def relaxable(program: NonlinearProgram, rows: NDArray[np.bool_]) -> NonlinearProgram:
    """Program with violations of `rows` (m,) and then a price of each as further unknowns, all held at 0."""
    n, m, sides = len(program.lower), len(program.row_lower), places_of_violations(program, rows)
    pieces, count = list(program.derivatives.pieces), sum(map(len, sides))
    for chosen, first, sign in zip(sides, (n, n + len(sides[0])), (-1.0, 1.0)):
        own, targets = first + np.arange(len(chosen))[None], np.vstack([0 * chosen, 1 + chosen])
        places = {"e": own, "price": count + own}
        weighed = piece_of(lambda e, price, data: [price * e, e], ca.SX, places, targets, factors=np.array([1.0, sign]))
        pieces += [weighed] if len(chosen) else []
    none, sizes = np.zeros(2 * count), program.row_scale[np.concatenate(sides)] / VIOLATION_PRICE
    return replace(
        program, derivatives=Derivatives(pieces, n + 2 * count, m), lower=np.append(program.lower, none),
        upper=np.append(program.upper, none), guess=np.append(program.guess, none),
        scale=np.concatenate([program.scale, sizes, np.ones(count)]), centre=np.append(program.centre, none),
    )  # fmt: skip


def places_of_violations(program: NonlinearProgram, rows: NDArray[np.bool_]) -> tuple[Numbers, Numbers]:
    """Places of rows (m,) with an upper bound, and with a lower one."""
    return np.flatnonzero(rows & np.isfinite(program.row_upper)), np.flatnonzero(rows & np.isfinite(program.row_lower))


def shaken(program: NonlinearProgram, seed: int = 0, *, about: Array | None = None, size: float = SHAKEN,
           waves: int = 2) -> Array:  # fmt: skip
    """Unknowns, the guess by default, moved along slow waves."""
    random = np.random.default_rng(seed)
    move = random.uniform(-1, 1, len(program.lower))
    for part in program.parts:
        of, fractions = part.coordinates
        heights = random.normal(size=(part.layout.nx + part.layout.nu, waves)) / (1 + np.arange(waves))
        shapes = np.cos(np.pi * fractions[:, None] * np.arange(waves))
        move[part.first : part.last] = (heights[of] * shapes).sum(axis=1)
    v = program.guess if about is None else about
    return np.clip(v + size * move * program.scale, program.lower, program.upper)


def unwound(program: NonlinearProgram, v: Array) -> Array:
    """Unknowns whose unbounded inputs are as continuous as they can be, if they are angles.

    An input is one, in radians or degrees, if whole turns of it leave cost and rows as they are: it begins within half
    a turn, and each value is within half a turn of the one before.
    """

    def values(v: Array) -> Array:
        """Cost and rows, in their sizes."""
        f, g = (np.asarray(value, dtype=float).ravel() for value in program.derivatives.values(v))
        return np.concatenate([f / program.cost_scale, g / program.row_scale])

    for part, turn in product(program.parts, (2 * np.pi, 360.0)):
        numbers, at = part.coordinates
        for i in range(part.layout.nx, part.layout.nx + part.layout.nu):
            own = np.flatnonzero(numbers == i)
            own = part.first + own[np.argsort(at[own], kind="stable")]
            if len(own) and not np.isfinite([program.lower[own], program.upper[own]]).any():
                angle, turned = np.unwrap(v[own], period=turn), v.copy()
                turned[own] = angle - turn * np.round(angle[0] / turn)
                moved = (turned != v).any()
                if moved and np.abs(values(turned) - values(v)).max() <= np.sqrt(np.finfo(float).eps):
                    v = turned
    return v
