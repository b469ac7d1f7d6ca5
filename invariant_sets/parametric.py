"""Invariant sets as functions of the design p."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np

from invariant_sets.engine.invariance import Task, largest_invariant_set
from invariant_sets.engine.recursion import Limits
from invariant_sets.exceptions import InputError
from invariant_sets.maximal_sets import as_limits
from invariant_sets.polytope import Polytope
from invariant_sets.results import SetResult, Status
from invariant_sets.system_checks import Set, as_set_or_numbers, checked_system
from invariant_sets.tolerances import COARSE, MEMBERSHIP
from invariant_sets.validation import (
    as_batch,
    as_count,
    as_floats,
    as_generator,
    as_matrix,
    as_vector,
    check_tolerance,
    frozen,
)

Array = np.ndarray
SetOfDesign = Callable[[Array], Set]


@dataclass(frozen=True, eq=False, repr=False)
class ParametricSet:
    """Maximal control invariant sets C(p) for designs p (np,).

    Parameters
    ----------
    matrices : callable
        p (np,) → (A, B) or (A, B, E), arrays (nx, nx), (nx, nu) and (nx, nw).
    X, U : Polytope, bounds (lower, upper), or callable
        State and input constraints. A bound is an array of one number a coordinate, or a number for all of them. A
        callable gives the set of a design p (np,).
    W : Polytope, bounds (lower, upper), or callable, optional
        Disturbance set, or that of a design p (np,); the sets are then robust. E is the third matrix, or the identity.
    tol : float
        Passed to `maximal_control_invariant_set`, as are the next two.
    max_iterations, max_facets : int
        Caps for one design.
    time_limit : float, optional
        Latest end of the computation for one design, in seconds; no limit if left out.
    warm_start : bool
        Whether to start from the set of the nearest design known, where that one took more than 20 steps.

    Notes
    -----
    One result per design is computed and kept; p is compared bit by bit.

    Warm start: the recursion begins at X ∩ S instead of X, with S a neighbour's set inflated about its mean
    vertex, and ends at the largest invariant set C_S in S. If no row of S touches C_S, then C_S is the answer: for the
    true set C ⊇ C_S, (1 − t) C_S ⊕ t C is invariant for every t in [0, 1], and lies in S for small t, so it is part
    of C_S; hence C ⊆ C_S. If a row does touch, the design is computed again from X.

    References
    ----------
    Blanchini, Miani (2015), Set-Theoretic Methods in Control, chapter 5: convexity of invariant sets.
    """

    matrices: Callable[[Array], tuple[Any, ...]]
    X: Set | SetOfDesign
    U: Set | SetOfDesign
    _: KW_ONLY
    W: Set | SetOfDesign | None = None
    tol: float = COARSE
    max_iterations: int = 500
    max_facets: int = 1000
    time_limit: float | None = None
    warm_start: bool = True
    _results: dict[bytes, SetResult] = field(default_factory=dict, init=False)
    _slow: list[tuple[Array, SetResult]] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        if not callable(self.matrices):
            raise InputError("matrices", type(self.matrices).__name__, "a callable p -> (A, B)")
        for name, value in (("X", self.X), ("U", self.U), ("W", self.W)):
            if not _varies(value) and (value is not None or name != "W"):
                object.__setattr__(self, name, as_set_or_numbers(value, name))
        self._limits()  # raises where one of them is no proper number

    def __repr__(self) -> str:
        nx, nu = (S.dim if isinstance(S, Polytope) else "any" for S in (self.X, self.U))
        return (
            f"ParametricSet(nx={nx}, nu={nu}, {'robust' if self.W is not None else 'nominal'}, "
            f"{len(self._results)} designs known)"
        )

    def _limits(self) -> Limits:
        """Tolerance and caps of every design, with time from now."""
        return as_limits(self.tol, self.max_iterations, self.max_facets, self.time_limit)

    def result(self, p: Any) -> SetResult:
        """Result with status and certificate at one design p (np,)."""
        p = as_vector(p, "p") + 0.0  # −0 and 0 are one design
        key = p.tobytes()
        if key not in self._results:
            warm = self._warm(p) if self.warm_start else None
            self._results[key] = result = self._cold(p) if warm is None else warm
            # below so many steps a cold start is quicker than one from a neighbour
            if result.iterations > 20 and result.status is Status.CONVERGED:
                self._slow.append((p, result))
        return self._results[key]

    def at(self, p: Any) -> Polytope:
        """Maximal control invariant set at one design p (np,)."""
        return self.result(p).set

    def compute(self, designs: Any, *, n_jobs: int = 1) -> list[SetResult]:
        """Results of several designs (k, np), computed in parallel.

        Parameters
        ----------
        designs : (k, np) array
            Designs, one a row.
        n_jobs : int
            Number of processes for joblib; −1 for all cores. `joblib.parallel_config(backend="dask")` around the
            call runs it on a cluster.
        """
        designs = as_matrix(designs, "designs") + 0.0
        if isinstance(n_jobs, bool) or not isinstance(n_jobs, int) or n_jobs == 0:
            raise InputError("n_jobs", repr(n_jobs)[:60], "an integer other than 0")
        missing = [p for p in np.unique(designs, axis=0) if p.tobytes() not in self._results]
        if n_jobs != 1 and len(missing) > 1:
            from joblib import Parallel, delayed

            computed = Parallel(n_jobs=n_jobs)(delayed(self._cold)(p) for p in missing)
            self._results.update((p.tobytes(), result) for p, result in zip(missing, computed))
        return [self.result(p) for p in designs]

    def contains(self, x: Any, p: Any, tol: float = MEMBERSHIP) -> Any:
        """Whether x[i] lies in C(p[i]).

        Parameters
        ----------
        x : (nx,) or (k, nx) array
            States. A state with NaN is in no set.
        p : (np,) or (k, np) array
            Designs, one a sample; or one for all.
        tol : float
            As in `Polytope.contains`.

        Returns
        -------
        bool, or (k,) array of bools
        """
        states, single = as_batch(x, "x", self._states(p), finite=False)
        tol = check_tolerance(tol)
        inside = np.zeros(len(states), bool)
        for design, members in self._groups(p, len(states)):
            inside[members] = self.at(design).contains(states[members], tol)
        return bool(inside[0]) if single else inside

    def _states(self, p: Any) -> int:
        """Number of states, from X or the first design."""
        if isinstance(self.X, Polytope):
            return self.X.dim
        designs, _ = _designs(p)
        if not len(designs):
            raise InputError("p", "no designs", "at least one, where X is two numbers for every state or a callable")
        return self.at(designs[0]).dim

    def _groups(self, p: Any, count: int) -> Iterator[tuple[Array, Array]]:
        """Yield every different design and its samples."""
        designs, _ = _designs(p)
        if len(designs) == 1:
            designs = np.broadcast_to(designs, (count, designs.shape[1]))
        if len(designs) != count:
            raise InputError("p", f"{len(designs)} rows", f"{count} as in x, or one")
        unique, group = np.unique(designs, axis=0, return_inverse=True)
        order = np.argsort(group.ravel(), kind="stable")
        ends = np.cumsum(np.bincount(group.ravel(), minlength=len(unique)))
        yield from zip(unique, np.split(order, ends[:-1]))

    def sample(self, p: Any, n: int, *, rng: np.random.Generator) -> Array:
        """Sample (n, nx) or (k, n, nx) nearly uniform in C(p)."""
        n = as_count("n", n, least=0)
        rng = as_generator("rng", rng)
        designs, single = _designs(p)
        drawn = [self.at(design).sample(n, rng=rng) for design in designs]
        x = np.array(drawn).reshape(len(designs), n, self._states(p))
        return x[0] if single else x

    def volume(self, p: Any) -> Any:
        """Volume of C(p): a float, or (k,) for p (k, np)."""
        designs, single = _designs(p)
        volumes = np.array([self.at(design).volume for design in designs])
        return float(volumes[0]) if single else volumes

    def volume_gradient(self, p: Any, *, step: float = 1e-3) -> Array:
        """Derivative (np,) of the volume with respect to the design.

        Parameters
        ----------
        p : (np,) array
            Design; `matrices` must be defined on p ± step as well.
        step : float
            Step, relative to |pᵢ| (to 1 where pᵢ = 0).

        Notes
        -----
        Central differences with one Richardson step: error O(step⁴) where the facets do not change between the
        four designs, and rounding of about 1e-12/step, relative to the volume per relative change of p. Where
        a facet appears, the volume still has a continuous first derivative in general, and the error is O(step).
        """
        p = as_vector(p, "p")
        step = check_tolerance(step, "step")
        if not 0 < step < 1:
            raise InputError("step", step, "a number between 0 and 1")
        gradient = np.empty(len(p))
        for i, value in enumerate(p):
            h = step * (abs(value) if value != 0 else 1.0)
            move = h * np.eye(len(p))[i]
            near = (self.volume(p + move / 2) - self.volume(p - move / 2)) / h
            far = (self.volume(p + move) - self.volume(p - move)) / (2 * h)
            gradient[i] = (4 * near - far) / 3
        return gradient

    # --- one design -----------------------------------------------------------------------------------------

    def _cold(self, p: Array, guess: Polytope | None = None) -> SetResult:
        """Result computed from X, or from X and a guess."""
        p = frozen(p)  # one array for three functions of the caller's
        answer = self.matrices(p)
        if not isinstance(answer, tuple) or len(answer) not in (2, 3):
            raise InputError("matrices", f"a value of type {type(answer).__name__}", "a tuple (A, B) or (A, B, E)")
        E = answer[2] if len(answer) == 3 and self.W is not None else None
        W = None if self.W is None else as_set_or_numbers(_set_at(self.W, p), "W")
        system = checked_system(answer[0], answer[1], _set_at(self.X, p), _set_at(self.U, p), E, W)
        return largest_invariant_set(Task(*system, self._limits()), guess)

    def _warm(self, p: Array) -> SetResult | None:
        """Result from an inflated slow neighbour; None without one, or if its rows are felt."""
        size = max(float(np.abs(p).max(initial=0.0)), np.finfo(float).tiny)
        near = [
            (float(np.abs(p - q).max(initial=0.0)) / size, k) for k, (q, _) in enumerate(self._slow) if len(q) == len(p)
        ]
        distance, k = min(near, default=(np.inf, 0))
        if distance > 0.02:
            return None
        around = self._slow[k][1].outer
        if around.affine_dim < around.dim or not around.is_bounded:
            return None
        middle = around.vertices.mean(axis=0)
        room = around.b - around.A @ middle
        limit = around.b + min(0.2, 10 * distance + MEMBERSHIP) * room
        result = self._cold(p, Polytope(around.A, limit))
        if result.status is not Status.CONVERGED or result.set.is_empty:
            return None
        felt = result.outer.support(around.A) >= limit - COARSE * room
        return None if felt.any() else result


def _varies(S: Any) -> bool:
    """Whether a set is a function of the design."""
    return callable(S) and not isinstance(S, (type, Polytope))


def _set_at(S: Any, p: Array) -> Set:
    """Set at one design (np,), given itself or as a function."""
    there: Set = S(p) if _varies(S) else S
    return there


def _designs(p: Any) -> tuple[Array, bool]:
    """Designs (k, np), and whether p was a single one (np,)."""
    values = as_floats("p", p)
    if values.ndim < 2:
        return as_vector(values, "p")[None], True
    return as_matrix(values, "p"), False
