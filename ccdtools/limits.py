"""Limits of states; frequency and depth of violations, and their comparison."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, Immutable, Mask, frozen
from ccdtools.checks import as_array, as_floats, as_instance, as_names
from ccdtools.exceptions import InputError
from ccdtools.output_limits import OutputLimits
from ccdtools.statistics import mean_interval, paired_difference
from ccdtools.tolerances import FLAT_ROW, FURTHER_OUTSIDE, FURTHER_OUTSIDE_PART, STRETCHES
from invariant_sets import Polytope


@dataclass(frozen=True, eq=False, repr=False)
class StateLimits(Immutable):
    """Rows of X scaled by its half-widths: rows·x ≤ bounds.

    Along a row that X does not limit on its other side, the distance of the limit from 0 takes the place of the
    half-width.

    Parameters
    ----------
    X : Polytope
        Not empty.

    Attributes
    ----------
    rows : (m, nx) array
    bounds : (m,) array

    Raises
    ------
    InputError
        If X is no Polytope, or empty.
    """

    X: Polytope
    rows: Array = field(init=False)
    bounds: Array = field(init=False)

    def __post_init__(self) -> None:
        as_instance("X", self.X, Polytope, "a Polytope", "Use Polytope.from_bounds(lower, upper).")
        if self.X.is_empty:
            raise InputError("X", "an empty set", "one with at least one point")
        minimal = self.X.minimal()
        rows = np.vstack([minimal.A, minimal.A_eq, -minimal.A_eq])
        bounds = np.concatenate([minimal.b, minimal.b_eq, -minimal.b_eq])
        widths = _half_widths(minimal, rows, bounds)
        object.__setattr__(self, "rows", frozen(rows / widths[:, None]))
        object.__setattr__(self, "bounds", frozen(bounds / widths))

    def __repr__(self) -> str:
        return f"StateLimits({self.rows.shape[1]} states, {len(self.bounds)} rows)"

    def depths(self, x: Array) -> Array:
        """Violation of each row by states (..., nx), as (..., m); negative within."""
        with np.errstate(over="ignore", invalid="ignore"):
            beyond = x @ self.rows.T - self.bounds
        beyond = np.where(np.isnan(beyond), np.inf, beyond)
        inside = self.X.contains(x.reshape(-1, x.shape[-1])).reshape(x.shape[:-1])
        return np.where(inside[..., None], np.minimum(beyond, 0.0), beyond)

    def row_text(self, row: int, names: Sequence[str]) -> str:
        """Text of exceeding a row, such as "velocity [m/s] > 0.5"."""
        terms = np.flatnonzero(np.abs(self.rows[row]) > FLAT_ROW * np.abs(self.rows[row]).max())
        if len(terms) > 3:  # a longer row is named by its number
            return f"row {row + 1} of X"
        first = self.rows[row, terms[0]]
        bound = self.bounds[row] / first
        side = ">" if first > 0 else "<"
        text = names[terms[0]]
        for factor, name in ((self.rows[row, i] / first, names[i]) for i in terms[1:]):
            size = "" if np.isclose(abs(factor), 1.0) else f"{abs(factor):.3g} "
            text += f" {'+' if factor > 0 else '−'} {size}{name}"
        return f"{text} {side} {bound:.4g}"


@dataclass(frozen=True, eq=False, repr=False)
class Excursions(Immutable):
    """Frequency and depth of violations of X, in half-widths of X.

    Attributes
    ----------
    fraction : (n,) array
        Fraction of the states of each run outside X.
    mean : (n,) array
        Depth, averaged over the states of each run; 0 inside.
    peak : (n,) array
        Largest depth of each run.
    exceeded : str
        The row that is exceeded most, over all runs; empty where all states lie in X.
    limits : str
        What was left: "X", or "the limits" where those of outputs count, too.
    """

    fraction: Array
    mean: Array
    peak: Array
    exceeded: str = ""
    limits: str = "X"

    def of(self, kept: Any) -> Excursions:
        """Violations of some of the runs, by index or mask."""
        return Excursions(self.fraction[kept], self.mean[kept], self.peak[kept], self.exceeded, self.limits)

    def __post_init__(self) -> None:
        for name in ("fraction", "mean", "peak"):
            object.__setattr__(self, name, frozen(as_floats(name, getattr(self, name))))

    def __repr__(self) -> str:
        if not len(self.peak):
            return "Excursions(no runs)"
        worst = f", most {self.exceeded}" if self.exceeded else ""
        return (
            f"Excursions({len(self.peak)} runs, {self.fraction.mean():.2%} of the states outside {self.limits}, depth "
            f"{self.mean.mean():.3g} in the mean, peak {self.peak.mean():.3g}, largest {self.peak.max():.3g}{worst})"
        )


def depth_outside(x: ArrayLike, X: Polytope | StateLimits) -> Array:
    """Largest violation of a row by states (..., nx), as (...,), in half-widths.

    0 inside, to the tolerance of `X.contains`; 1 is one half-width beyond the limit.

    Raises
    ------
    InputError
        If `x` has another number of states, or X is empty.
    """
    limits = X if isinstance(X, StateLimits) else StateLimits(X)
    states = as_floats("x", x)
    if states.ndim == 0 or states.shape[-1] != limits.rows.shape[1]:
        raise InputError("x", f"shape {states.shape}", f"(..., {limits.rows.shape[1]}), the states of X")
    depth: Array = np.maximum(limits.depths(states).max(axis=-1), 0.0)
    return depth


def excursions(states: ArrayLike, X: Polytope | StateLimits, *, names: Sequence[str] | None = None) -> Excursions:
    """Frequency and depth of violations of X by runs.

    Parameters
    ----------
    states : (n, T, nx) or (T, nx) array_like
    X : Polytope
    names : sequence of str, optional
        Of the states; x1, x2, … by default.

    Raises
    ------
    InputError
        If shapes do not fit, or X is empty.
    """
    limits = X if isinstance(X, StateLimits) else StateLimits(X)
    nx = limits.rows.shape[1]
    runs = np.asarray(as_array("states", states, ("T", nx), ("n", "T", nx)) if np.size(states) else states)
    runs = runs.reshape(-1, runs.shape[-2], nx)
    names = as_names("names", () if names is None else names, nx, "x")
    return excursions_of(limits.depths(runs), lambda row: limits.row_text(row, names))


def excursions_of(by_row: Array, row_text: Callable[[int], str], limits: str = "X") -> Excursions:
    """Violations of runs from their depths (n, T, m) by limit."""
    if not len(by_row):
        return Excursions(np.zeros(0), np.zeros(0), np.zeros(0), limits=limits)
    depth = np.maximum(by_row.max(axis=-1), 0.0)
    largest = by_row.reshape(-1, by_row.shape[-1]).max(axis=0)
    exceeded = row_text(int(np.argmax(largest))) if largest.max() > 0 else ""
    return Excursions((depth > 0).mean(axis=1), depth.mean(axis=1), depth.max(axis=1), exceeded, limits)


def further_outside(own: Excursions, other: Excursions, *, stretches: bool = False) -> bool:
    """Whether runs leave X deeper or more often than another controller's.

    With `stretches` they are consecutive stretches of one run, and their differences a correlated series.

    The 95 % interval of the paired difference excludes zero, and the difference matters: more than 0.01 half-widths of
    the peak depth or 0.01 of the states, and more than a twentieth of what the other controller does.
    """
    for measure in ("peak", "fraction"):
        reference = getattr(other, measure)
        values = getattr(own, measure)
        difference = mean_interval(values - reference) if stretches else paired_difference(values, reference)
        needed = max(FURTHER_OUTSIDE, FURTHER_OUTSIDE_PART * float(reference.mean())) if len(reference) else np.inf
        if difference.ci95[0] > 0 and difference.mean > needed:
            return True
    return False


def limits_in_words(outputs: OutputLimits | None) -> str:
    """Name of the limits that count: X, or the limits with outputs."""
    return "X" if outputs is None else "the limits"


@dataclass(frozen=True, eq=False)
class RunViolations:
    """Frequency and depth with which one controller's runs leave X.

    Attributes
    ----------
    whole : Excursions
        Of the runs that did not diverge.
    pieces : Excursions
        Of all runs, or of the stretches of a single run: what is paired with another controller's.
    single : bool
        Whether they are stretches of one run, one after the other.
    lost : (n,) bool array
        Of the pieces, those of runs that diverged.
    """

    whole: Excursions
    pieces: Excursions
    single: bool
    lost: Mask

    @classmethod
    def from_trajectory(
        cls, run: Any, limits: StateLimits, plant: Any, outputs: OutputLimits | None = None
    ) -> RunViolations:
        """Violations of a `Trajectory`, by states and limited outputs."""
        n, steps, nx = run.states[:, 1:].shape
        names = getattr(plant, "state_names", None) or tuple(f"x{i + 1}" for i in range(nx))
        by_row = limits.depths(run.states[:, 1:])
        rows = by_row.shape[-1]
        if outputs is not None:
            by_row = np.concatenate([by_row, outputs.depths(run.states[:, :-1], run.inputs, run.design)], axis=-1)

        def text(row: int) -> str:
            """Text of exceeding a limit."""
            return limits.row_text(row, names) if row < rows or outputs is None else outputs.row_text(row - rows)

        left = limits_in_words(outputs)
        whole = excursions_of(by_row[~run.diverged], text, left)
        if n > 1 or steps < STRETCHES:
            return cls(whole, excursions_of(by_row, text, left), False, run.diverged)
        length = min(100, steps // STRETCHES)  # samples of a stretch
        pieces = by_row[0, : steps // length * length].reshape(-1, length, by_row.shape[-1])
        return cls(whole, excursions_of(pieces, text, left), True, np.repeat(run.diverged, len(pieces)))

    def further_than(self, others: Mapping[str, RunViolations]) -> tuple[str, ...]:
        """Names of the controllers that leave X less."""
        return tuple(name for name, other in others.items() if self._further(other))

    def _further(self, other: RunViolations) -> bool:
        """Whether these leave X further than another controller's, where neither diverged."""
        n = min(len(self.lost), len(other.lost))
        kept = ~(self.lost[:n] | other.lost[:n])
        own, others = (one.pieces.of(slice(n)).of(kept) for one in (self, other))
        return further_outside(own, others, stretches=self.single)


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
