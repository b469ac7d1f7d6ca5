"""Random starts: uniform in a set, by distribution, or among states."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from ccdtools.arrays import Array, ArrayField, Immutable
from ccdtools.design_limits import widest
from ccdtools.disturbances.combinations import Combination, Stacked, Sum, as_chances
from ccdtools.disturbances.disturbance import NO_DISTURBANCE, Disturbance, Uniform, check_draw
from ccdtools.exceptions import InputError
from ccdtools_ground.door import as_array, as_floats, has_method, shown
from invariant_sets import Polytope

KINDS = "a Polytope, a distribution such as Uniform(lower, upper), or states (n, nx)"


@dataclass(frozen=True, eq=False, repr=False)
class RandomStarts(Immutable):
    """Starts drawn for every run, with fresh disturbances.

    Parameters
    ----------
    x0 : Polytope, distribution or (n, nx) array_like
        Uniform in a bounded set with an interior, such as the state limits or X_fea at one design; the first sample of
        a distribution such as `Uniform(lower, upper)`, `Gaussian(std, mean)` or a `Mixture` of them; or one of given
        states.
    disturbance : Disturbance
        By default none, of a plant without w.
    weights : (n,) array_like, optional
        How likely each of the given states is, up to a common factor; all alike by default.

    Raises
    ------
    InputError
        If `x0` is of another kind, or a set that is empty, flat or unbounded; or weights do not belong to states.

    Examples
    --------
    >>> scenarios = RandomStarts(problem.X, Gaussian([0.1]))
    >>> scenarios = RandomStarts(feasible_sets(problem).result(design).set, Gaussian([0.1]))
    """

    x0: Any
    disturbance: Disturbance = NO_DISTURBANCE
    weights: ArrayField = None

    def __post_init__(self) -> None:
        has_method("disturbance", self.disturbance, "sample", "a disturbance, such as Gaussian([0.1])")
        if isinstance(self.x0, Polytope):
            _check_body(self.x0)
        elif not callable(getattr(self.x0, "sample", None)):
            states = as_floats("x0", self.x0, expected=KINDS)
            if states.ndim != 2:
                cure = "One state is a FixedStart." if states.ndim < 2 else ""
                raise InputError("x0", f"shape {states.shape}", KINDS, cure)
            states = as_array("x0", states, ("n", "nx"))
            self._set(x0=states)
            chances = as_chances("weights", self.weights, len(states), of="one per state")
            self._set(weights=chances)
            return
        elif isinstance(self.x0, type):
            raise InputError("x0", shown(self.x0), "an object of it")
        if self.weights is not None:
            raise InputError("weights", shown(self.weights), "nothing, as x0 is no list of states")

    def __repr__(self) -> str:
        kind = f"{len(self.x0)} states" if isinstance(self.x0, np.ndarray) else repr(self.x0)
        return f"RandomStarts({kind}, {self.disturbance!r})"

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Initial states (runs, nx) and disturbances (runs, steps, nw)."""
        check_draw(runs, steps, rng)
        return self.states(runs, rng), self.disturbance.sample(runs, steps, rng)

    def states(self, runs: int, rng: np.random.Generator) -> Array:
        """Initial states (runs, nx) alone."""
        if isinstance(self.x0, Polytope):
            return uniform_in(self.x0, runs, rng)
        if isinstance(self.x0, np.ndarray):
            return np.asarray(self.x0[rng.choice(len(self.x0), runs, p=self.weights)])
        return np.asarray(self.x0.sample(runs, 1, rng)[:, 0])

    def check_for(self, problem: Any) -> None:
        """Raise an `InputError` if a start may lie outside X at every design."""
        self.check_within(widest(problem.X))

    def check_within(self, X: Polytope) -> None:
        """Raise an `InputError` if a start may lie outside X; other parts than uniform ones pass."""
        if isinstance(self.x0, np.ndarray):
            outside = np.flatnonzero(~X.contains(self.x0))
            if len(outside):
                got = f"{self.x0[outside[0]].tolist()} as state {outside[0] + 1}, which is outside X"
                raise InputError("scenarios.x0", got, "states within X")
            return
        body = self.x0
        if isinstance(body, Polytope):
            inside = body.is_subset(X)
        else:  # each box, by its worst point along each row
            inside = all(X.contains(np.where(X.A > 0, high, low)).all() for low, high in _boxes(body))
        if not inside:
            raise InputError("scenarios.x0", f"{body!r}, which reaches outside X", "a set within X", "Intersect them.")


def _boxes(starts: Any) -> list[Any]:
    """Boxes that the uniform parts of a distribution fill."""
    if isinstance(starts, Uniform):
        return [(starts.lower, starts.upper)]
    if isinstance(starts, Stacked | Sum):
        joined: Any = np.concatenate if isinstance(starts, Stacked) else sum
        return [tuple(map(joined, zip(*boxes))) for boxes in product(*map(_boxes, starts.terms))]
    terms = starts.terms if isinstance(starts, Combination) else ()
    drawn = np.flatnonzero(getattr(starts, "weights", np.ones(len(terms))))
    return [box for i in drawn for box in _boxes(terms[i])]


def uniform_in(S: Polytope, n: int, rng: np.random.Generator) -> Array:
    """Points (n, dim) uniform in a bounded set.

    They are those of its box that lie in it, or by hit and run where few do.

    Parameters
    ----------
    S : Polytope
        Bounded, with an interior.

    References
    ----------
    Smith, "Efficient Monte Carlo procedures for generating points uniformly distributed over bounded regions",
    Operations Research 32(6), 1984.
    """
    lower, upper = S.bounding_box()
    tried = rng.uniform(lower, upper, (40 * n, S.dim))  # for each wanted; if few lie in S, hit and run takes over
    found: Array = tried[S.contains(tried)]
    if len(found) >= n:
        return found[:n]
    return np.asarray(S.sample(n, rng=rng))


def _check_body(S: Polytope) -> None:
    """Raise an `InputError` unless a set is bounded with interior."""
    if S.is_empty:
        raise InputError("x0", "an empty set", "one with at least one point")
    if not np.isfinite(np.concatenate(S.bounding_box())).all():
        raise InputError("x0", "an unbounded set", "a bounded one")
    if not S.chebyshev_ball()[1] > 0:
        raise InputError("x0", "a set without an interior", "one with a volume", "Give the states as an array (n, nx).")
