"""Any costs and limits of a phase along a plan, for quadratic programs."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from mpc.checks import Array
from mpc.optimal_control.condensing import compile_kernels
from mpc.optimal_control.discrete_model import Buffered
from mpc.optimal_control.local_statement import Local, Multipliers, Rows, largest
from mpc.optimal_control.loop_phase import LoopPhase
from mpc.optimal_control.pieces import kind_of
from mpc.tolerances import FEASIBLE, KKT, NEGLIGIBLE


class PhaseStages:
    """Statement of a loop's samples.

    States are (x, w, the input before), as in its program.
    """

    def __init__(self, loop: LoopPhase) -> None:
        self.loop = loop
        self.part = loop.program.parts[0]
        self.functions = self.part.functions
        layout, f, N = self.part.layout, self.functions, loop.horizon
        self.nx, self.nu = layout.nx, layout.nu
        low, high = loop.phase.u_bounds
        self.extent = np.where(np.isfinite(low) & np.isfinite(high) & (high > low), np.maximum(-low, high), np.inf)
        compile_kernels()
        self._bounds = _Sides(low, high)
        self._path, self._end = _Sides(*f.path_bounds), _Sides(*f.boundary_bounds)
        counting, of = loop.counting(self.part), self._path.of
        before, beyond = N * len(self._bounds.of), len(self._end.of)  # rows of inputs and of the end, about those along
        self._priced = priced = np.isfinite(f.path_prices[0])
        along = np.tile((loop.of(self.part, "x") | priced)[of], N + 1)
        self._free = before + np.flatnonzero(~counting[:, of])  # path limits that do not count
        # rows (m,) that may be passed: those of states after the first, and those that have a price
        self._give = np.concatenate([np.zeros(before, dtype=bool), along, np.ones(beyond, dtype=bool)])
        self._give[self._free] = False
        hard, prices = np.full((before + beyond, 2), np.inf), np.tile(f.path_prices.T[of], (N + 1, 1))
        self._prices = np.vstack([hard[:before], prices, hard[before:]])  # (m, 2): infinite where limits are hard
        kind = kind_of(f.dynamics, f.stage_cost, f.path, f.terminal_cost, f.boundary)
        lengths = {"x": self.nx, "u": self.nu, "p": len(loop.p) + 1, "t": 1, "x0": self.nx}
        x, u, p, t, x0 = (kind.sym(name, length) for name, length in lengths.items())
        at = x, u, kind(0, 1), p, t
        after, last = f.dynamics(*at), 0 if f.terminal_cost is None else f.terminal_cost(x, kind(0, 1), p, t)
        last = kind(last)
        ends = [] if f.boundary is None else [f.boundary(x0, x, kind(0, 1), 0, t, p)]
        stage = [after], kind(f.cost_at(*at)), f.path_at(*at), [x, u, p, t]
        at_end = ca.sparsify(ca.DM(counting[-1].astype(float)))
        end: Any = [], last, ca.vertcat(at_end * f.path_at(*at), *ends), [x, u, p, t, x0]
        (self._stage, self._stage_bent), (self._last, self._last_bent) = (
            tuple(Buffered(one.map("along", "serial", count, shared, [])) for one in _slopes(kind, *of))
            for of, count, shared in ((stage, N, [2]), (end, 1, []))
        )  # fmt: skip

    @cached_property
    def rows(self) -> Rows:
        """Rows of inputs, path and end, without slopes."""
        N, kinds = self.loop.horizon, []
        for steps, sides in ((np.arange(N), self._bounds), (np.arange(N + 1), self._path), (np.array([N]), self._end)):
            none = [np.zeros((len(sides.of), size)) for size in (self.nx, self.nu, self.nu)]
            kinds.append((steps, *none, np.ones(len(sides.of)), None))
        found = Rows.of_kinds(kinds)
        found.slots[self._give] = np.arange(np.count_nonzero(self._give))
        found.later[self._free] = self._free
        return found

    def at(self, z: Array, states: Array, inputs: Array, p: Array, w: Array) -> Local:
        """Statement at a plan from z (nz,) with parameters and time p."""
        N, nx, nu, own = self.loop.horizon, self.nx, self.nu, slice(self.loop.phase.states, None)
        steps, end = np.arange(N, dtype=float)[:, None], (states[-1:], inputs[-1:], p, float(N), z)
        after, A, B, cost, cost_x, cost_u, path, path_x, path_u = self._stage(states[:-1], inputs, p, steps)
        last, last_x, _, ends, ends_x, ends_u = self._last(*end)
        after[:, own][:, : w.shape[1]] = w[1:]
        cost_x, cost_u = np.vstack([cost_x.reshape(N, nx), last_x.reshape(1, nx)]), cost_u.reshape(N, nu)
        base = self.loop.program.scale[self.part.first :][: nx + nu]
        sizes = np.concatenate([np.ptp(states, axis=0), np.ptp(inputs, axis=0)])
        resting = sizes <= NEGLIGIBLE * base
        sizes = np.where(resting, base, sizes)
        # beside what loose bounds tell, limits of states at rest would be kept however far they are passed
        least = np.maximum(np.abs(states).max(axis=0), KKT**0.5 / FEASIBLE)
        of_hard = np.append(np.where(resting[:nx], np.minimum(base[:nx], least), sizes[:nx]), sizes[nx:])
        values = [np.vstack([path, ends[:, : path.shape[1]]]), ends[:, path.shape[1] :]]
        slopes = [np.concatenate([_columns(path_x, nx), _columns(ends_x, nx)[:, : path.shape[1]]]),
                  _columns(ends_x, nx)[:, path.shape[1] :]]  # fmt: skip
        by_inputs = _columns(path_u, nu), _columns(ends_u, nu)
        rows, room, told = self._rows(inputs, values, slopes, by_inputs, sizes, of_hard)
        about = _columns(A, nx), _columns(B, nu), after - states[1:], z - states[0]
        size = max(largest(sizes[:nx] * cost_x), largest(sizes[nx:] * cost_u)) or 1.0

        def hessian(multipliers: Multipliers) -> Array:
            """Hessian of the Lagrangian."""
            along, on_end = self._on_values(multipliers.pushes)
            costates = np.hstack([multipliers.costates, np.zeros((N, nx - multipliers.costates.shape[1]))])
            stages = self._stage_bent(states[:-1], inputs, p, steps, costates, along[:-1])[0]
            last = self._last_bent(*end, np.zeros((1, 0)), np.append(along[-1], on_end)[None])[0]
            bent = np.concatenate([stages, last]).reshape(N + 1, nx + nu, nx + nu)
            bent[N - 1, nx:, nx:] += bent[N, nx:, nx:]
            bent[N, nx:], bent[N, :, nx:] = 0.0, 0.0
            return bent

        def convex() -> Array:
            """Hessian of the cost, its negative eigenvalues turned."""
            none = Multipliers(np.zeros((N, nx)), np.zeros(len(room)))
            values, vectors = np.linalg.eigh(sizes[:, None] * hessian(none) * sizes)
            turned = np.maximum(np.abs(values), NEGLIGIBLE * size)
            return np.asarray((vectors * turned[:, None, :]) @ vectors.transpose(0, 2, 1) / sizes[:, None] / sizes)

        over, soft, given = np.maximum(-room, 0.0), np.isfinite(self._prices[:, 0]), self._give
        prices = self._prices[given] * np.stack([rows.amounts, rows.amounts**2], axis=1)[given]
        total = float(cost.sum() + last.sum() + (self._prices[soft] * np.stack([over, over**2], axis=1)[soft]).sum())
        # a violation that costs linearly is found by proximal steps from the present one
        near = np.where(prices[:, 1] > 0, 0.0, prices[:, 0])
        prices += np.stack([np.where(near > 0, -2 * near * (over / rows.amounts)[given], 0.0), near], axis=1)
        return Local(states, inputs, about, cost_x, cost_u, convex, hessian, rows, room, (sizes[:nx], sizes[nx:]),
                     self.extent, lambda: total, prices, cost_size=self.loop.program.cost_scale, told=told)  # fmt: skip

    def _rows(self, inputs: Array, values: list[Array], slopes: list[Array], by_inputs: tuple[Array, Array],
              sizes: Array, of_hard: Array) -> tuple[Rows, Array, Array]:  # fmt: skip
        """Rows at a plan, room (m,), units (m,) as told.

        A row is as large as it changes at its own step, so that a small obstacle on a long way is kept off as well; its
        violation is counted in what it changes at most. Sizes of hard limits are their own.
        """
        N, nx, nu, r = self.loop.horizon, self.nx, self.nu, values[0].shape[1]
        (along, ends), (bounds, path, end) = by_inputs, (self._bounds, self._path, self._end)
        none = np.zeros((1, r, nu))
        of_inputs = np.concatenate([along, none]), np.concatenate([np.zeros((N, r, nu)), ends[:, :r]])
        sides = [
            (bounds, inputs, np.zeros((N, nu, nx)), np.tile(np.eye(nu), (N, 1, 1)), np.zeros((N, nu, nu))),
            (path, values[0], slopes[0], *of_inputs),
            (end, values[1], slopes[1], 0 * ends[:, r:], ends[:, r:]),
        ]
        each: list[tuple[Array, ...]] = []
        smaller = bool((of_hard < sizes).any())
        for side, value, *parts in sides:
            slopes_of = np.abs(np.concatenate(parts, axis=2))[:, side.of]
            told, most = _units(slopes_of, np.append(sizes, sizes[nx:]))
            own = told
            if smaller:
                hard = ~self._priced[side.of] if side is path else np.ones(len(side.of), dtype=bool)
                own, less = _units(slopes_of, np.append(of_hard, of_hard[nx:]))
                own, most = np.where(hard, own, told), np.where(hard, less, most)
            signed = [(part[:, side.of] * side.sign[:, None]).reshape(-1, part.shape[2]) for part in parts]
            sizes_of = own.ravel(), np.tile(most, len(value)), told.ravel()
            each.append((*signed, *sizes_of, (side.bound - side.sign * value[:, side.of]).ravel()))
        by_state, by_input, by_before, units, amounts, told, room = (np.concatenate(part) for part in zip(*each))
        room[self._free] = np.inf
        return replace(self.rows, by_state=by_state, by_input=by_input, by_before=by_before, units=units,
                       amounts=amounts), room, told  # fmt: skip

    def _on_values(self, pushes: Array) -> tuple[Array, Array]:
        """Multipliers (N + 1, r) of path values, and those of the end."""
        N = self.loop.horizon
        cuts = np.cumsum([N * len(self._bounds.of), (N + 1) * len(self._path.of)])
        _, path, end = np.split(pushes, cuts)
        return self._path.summed(path.reshape(N + 1, -1)), self._end.summed(end[None])[0]


class _Sides:
    """Bounded sides of values: which, its sign, its bound."""

    def __init__(self, low: Array, high: Array) -> None:
        upper, lower = np.flatnonzero(np.isfinite(high)), np.flatnonzero(np.isfinite(low))
        self.size = len(low)
        self.of = np.concatenate([upper, lower])
        self.sign = np.repeat([1.0, -1.0], [len(upper), len(lower)])
        self.bound = np.concatenate([high[upper], -low[lower]])

    def summed(self, pushes: Array) -> Array:
        """Multipliers (k, size) of values from their sides'."""
        found = np.zeros((len(pushes), self.size))
        np.add.at(found.T, self.of, (pushes * self.sign).T)
        return found


def _slopes(kind: Any, after: list[Any], cost: Any, rows: Any, columns: list[Any]) -> tuple[ca.Function, ca.Function]:
    """Functions of values with slopes, and of the Lagrangian's Hessian."""
    x, u = columns[:2]
    values = [ca.densify(one) for value in (*after, cost, rows)
              for one in (value, ca.jacobian(value, x), ca.jacobian(value, u))]  # fmt: skip
    on_after, on_rows = kind.sym("on_after", sum(one.numel() for one in after)), kind.sym("on_rows", rows.numel())
    whole = cost + ca.dot(on_rows, rows) + sum(ca.dot(on_after, one) for one in after)
    bent, _ = ca.hessian(whole, ca.vertcat(x, u))
    return (ca.Function("slopes", columns, values, {"cse": True}),
            ca.Function("bent", [*columns, on_after, on_rows], [ca.densify(bent)], {"cse": True}))  # fmt: skip


def _units(slopes: Array, sizes: Array) -> tuple[Array, Array]:
    """Sizes (k, r) of rows, and their largest (r,)."""
    each = slopes @ sizes
    most = each.max(axis=0, initial=0.0)
    most = np.where(np.isfinite(most) & (most > 0), most, 1.0)
    return np.where(np.isfinite(each), np.maximum(each, NEGLIGIBLE * most), most), most


def _columns(values: Array, size: int) -> Array:
    """Slopes (k, r, size) from CasADi's columns (k · size, r)."""
    k, r = len(values) // size, values.shape[1]
    return np.ascontiguousarray(values.reshape(k, size, r).transpose(0, 2, 1))
