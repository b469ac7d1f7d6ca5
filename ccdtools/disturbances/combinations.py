"""Disturbances made of others: sums, stacks, mixtures, cases and constants."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, ArrayField, Immutable, Indices, frozen
from ccdtools.disturbances.disturbance import Disturbance, Recorded, Uniform, check_draw
from ccdtools.exceptions import InputError
from ccdtools_ground.door import as_floats, as_vector, has_method, shown

A_DISTURBANCE = "disturbances, with a method sample(runs, steps, rng)"


class Combination(Immutable):
    """Disturbance made of others, its `terms`: with the same channels unless said otherwise."""

    terms: tuple[Disturbance, ...]

    def __post_init__(self) -> None:
        self._set(terms=_checked("terms", self.terms))
        _check_alike(self._known)

    @property
    def nw(self) -> int | None:
        """Number of channels, if a term knows it."""
        return next(iter(self._known), None)

    @property
    def _known(self) -> list[int]:
        """Numbers of channels of the terms that know them."""
        widths = (getattr(term, "nw", None) for term in self.terms)
        return [width for width in widths if width is not None]

    @property
    def _means(self) -> list[Array] | None:
        """Means of the terms, if all know theirs."""
        means = [getattr(term, "mean", None) for term in self.terms]
        known = all(isinstance(one, np.ndarray) and one.ndim == 1 for one in means)
        return means if known else None  # type: ignore[return-value]


@dataclass(frozen=True, eq=False)
class Sum(Combination):
    """Sum of independent disturbances with the same channels."""

    terms: tuple[Disturbance, ...]

    @property
    def mean(self) -> Array | None:
        """Mean (nw,), if all terms know theirs."""
        return None if self._means is None else np.sum(self._means, axis=0)

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> Array:
        """Sequences (runs, steps, nw)."""
        check_draw(runs, steps, rng)
        drawn = [term.sample(runs, steps, rng) for term in self.terms]
        _check_alike([w.shape[-1] for w in drawn])
        return np.asarray(np.sum(drawn, axis=0))


@dataclass(frozen=True, eq=False)
class Stacked(Combination):
    """Independent disturbances side by side, their channels in order.

    Parameters
    ----------
    terms : tuple of Disturbance

    Examples
    --------
    >>> Stacked((Gaussian([0.3]), Constant(Uniform([-0.2], [0.2]))))  # a road, and the part by which a load differs
    ... # doctest: +SKIP
    """

    terms: tuple[Disturbance, ...]

    def __post_init__(self) -> None:
        self._set(terms=_checked("terms", self.terms))

    @property
    def nw(self) -> int | None:
        """Number of channels, if all terms know theirs."""
        return sum(self._known) if len(self._known) == len(self.terms) else None

    @property
    def mean(self) -> Array | None:
        """Mean (nw,), if all terms know theirs."""
        return None if self._means is None else np.concatenate(self._means)

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> Array:
        """Sequences (runs, steps, nw)."""
        check_draw(runs, steps, rng)
        return np.concatenate([term.sample(runs, steps, rng) for term in self.terms], axis=-1)


@dataclass(frozen=True, eq=False)
class Constant(Combination):
    """Uncertain constant disturbance, drawn once per run and held.

    Parameters
    ----------
    distribution : Disturbance
        Its first sample of each run is the one that is held.
    """

    distribution: Disturbance

    def __post_init__(self) -> None:
        has_method("distribution", self.distribution, "sample", "a disturbance, such as Uniform([-0.2], [0.2])")

    @property
    def terms(self) -> tuple[Disturbance, ...]:  # type: ignore[override]
        """Distribution as the only term."""
        return (self.distribution,)

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> Array:
        """Sequences (runs, steps, nw), each of equal samples."""
        check_draw(runs, steps, rng)
        return np.repeat(self.distribution.sample(runs, 1, rng), steps, axis=1)


@dataclass(frozen=True, eq=False)
class Mixture(Combination):
    """One of several disturbances with the same channels, drawn for each run.

    Parameters
    ----------
    terms : tuple of Disturbance
    weights : array_like (number of terms,), optional
        How likely each is, up to a common factor; all alike by default.
    """

    terms: tuple[Disturbance, ...]
    weights: ArrayField = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set(weights=as_chances("weights", self.weights, len(self.terms), of="one per term"))

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> Array:
        """Sequences (runs, steps, nw)."""
        check_draw(runs, steps, rng)
        return _shared_out(self.terms, rng.choice(len(self.terms), runs, p=self.weights), steps, rng)


@dataclass(frozen=True, eq=False)
class Cases(Combination):
    """Disturbances with the same channels in turn: run i has term i mod m.

    Every case is met by as many runs, and which run met which is known: what `WorstCase` asks for. Cases in several
    places, side by side or in the starts, go in step: of numbers without a common divisor all pairs are met, of two and
    two the first with the first and the second with the second.

    Parameters
    ----------
    terms : tuple of Disturbance

    Examples
    --------
    >>> Stacked((Gaussian([0.3]), Cases.of([-0.2, 0.0, 0.2])))  # a road, and three loads
    ... # doctest: +SKIP
    """

    terms: tuple[Disturbance, ...]

    @classmethod
    def of(cls, values: ArrayLike) -> Cases:
        """Cases of an uncertain parameter with constant values (m,) or (m, nw)."""
        given = as_floats("values", values)
        rows = given[:, None] if given.ndim == 1 else given
        if rows.ndim != 2 or rows.size == 0:
            raise InputError("values", f"shape {given.shape}", "(m,) numbers, or (m, nw)")
        return cls(tuple(Uniform(row, row) for row in rows))

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> Array:
        """Sequences (runs, steps, nw)."""
        check_draw(runs, steps, rng)
        return _shared_out(self.terms, np.arange(runs) % len(self.terms), steps, rng)


def cases_in(disturbance: Any) -> int:
    """Number of runs after which the cases repeat; 1 without cases."""
    if not isinstance(disturbance, Combination) or isinstance(disturbance, Mixture):  # which draws, and counts no runs
        return 1
    own = len(disturbance.terms) if isinstance(disturbance, Cases) else 1
    return own * math.lcm(*map(cases_in, disturbance.terms))


def _shared_out(terms: tuple[Disturbance, ...], chosen: Indices, steps: int, rng: np.random.Generator) -> Array:
    """Sequences (runs, steps, nw), each from its run's chosen term."""
    least = min(len(chosen), 2)  # a recording replays a single run from its start: one of several runs must not do so
    counts = np.bincount(chosen, minlength=len(terms)).tolist()
    parts = {i: terms[i].sample(max(n, least), steps, rng) for i, n in enumerate(counts) if n}
    _check_alike([w.shape[-1] for w in parts.values()])
    drawn = np.empty((len(chosen), steps, next(iter(parts.values())).shape[-1]))
    for i, w in parts.items():
        drawn[chosen == i] = w[: counts[i]]
    return drawn


def is_recorded(disturbance: Any) -> bool:
    """Whether a disturbance or a term is a recording, so single runs repeat."""
    if isinstance(disturbance, Combination):
        return any(map(is_recorded, disturbance.terms))
    return isinstance(disturbance, Recorded)


def as_chances(argument: str, weights: ArrayLike | None, size: int, *, of: str) -> Array:
    """Probabilities (size,) from weights ≥ 0, not all zero; equal without weights."""
    if weights is None:
        return frozen(np.full(size, 1.0 / size))
    given = as_vector(argument, weights, size, of=of)
    if (given < 0).any() or not given.any():
        raise InputError(argument, shown(given), "numbers ≥ 0, one of them above 0")
    return frozen(given / given.max() / (given / given.max()).sum())


def _checked(argument: str, value: Any) -> tuple[Disturbance, ...]:
    try:
        terms = tuple(value)
    except TypeError:
        terms = ()
    if not terms:
        raise InputError(argument, shown(value), "a tuple of disturbances")
    for term in terms:
        has_method(argument, term, "sample", A_DISTURBANCE)
    return terms


def _check_alike(widths: list[int]) -> None:
    if len(set(widths)) > 1:
        raise InputError("terms", f"disturbances of {', '.join(map(str, widths))} channels", "as many in each")
