"""Invariant sets as functions of the design p."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from .control_invariant import maximal_control_invariant_set
from .exceptions import InputError
from .polytope import Polytope
from .results import SetResult
from .validation import as_batch, as_vector, check_tolerance

Array = np.ndarray


class ParametricSet:
    """The maximal control invariant sets C(p) of x⁺ = A(p) x + B(p) u [+ E(p) w], computed when asked for.

    Parameters
    ----------
    matrices : callable
        p (np,) → (A, B) or (A, B, E), arrays (nx, nx), (nx, nu) and (nx, nw).
    X, U : Polytope
        State and input constraints.
    W : Polytope, optional
        Disturbance set; the sets are then robust. E is the third matrix, or the identity.
    tol : float
        Passed to `maximal_control_invariant_set`.
    max_iterations : int
        Passed to `maximal_control_invariant_set`.

    Notes
    -----
    One set per design is computed and kept. p is compared exactly, bit by bit.
    """

    def __init__(self, matrices: Callable[[Array], tuple[Any, ...]], X: Polytope, U: Polytope, *,
                 W: Polytope | None = None, tol: float = 1e-7, max_iterations: int = 500) -> None:
        if not callable(matrices):
            raise InputError(f"matrices must be a callable p -> (A, B), got {type(matrices).__name__}.")
        for name, value in (("X", X), ("U", U)):
            if not isinstance(value, Polytope):
                raise InputError(f"{name} must be a Polytope, got {type(value).__name__}.")
        self.matrices, self.X, self.U, self.W = matrices, X, U, W
        self.tol, self.max_iterations = check_tolerance(tol), max_iterations
        self._cache: dict[bytes, SetResult] = {}

    def result(self, p: Any) -> SetResult:
        """Return the whole result, with status and certificate, at one design p (np,)."""
        p = as_vector(p, "p") + 0.0
        key = p.tobytes()
        if key not in self._cache:
            self._cache[key] = self._compute(p)
        return self._cache[key]

    def at(self, p: Any) -> Polytope:
        """Return the maximal control invariant set at one design p (np,)."""
        return self.result(p).set

    def contains(self, x: Any, p: Any, tol: float = 1e-9) -> Any:
        """Return whether x[i] lies in C(p[i]).

        Parameters
        ----------
        x : (nx,) or (k, nx) array
            States.
        p : (np,) or (k, np) array
            Designs, one a sample; or one for all.
        tol : float
            As in `Polytope.contains`.

        Returns
        -------
        bool, or (k,) array of bools
        """
        states, single = as_batch(x, "x", self.X.dim, finite=False)
        designs = np.atleast_2d(as_batch(p, "p", np.shape(p)[-1] if np.ndim(p) else 1)[0])
        if len(designs) == 1:
            designs = np.broadcast_to(designs, (len(states), designs.shape[1]))
        if len(designs) != len(states):
            raise InputError(f"p has {len(designs)} rows, expected {len(states)} as in x, or one.")
        inside = np.zeros(len(states), bool)
        unique, group = np.unique(designs, axis=0, return_inverse=True)
        order = np.argsort(group.ravel(), kind="stable")
        for design, members in zip(unique, np.split(order, np.cumsum(np.bincount(group.ravel()))[:-1])):
            inside[members] = self.at(design).contains(states[members], tol)
        return bool(inside[0]) if single else inside

    def _compute(self, p: Array) -> SetResult:
        A, B, *rest = self.matrices(p)
        E = rest[0] if rest and self.W is not None else None
        return maximal_control_invariant_set(A, B, self.X, self.U, E=E, W=self.W, tol=self.tol,
                                             max_iterations=self.max_iterations)
