"""Violations of limits by runs: frequency and depth, and their comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, Immutable, Indices, Mask
from ccdtools.budgets import STRETCHES
from ccdtools.exceptions import InputError
from ccdtools.output_limits import OutputLimits, scaled_rows
from ccdtools.statistics import mean_interval, paired_difference
from ccdtools.tolerances import DIVERGENCE, DIVERGENCE_LIMIT, FURTHER_OUTSIDE, FURTHER_OUTSIDE_PART, SAME_BOUNDS
from ccdtools_ground.door import as_array, as_floats, as_instance
from invariant_sets import Polytope


@dataclass(frozen=True, eq=False, repr=False)
class Excursions(Immutable):
    """Frequency and depth of violations of X by runs, in half-widths of X.

    Attributes
    ----------
    fraction : (n,) array
        Fraction of the states of each run outside X.
    mean : (n,) array
        Depth, averaged over the states of each run; 0 inside.
    peak : (n,) array
        Largest depth of each run.
    rows : (n,) int array
        The row that each run exceeds most, of `texts`.
    texts : sequence of str
    limits : str
        What was left: "X", or "the limits" where those of inputs or outputs count, too.
    lost : (n,) bool array, optional
        Runs that diverged.
    single : bool
        Whether these are stretches of one run, one after the other.
    """

    fraction: Array
    mean: Array
    peak: Array
    rows: Indices | None = None
    texts: Sequence[str] = ()
    limits: str = "X"
    lost: Mask | None = None
    single: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        lost = np.zeros(len(self.peak), dtype=bool) if self.lost is None else self.lost
        self._set(lost=lost)

    @property
    def exceeded(self) -> str:
        """Row that is exceeded most by runs that did not diverge."""
        return deepest_row(self.peak, self.rows, self.lost, self.texts)

    @classmethod
    def from_depths(
        cls, by_row: Array, texts: Sequence[str], limits: str = "X", lost: Mask | None = None, single: bool = False
    ) -> Excursions:
        """Violations of runs from depths (n, T, m) by row and the texts of rows."""
        if not len(by_row):
            return cls(np.zeros(0), np.zeros(0), np.zeros(0), limits=limits)
        depth = by_row.max(axis=-1, initial=0.0)
        by_run = np.pad(by_row.max(axis=1), ((0, 0), (0, 1)))  # there may be no row but that of nothing exceeded
        peak, rows = by_run.max(axis=1), by_run.argmax(axis=1)
        return cls((depth > 0).mean(axis=1), depth.mean(axis=1), peak, rows, (*texts, ""), limits, lost, single)

    @classmethod
    def from_trajectory(
        cls, run: Any, X: Polytope, plant: Any, outputs: OutputLimits | None = None, U: Polytope | None = None
    ) -> tuple[Excursions, tuple[Excursions, ...]]:
        """Violations of X, of U, and of limited outputs, by a `Trajectory`.

        Returns
        -------
        whole : Excursions
            Of the runs that did not diverge.
        pieces : tuple of Excursions
            Of all runs, or of the stretches of a single run: what is paired with another controller's. The first is of
            all limits; where these are of several kinds, one of each follows, as frequent violations of one kind hide
            those of another.
        """
        n, steps, _ = run.inputs.shape
        kinds = [_depths(run.states[:, 1:], X, getattr(plant, "state_names", None) or ())]
        if U is not None:
            beyond, own = _depths(run.inputs, U, getattr(plant, "input_names", None) or (), "U")
            kinds.append((np.where(beyond > SAME_BOUNDS, beyond, 0.0), own))  # networks saturate in single precision
        if outputs is not None:
            depths = outputs.depths(run.states[:, :-1], run.inputs, run.design)
            kinds.append((depths, tuple(map(outputs.row_text, range(depths.shape[-1])))))
        left = limits_in_words(outputs, U)
        together = np.concatenate([by_row for by_row, _ in kinds], axis=-1), [text for _, own in kinds for text in own]
        whole = cls.from_depths(together[0][~run.diverged], together[1], left)

        def pieces(by_row: Array, texts: Sequence[str]) -> Excursions:
            """Violations of all runs, or of stretches of one."""
            if n > 1 or steps < STRETCHES:
                return cls.from_depths(by_row, texts, left, lost=run.diverged)
            length = min(100, steps // STRETCHES)  # samples of a stretch
            cut = by_row[0, : steps // length * length].reshape(steps // length, length, by_row.shape[-1])
            return cls.from_depths(cut, texts, left, lost=np.repeat(run.diverged, len(cut)), single=True)

        return whole, tuple(pieces(*kind) for kind in (together, *kinds * (len(kinds) > 1)))

    def __repr__(self) -> str:
        if not len(self.peak):
            return "Excursions(no runs)"
        worst = f", most {self.exceeded}" if self.exceeded else ""
        return (
            f"Excursions({len(self.peak)} runs, {self.fraction.mean():.2%} of the states outside {self.limits}, depth "
            f"{self.mean.mean():.3g} in the mean, peak {self.peak.mean():.3g}, largest {self.peak.max():.3g}{worst})"
        )


def deepest_row(peak: Array, rows: Indices | None, lost: Any, texts: Sequence[str]) -> str:
    """Row of the deepest run that is not lost, or none."""
    depth = np.where(lost, 0.0, peak)
    return texts[rows[int(depth.argmax())]] if rows is not None and depth.max(initial=0.0) > 0 else ""


def divergence_limit(X: Polytope) -> Array:
    """Largest |x| (nx,) of runs that are not lost.

    It is a thousand times that within X.
    """
    largest = np.max(np.abs(X.bounding_box()), axis=0)
    return np.where((largest > 0) & np.isfinite(largest), DIVERGENCE * largest, DIVERGENCE_LIMIT)


def depth_outside(x: ArrayLike, X: Polytope) -> Array:
    """Largest violation of a row by states (..., nx), as (...,), in half-widths.

    0 inside, to the tolerance of `X.contains`; 1 is one half-width beyond the limit.

    Raises
    ------
    InputError
        If `x` has another number of states, or X is empty.
    """
    as_instance("X", X, Polytope, "a Polytope", "Use Polytope.from_bounds(lower, upper).")
    states = as_floats("x", x)
    if states.ndim == 0 or states.shape[-1] != X.dim:
        raise InputError("x", f"shape {states.shape}", f"(..., {X.dim}), the states of X")
    depth: Array = _depths(states, X)[0].max(axis=-1, initial=0.0)
    return depth


def excursions(states: ArrayLike, X: Polytope, *, names: Sequence[str] | None = None) -> Excursions:
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
    as_instance("X", X, Polytope, "a Polytope", "Use Polytope.from_bounds(lower, upper).")
    runs = np.asarray(as_array("states", states, ("T", X.dim), ("n", "T", X.dim)) if np.size(states) else states)
    runs = runs.reshape(-1, runs.shape[-2], X.dim)
    return Excursions.from_depths(*_depths(runs, X, () if names is None else names))


def _depths(x: Array, X: Polytope, names: Sequence[str] = (), argument: str = "X") -> tuple[Array, tuple[str, ...]]:
    """Violations (..., m) of rows of X by states (..., nx), negative within, and their texts."""
    rows, bounds, texts = scaled_rows(X, names, argument)
    with np.errstate(over="ignore", invalid="ignore"):
        beyond = x @ rows.T - bounds
    beyond = np.where(np.isnan(beyond), np.inf, beyond)
    inside = X.contains(x.reshape(-1, x.shape[-1])).reshape(x.shape[:-1])
    return np.where(inside[..., None], np.minimum(beyond, 0.0), beyond), texts


def further_outside(own: Excursions, other: Excursions) -> bool:
    """Whether runs leave X deeper or more often than another controller's, where neither diverged.

    Of stretches of a single run the differences are a correlated series; one run beside several tells nothing.

    The 95 % interval of the paired difference excludes zero, and the difference matters: more than 0.01 half-widths of
    the peak depth or 0.01 of the states, and more than a twentieth of what the other controller does.
    """
    n = min(len(own.peak), len(other.peak))
    kept = ~(np.asarray(own.lost)[:n] | np.asarray(other.lost)[:n])
    if own.single != other.single or not kept.any():
        return False
    for measure in ("peak", "fraction"):
        values, reference = (getattr(one, measure)[:n][kept] for one in (own, other))
        difference = mean_interval(values - reference) if own.single else paired_difference(values, reference)
        needed = max(FURTHER_OUTSIDE, FURTHER_OUTSIDE_PART * float(reference.mean()))
        if difference.ci95[0] > 0 and difference.mean > needed:
            return True
    return False


def limits_in_words(outputs: OutputLimits | None, U: Any = None) -> str:
    """Name of the limits that count: X, or the limits with inputs or outputs."""
    return "X" if outputs is None and U is None else "the limits"
