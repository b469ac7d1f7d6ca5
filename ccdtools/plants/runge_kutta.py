"""Classical Runge–Kutta method over one held sample."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, lru_cache
from threading import get_ident
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.plants.budgets import FEW_ROWS, KEPT_SIZES, RUNS_AT_ONCE
from ccdtools.plants.casadi_arrays import Vectorised, check_sizes


class ExplicitStep:
    """Step (x, u, w, p) → x⁺ of repeated Runge–Kutta substeps or a discrete map.

    Parameters
    ----------
    substep : casadi.Function
        (x, u, w, p) → x after a part of the sample.
    substeps : int
        Parts of a sample.
    """

    few_rows = FEW_ROWS  # Up to so many CasADi's own machine is taken.

    def __init__(self, substep: ca.Function, substeps: int) -> None:
        self.substep = substep
        self.substeps = substeps

    @property
    def sizes(self) -> tuple[int, ...]:
        """Sizes of x, u, w and p."""
        return tuple(self.substep.numel_in(i) for i in range(4))

    @classmethod
    def of(cls, f: ca.Function, dt: float, substeps: int) -> ExplicitStep:
        """Runge–Kutta steps of dx/dt = f(x, u, w, p) over `dt` seconds, u and w held.

        References
        ----------
        Hairer, Nørsett and Wanner, "Solving ordinary differential equations I", 2nd ed., 1993, table II.1.2.
        """
        h = dt / substeps
        x, u, w, p = (ca.SX.sym(name, *f.size_in(i)) for i, name in enumerate("xuwp"))
        k1 = f(x, u, w, p)
        k2 = f(x + h / 2 * k1, u, w, p)
        k3 = f(x + h / 2 * k2, u, w, p)
        k4 = f(x + h * k3, u, w, p)
        after = ca.cse(ca.densify(x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)))
        return cls(ca.Function("substep", [x, u, w, p], [after], list("xuwp"), ["x_next"]), substeps)

    @cached_property
    def function(self) -> ca.Function:
        """The whole step as a CasADi expression."""
        x, u, w, p = (ca.SX.sym(name, *self.substep.size_in(i)) for i, name in enumerate("xuwp"))
        after = x
        for _ in range(self.substeps):
            after = self.substep(after, u, w, p)
        return ca.Function("step", [x, u, w, p], [ca.densify(after)], list("xuwp"), ["x_next"])

    @cached_property
    def _vectorised(self) -> Vectorised:
        """Substep on tensors and on many rows."""
        return Vectorised(self.substep)

    @cached_property
    def _native(self) -> Callable[..., Array]:
        """The whole step on few rows."""
        return _on_rows(self.function)

    @cached_property
    def _slopes_of_sample(self) -> Callable[..., Array]:
        """Slopes of the whole sample, for few runs."""
        return _on_rows(slopes_of(self.function))

    @cached_property
    def _slopes_of_part(self) -> Vectorised:
        """Slopes of a part of the sample, for many runs."""
        return Vectorised(slopes_of(self.substep))

    def __call__(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """x⁺ (..., nx) of arrays or tensors (..., n); leading shapes broadcast."""
        check_sizes(self.sizes, (x, u, w, p))
        if all(isinstance(a, np.ndarray) for a in (x, u, w, p)):
            return self._of_arrays(x, u, w, p)
        for _ in range(self.substeps):
            x = self._vectorised(x, u, w, p)
        return x

    def _of_arrays(self, *arguments: Array) -> Array:
        """Step of arrays, in double precision inside."""
        batch = np.broadcast_shapes(*(a.shape[:-1] for a in arguments))
        runs = int(np.prod(batch))
        common = [a.ndim == 1 for a in arguments] if batch else [False] * 4
        rows = [a if one else np.broadcast_to(a, (*batch, a.shape[-1])) for a, one in zip(arguments, common)]
        x, *held = (a if one else a.reshape(runs, a.shape[-1]) for a, one in zip(rows, common))
        after = self.rows(np.broadcast_to(x, (runs, x.shape[-1])), tuple(held))
        return after.reshape(*batch, after.shape[-1]).astype(np.result_type(arguments[0], np.float32), copy=False)

    def at(self, p: Array) -> Callable[[Array, Array, Array], Array]:
        """(x, u, w) → x⁺ at a design (np,), the sooner where each has a row a run."""
        sizes = [self.substep.numel_in(i) for i in range(3)]

        def step(x: Array, u: Array, w: Array) -> Array:
            """Next states; leading shapes broadcast."""
            each = [a.shape for a in (x, u, w)] == [(len(x), size) for size in sizes]
            return self.rows(x, (u, w, p)) if each else np.asarray(self(x, u, w, p))

        return step

    def rows(self, x: Array, held: tuple[Array, ...]) -> Array:
        """x⁺ (n, nx) of x (n, nx) and u, w, p, (n, ·) or common (·,)."""
        if len(x) <= self.few_rows:
            return self._native(x, *held)
        parts = [slice(i, i + RUNS_AT_ONCE) for i in range(0, len(x), RUNS_AT_ONCE)]
        return np.vstack([self.path(x[i], tuple(a if a.ndim == 1 else a[i] for a in held))[-1].T for i in parts])

    def path(self, x: Array, held: tuple[Array, ...]) -> list[Array]:
        """States (nx, n) before each part of the sample and at its end."""
        state = _as_rows(x)
        after, step = self._vectorised.in_place([state, *map(_as_rows, held)])
        states = [state.copy()]
        for _ in range(self.substeps):
            step()
            state[:] = after
            states.append(state.copy())
        return states

    def slopes(self, x: Array, held: tuple[Array, ...], states: list[Array], multiplier: Array) -> list[Array]:
        """Products (n, ·) of a multiplier (n, nx) with ∂x⁺/∂x, ∂x⁺/∂u, ∂x⁺/∂w, ∂x⁺/∂p.

        For many runs `states` are those of `path`; for few they are empty.
        """
        ends = np.cumsum(self.sizes[:3])
        if not states:
            return np.split(self._slopes_of_sample(x, *held, multiplier), ends, axis=1)
        state = np.empty_like(states[0])
        factor = _as_rows(multiplier)
        found, part = self._slopes_of_part.in_place([state, *map(_as_rows, held), factor])
        total = np.zeros_like(found)
        for before in reversed(states[:-1]):  # part by part backwards
            state[:] = before
            part()
            factor[:] = found[: len(state)]
            total += found
        total[: len(state)] = factor
        return np.split(total.T, ends, axis=1)


def slopes_of(step: ca.Function) -> ca.Function:
    """(x, u, w, p, m) → slopes of m'x⁺ by x, u, w and p, stacked."""
    arguments: list[Any] = [ca.SX.sym(name, *step.size_in(i)) for i, name in enumerate("xuwp")]
    multiplier = ca.SX.sym("m", *step.size_out(0))
    slopes = ca.gradient(ca.dot(multiplier, step(*arguments)), ca.vertcat(*arguments))
    return ca.Function("slopes", [*arguments, multiplier], [ca.densify(slopes)])


def _on_rows(function: ca.Function) -> Callable[..., Array]:
    """CasADi function of vectors, with one output, on rows of arrays, by CasADi's own machine.

    It takes a nanosecond or two for an instruction and row; an array operation takes most of a microsecond however few
    rows there are. Results differ by rounding.

    Returns
    -------
    callable
        Values (n, n_out) at arguments (n, n_i), or (n_i,) common to all rows.
    """

    @lru_cache(KEPT_SIZES)
    def for_rows(rows: int, common: tuple[int, ...], thread: int) -> Any:
        """Buffer of the function for so many rows, with some arguments common to all, and its call."""
        mapped = function if rows == 1 else function.map(f"{function.name()}_{rows}", "serial", rows, list(common), [])
        return mapped.buffer()

    def evaluated(*arguments: Array) -> Array:
        """Values of all rows."""
        rows = next(len(a) for a in arguments if a.ndim == 2)
        out = np.empty((rows, function.numel_out(0)))
        if not rows:
            return out
        common = tuple(i for i, a in enumerate(arguments) if a.ndim == 1)
        buffer, evaluate = for_rows(rows, common, get_ident())
        given = [np.ascontiguousarray(a, dtype=float) for a in arguments]  # held: the buffer has their addresses only
        for i, a in enumerate(given):
            if a.size:
                buffer.set_arg(i, memoryview(a))  # type: ignore[arg-type]
        buffer.set_res(0, memoryview(out))  # type: ignore[arg-type]
        evaluate()
        return out

    return evaluated


def _as_rows(columns: Array) -> Array:
    """Rows (k, n) of numbers (n, k) in double precision; (k,) as they are."""
    return np.array(columns.T, dtype=float, order="C")
