"""Equations of one phase: intervals, path and ends."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from mpc.checks import Array
from mpc.optimal_control.assembly import Assembly
from mpc.optimal_control.interval import Layout, interval_function, times_of
from mpc.optimal_control.phase import Phase, PhaseFunctions, signal_at
from mpc.optimal_control.pieces import Clock, Numbers, end_piece, interval_piece, path_piece
from mpc.optimal_control.program import PhasePart
from mpc.optimal_control.schemes import MultipleShooting, Scheme


@dataclass(frozen=True, eq=False)
class PhaseToCome:
    """Phase whose equations are to be appended."""

    number: int
    phase: Phase
    functions: PhaseFunctions
    scheme: Scheme
    mesh: Array  # (N + 1,): of fractions of the phase
    layout: Layout
    clock: Clock
    # places of its first unknown, and of its duration; −1 where that is given
    first: int
    duration: int
    p: Numbers  # (np,): places of the parameters
    target: int  # its cost is added to this row of [f; g], times `weight`
    weight: float

    @property
    def shared(self) -> Numbers:
        """Places of the parameters and free durations of all intervals."""
        return np.concatenate([self.p, self.clock.free])

    @property
    def held(self) -> bool:
        """Whether inputs are held and limits kept at interval begins."""
        return isinstance(self.scheme, MultipleShooting) or self.phase.discrete


def phase_equations(into: Assembly, own: PhaseToCome) -> PhasePart:
    """Append the equations of a phase; return their places."""
    phase, functions, scheme, mesh, layout = own.phase, own.functions, own.scheme, own.mesh, own.layout
    N, first = len(mesh) - 1, own.first
    interval = interval_function(phase, functions, scheme, layout, len(own.p))
    of_defects, of_path = interval.numel_out("defects"), interval.numel_out("path")
    after = [c for c in layout.points if c > 0] or [1.0]
    size = np.tile(into.scale[own.number][: layout.nx], N * of_defects // layout.nx)
    places = times_of(after, mesh).ravel().repeat(layout.nx)
    named = [f"dynamics of {name}" for name in phase.state_names]
    defects = into.rows("dynamics", own.number, named, len(size) // layout.nx, 0.0, 0.0, size, places)
    low, high = functions.path_bounds
    kept_at = [c for c in layout.points if own.held or c > 0]
    times = N * len(kept_at)
    places = times_of(kept_at, mesh).ravel().repeat(len(low))
    low, high = np.tile(low, times), np.tile(high, times)
    path = into.rows("path", own.number, functions.path_names, times, low, high, 1.0, places)
    signals = signal_at(phase, phase.start_time + phase.duration[0] * times_of(layout.signals, mesh).ravel())
    w = signals.reshape(N, -1).T
    into.piece(
        interval_piece(interval, layout, own.clock, len(own.p), phase.discrete),
        np.vstack([
            first + np.arange(layout.column + layout.node)[:, None] + layout.column * np.arange(N),
            np.tile(own.shared[:, None], (1, N)),
        ]),
        1 + np.vstack([
            np.full((1, N), own.target - 1),
            np.arange(defects.start, defects.stop).reshape(N, -1).T,
            np.arange(path.start, path.stop).reshape(N, of_path).T,
        ]),
        np.concatenate([[own.weight], np.ones(of_defects + of_path)]),
        np.vstack([mesh[:-1], np.diff(mesh), w]),
    )  # fmt: skip
    last = first + layout.column * N + layout.node
    if functions.path is not None:
        _path_at_an_end(into, own, w)
    if functions.terminal_cost is not None or functions.boundary is not None:
        _ends(into, own, last)
    return PhasePart(phase, functions, layout, scheme, mesh, first, last, own.duration, defects, path, interval)


def _path_at_an_end(into: Assembly, own: PhaseToCome, w: Array) -> None:
    """Append path limits at the end that the intervals leave out."""
    functions, layout, first, fraction = own.functions, own.layout, own.first, 1.0 if own.held else 0.0
    assert functions.path is not None
    low, high = functions.path_bounds
    N = len(own.mesh) - 1
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
    rows = into.rows("path", own.number, names, 1, low[kept], high[kept], 1.0, fraction)
    function = path_piece(functions, own.clock, layout, len(own.p), fraction, kept)
    at = np.concatenate([node + np.arange(layout.nx), inputs, own.shared])
    into.piece(function, at[:, None], 1 + np.arange(rows.start, rows.stop)[:, None], np.ones(len(kept)),
               signal[:, None])  # fmt: skip


def _ends(into: Assembly, own: PhaseToCome, last: int) -> None:
    """Append a phase's terminal cost and boundary conditions."""
    functions, layout = own.functions, own.layout
    targets, factors = [], []
    if functions.terminal_cost is not None:
        targets.append(np.array([own.target]))
        factors.append(np.array([own.weight]))
    if functions.boundary is not None:
        count = functions.boundary.numel_out(0)
        rows = into.rows("boundary", own.number, functions.boundary_names, 1, *functions.boundary_bounds, 1.0, 1.0)
        targets.append(1 + np.arange(rows.start, rows.stop))
        factors.append(np.ones(count))
    nodes = own.first + np.arange(layout.nx), last - layout.node + np.arange(layout.nx)
    ends = np.concatenate([*nodes, own.shared])
    function = end_piece(functions, own.clock, layout.nx, len(own.p))
    into.piece(function, ends[:, None], np.concatenate(targets)[:, None], np.concatenate(factors))


def _depends_on_input(path: ca.Function) -> Array:
    """Whether each path value depends on the input."""
    pattern = path.jac_sparsity(0, 1)
    depends = np.zeros(path.numel_out(0), dtype=bool)
    depends[list(pattern.row())] = True
    return depends
