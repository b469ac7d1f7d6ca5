"""Limits on states, inputs and outputs: any h(x, u, p) ≤ 0, such as stress or power."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array, ArrayField, Immutable
from ccdtools.design_limits import DesignLimits
from ccdtools.exceptions import InputError
from ccdtools.plants.casadi_arrays import SymbolicFunction, as_symbolic
from ccdtools.plants.plant import Plant
from ccdtools.tolerances import FLAT_ROW, ON_LIMIT
from ccdtools_ground.door import as_floats, as_instance, as_names, shown
from invariant_sets import Polytope


@dataclass(frozen=True, eq=False, repr=False)
class OutputLimits(Immutable):
    """Limits lower ≤ h(x, u, p) ≤ upper at every sample's x and u.

    How far a limit is exceeded is told in half-widths of its range; of a limit on one side, in its distance from 0; and
    of h ≤ 0 in the units of h, which is best stated relative, as ``stress / strength - 1``.

    Parameters
    ----------
    outputs : function of (x, u, p)
        Takes CasADi columns and returns a column (ny) or a list of expressions; a `casadi.Function` is one, too.
    lower, upper : numbers or (ny,) array_like
        Infinite where there is no limit; by default h ≤ 0.
    names : sequence of str, optional
        With units; y1, y2, … by default.
    texts : sequence of str, optional
        What exceeding each limit is called, upper ones first; name and bound by default.

    Raises
    ------
    InputError
        If `outputs` is no such function, or the limits are not in order or limit nothing.
    """

    outputs: Any
    lower: ArrayField = -np.inf
    upper: ArrayField = 0.0
    names: Sequence[str] = ()
    texts: Sequence[str] = ()

    def __post_init__(self) -> None:
        self._set(outputs=as_symbolic("output_limits", self.outputs, ("x", "u", "p")))
        given = [np.atleast_1d(as_floats("output_limits", bound)) for bound in (self.lower, self.upper)]
        try:
            low, high = (np.array(bound) for bound in np.broadcast_arrays(*given))
        except ValueError:
            got = " and ".join(f"{len(bound)} bounds" for bound in given)
            raise InputError("output_limits", got, "as many on either side") from None
        if low.ndim != 1 or not (low < high).all():
            raise InputError("output_limits", f"{shown(low)} and {shown(high)}", "numbers or vectors, lower < upper")
        if not (np.isfinite(low) | np.isfinite(high)).any():
            raise InputError("output_limits", "infinite ones alone", "at least one finite limit")
        self._set(lower=low, upper=high)

    @classmethod
    def of(cls, plant: Plant) -> OutputLimits | None:
        """Limits that a plant states for its outputs; None without any."""
        low, high = plant.output_limits
        if plant.ny == 0 or not (np.isfinite(low) | np.isfinite(high)).any():
            return None
        return cls(plant.output, low, high, tuple(plant.output_names))

    def __repr__(self) -> str:
        return f"OutputLimits({self.outputs})"

    def check(self, nx: int, nu: int, designs: int) -> None:
        """Raise an `InputError` unless every output has a limit and a name."""
        ny = self.outputs.function(nx, nu, designs).numel_out(0)
        if ny == 0:
            raise InputError("output_limits", "a function without a value", "one of at least one output")
        if len(self.lower) not in (1, ny):
            raise InputError("output_limits", f"{len(self.lower)} limits", f"{ny}, one per output")
        if len(self.names):
            as_names("output_limits, names", self.names, ny)
        if len(self.texts):
            as_names("output_limits, texts", self.texts, self.scaled.function(nx, nu, designs).numel_out(0))

    @cached_property
    def scaled(self) -> SymbolicFunction:
        """(x, u, p) → violation of each limit (m,), in half-widths, for CasADi columns."""

        def beyond(x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
            """Rows, each ≤ 0 where the limit is kept."""
            y = self.outputs.function(x.numel(), u.numel(), p.numel())(x, u, p)
            index, sign, bound, unit = self._sides(y.numel())
            chosen = ca.vertcat(*(y[i] for i in index.tolist()))  # a list of places of a single entry would be a row
            scaled: ca.SX = (ca.DM(sign) * chosen - ca.DM(bound)) / ca.DM(unit)
            return scaled

        return SymbolicFunction("output_limits", beyond, ("x", "u", "p"))

    def depths(self, x: Any, u: Any, p: Any) -> Any:
        """Violation of each limit, (..., m); negative within, infinite for NaN.

        Of arrays or torch tensors.

        Parameters
        ----------
        x, u : (..., nx) and (..., nu)
        p : (np,) or (..., np)
        """
        beyond = self.scaled.vector(x.shape[-1], u.shape[-1], p.shape[-1])(x, u, p)
        if isinstance(beyond, np.ndarray):
            return np.where(np.isnan(beyond), np.inf, beyond)
        return beyond.masked_fill(beyond.isnan(), np.inf)

    def broken_at(self, x: Array, nu: int, designs: Array) -> list[str]:
        """Limits that a state (nx,) exceeds at designs (n, np) for any input.

        Only limits of outputs that do not depend on the input say so.
        """
        acted_on = self.scaled.function(len(x), nu, designs.shape[1]).jac_sparsity(0, 1).row()
        depths = self.depths(np.tile(x, (len(designs), 1)), np.zeros((len(designs), nu)), designs)
        depths[:, acted_on] = -np.inf
        worst = depths.argmax(axis=1)
        return [self.row_text(row) if depth[row] > ON_LIMIT else "" for row, depth in zip(worst, depths)]

    def row_text(self, row: int) -> str:
        """Text of exceeding one of the limits, such as "tyre load [N] > 500"."""
        if len(self.texts):
            return self.texts[row]
        index, sign, bound, _ = self._sides(self.outputs.values)
        i = int(index[row])
        name = self.names[i] if len(self.names) else f"y{i + 1}"
        return f"{name} {'>' if sign[row] > 0 else '<'} {sign[row] * bound[row]:.4g}"

    def within(self, X: Polytope, nu: int, p: Array) -> Polytope:
        """States of X that keep these limits, where linear at rest in the state alone."""
        value, J = (np.asarray(part) for part in self.scaled.linear(X.dim, nu, len(p))(p))
        F, g = J[:, : X.dim], -value[:, 0]
        known = np.isfinite(J).all(axis=1) & np.isfinite(g)
        alone = known & (J[:, X.dim :] == 0).all(axis=1) & (F != 0).any(axis=1) & (g > 0)
        if not alone.any():
            return X
        return Polytope(np.vstack([X.A, F[alone]]), np.concatenate([X.b, g[alone]]), X.A_eq, X.b_eq)

    def _sides(self, ny: int) -> tuple[Any, Array, Array, Array]:
        """Output, sign, bound and unit of every finite limit: sign · y ≤ bound."""
        low, high = (np.broadcast_to(bound, (ny,)) for bound in (self.lower, self.upper))
        width = (high - low) / 2
        one_sided = np.where(np.isfinite(high), np.abs(high), np.abs(low))
        unit = np.where(np.isfinite(width), width, np.where(one_sided > 0, one_sided, 1.0))
        above, below = np.flatnonzero(np.isfinite(high)), np.flatnonzero(np.isfinite(low))
        index = np.concatenate([above, below])
        sign = np.concatenate([np.ones(len(above)), -np.ones(len(below))])
        return index, sign, np.concatenate([high[above], -low[below]]), unit[index]


def limits_of(given: Polytope | DesignLimits, names: Sequence[str] = ()) -> OutputLimits:
    """X or U as limits of outputs, which are its rows in half-widths.

    Parameters
    ----------
    given : Polytope or DesignLimits
    names : sequence of str, optional
        What is limited; x1, x2, … by default.
    """
    if isinstance(given, DesignLimits):
        return _limits_of_design(given, as_names("names", tuple(names), given.dim, given.argument.lower()))
    rows, bounds, texts = scaled_rows(given, names)
    return OutputLimits(lambda x, u, p: ca.DM(rows) @ x - ca.DM(bounds), texts=texts)


def _limits_of_design(given: DesignLimits, names: Sequence[str]) -> OutputLimits:
    """Limits of a box whose bounds depend on the design."""

    def beyond(x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        """Distance beyond each bound, in half-widths."""
        z = u if given.argument == "U" else x
        lower, upper = ca.vertsplit(given.both.function(given.entries)(p), given.dim)
        half = ca.fabs(upper - lower) / 2  # a program may try designs whose bounds have crossed
        return ca.vertcat((z - upper) / half, (lower - z) / half)

    above, below = ([f"{name} {side} {given.argument}(p)" for name in names] for side in ("> upper", "< lower"))
    return OutputLimits(beyond, texts=(*above, *below))


def scaled_rows(X: Polytope, names: Sequence[str] = (), argument: str = "X") -> tuple[Array, Array, tuple[str, ...]]:
    """Rows (m, nx) and bounds (m,) of X in its half-widths, rows·x ≤ bounds, and texts of exceeding them.

    Along a row that X does not limit on its other side, the distance of the limit from 0 takes the place of the
    half-width.

    Raises
    ------
    InputError
        If X is no Polytope, or empty.
    """
    as_instance(argument, X, Polytope, "a Polytope", "Use Polytope.from_bounds(lower, upper).")
    if X.is_empty:
        raise InputError(argument, "an empty set", "one with at least one point")
    minimal = X.minimal()
    rows = np.vstack([minimal.A, minimal.A_eq, -minimal.A_eq])
    bounds = np.concatenate([minimal.b, minimal.b_eq, -minimal.b_eq])
    widths = _half_widths(minimal, rows, bounds)
    rows, bounds = rows / widths[:, None], bounds / widths
    names = as_names("names", tuple(names), X.dim, argument.lower())
    numbers = (f"row {i + 1} of {argument}" for i in range(len(rows)))
    return rows, bounds, tuple(_row_text(*row, names) for row in zip(numbers, rows, bounds))


def _row_text(own: str, row: Array, bound: float, names: Sequence[str]) -> str:
    """Text of exceeding a row, such as "velocity [m/s] > 0.5"."""
    terms = np.flatnonzero(np.abs(row) > FLAT_ROW * np.abs(row).max())
    if len(terms) > 3:  # a longer row is named by its number
        return own
    first = row[terms[0]]
    text = names[terms[0]]
    for factor, name in ((row[i] / first, names[i]) for i in terms[1:]):
        size = "" if np.isclose(abs(factor), 1.0) else f"{abs(factor):.3g} "
        text += f" {'+' if factor > 0 else '−'} {size}{name}"
    return f"{text} {'>' if first > 0 else '<'} {bound / first + 0.0:.4g}"


def _half_widths(X: Polytope, rows: Array, bounds: Array) -> Array:
    """Half-width of X along each row, never zero."""
    low = -np.asarray(X.support(-rows))
    high = np.asarray(X.support(rows))
    lower, upper = X.bounding_box()
    box = 0.5 * (upper - lower)
    reach = np.abs(rows) @ np.where(np.isfinite(box), box, 0.0)
    width = 0.5 * (high - low)
    width = np.where(np.isfinite(width), width, np.abs(bounds))
    width = np.where(width > FLAT_ROW * reach, width, reach)
    return np.where(width > 0, width, np.linalg.norm(rows, axis=1))
