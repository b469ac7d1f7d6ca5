"""`Polytope`: inequalities and optional equalities."""

from __future__ import annotations

from typing import Any

import numpy as np

from invariant_sets.bodies import Body
from invariant_sets.linear_programs import minimise
from invariant_sets.operations import SetOperations, same_space
from invariant_sets.polyhedron import Polyhedron, nonempty_body
from invariant_sets.tolerances import MEMBERSHIP, PLACE, ROUNDING
from invariant_sets.validation import as_count, as_generator, check_tolerance

Array = np.ndarray


class Polytope(SetOperations):
    __doc__ = Polyhedron.__doc__

    def is_subset(self, other: Polyhedron, tol: float = MEMBERSHIP) -> bool:
        """Whether P ⊆ Q; the empty set is in every set.

        Parameters
        ----------
        other : Polytope
            Q, of the same dimension.
        tol : float
            P may leave a row of Q by `tol` times its range over the bounding boxes of the sets, or if that is more by
            rounding: of the row's data (1e-12 of |bᵢ| + |Aᵢ||x|), or of the place of P where its equalities had to be
            solved (4e-15 of the terms it was solved from, which are large where they are nearly dependent).
        """
        other = same_space(self, other)
        tol = check_tolerance(tol)
        if self.body is None:
            return True
        if other.body is None:
            return False
        A, b = other.one_sided
        ranges = np.maximum(other.ranges, np.abs(A) @ self.widths)
        rounding = min(tol, ROUNDING) * (other.row_terms + np.abs(A) @ np.abs(self.body.centre))
        place = min(tol, PLACE) * (np.abs(A) @ self.body.terms)
        slack = np.maximum.reduce([tol * ranges, rounding, place, (tol > 0) * other.missed])
        return bool((self.support(A) <= b + slack).all())

    def equals(self, other: Polyhedron, tol: float = MEMBERSHIP) -> bool:
        """Whether P and Q are the same points, to relative `tol`."""
        return self.is_subset(other, tol) and Polytope.is_subset(other, self, tol)  # type: ignore[arg-type]

    def chebyshev_ball(self) -> tuple[Array, float]:
        """Centre (n,) and radius of a largest ball, 0 if flat, maybe inf.

        The ball is Euclidean in the units of x. Raises `EmptySetError`.

        References
        ----------
        Boyd, Vandenberghe (2004), Convex Optimization, section 8.5.1.
        """
        body = nonempty_body(self, "chebyshev_ball")
        if body.basis.shape[1] < self.dim:
            return body.centre.copy(), 0.0
        if not len(body.g):
            return body.centre.copy(), np.inf
        norms = np.linalg.norm(body.F @ body.inverse, axis=1)  # of the rows in the units of x
        unit = float((body.g / norms).min())
        rows = np.vstack([np.column_stack([body.F, unit * norms]), np.append(np.zeros(self.dim), -1.0)])
        size = np.linalg.norm(rows, axis=1)
        cost = np.append(np.zeros(self.dim), -1.0)
        value, y = minimise(cost, rows / size[:, None], np.append(body.g, 0.0) / size)
        if y is None:
            return body.centre.copy(), np.inf
        return body.centre + body.basis @ y[:-1], -value * unit

    def sample(self, n: int, *, rng: np.random.Generator) -> Array:
        """Sample of n points, nearly uniform in the set.

        Parameters
        ----------
        n : int
            Number of points.
        rng : numpy.random.Generator
            Source of randomness.

        Returns
        -------
        (n, dim) array

        Raises
        ------
        EmptySetError, UnboundedError

        References
        ----------
        Smith (1984), Efficient Monte Carlo procedures for generating points uniformly distributed over bounded regions,
        Operations Research 32(6): hit and run. Lovász, Vempala (2006), Hit-and-run from a corner, SIAM J. Computing
        35(4): why the body is made round first. Assumes a bounded set.
        """
        n = as_count("n", n, least=0)
        rng = as_generator("rng", rng)
        body = self._require_bounded("sample")
        if body.basis.shape[1] == 0:
            return np.repeat(body.centre[None], n, axis=0)
        return np.asarray(body.centre + _hit_and_run(body, n, rng) @ body.basis.T)

    def __repr__(self) -> str:
        equalities = f", {len(self.b_eq)} equalities" if len(self.b_eq) else ""
        return f"Polytope(dim={self.dim}, {len(self.b)} inequalities{equalities})"

    def _repr_html_(self) -> str:
        facts: dict[str, Any] = {
            "dimension": self.dim,
            "inequalities": len(self.b),
            "equalities": len(self.b_eq),
            "empty": self.is_empty,
            "bounded": self.is_bounded,
            "dimension of its affine hull": self.affine_dim,
        }
        if not self.is_empty:
            lower, upper = self.bounding_box()
            for i in range(self.dim):
                facts[f"x<sub>{i}</sub>"] = f"[{lower[i]:.6g}, {upper[i]:.6g}]"
        rows = "".join(f"<tr><th>{name}</th><td>{value}</td></tr>" for name, value in facts.items())
        return f"<table><caption>Polytope</caption>{rows}</table>"

    def plot(self, ax: Any = None, **style: Any) -> Any:
        """Draw the set or its projection; return the artist.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Where to draw; a new one if left out.
        **style
            Passed to the matplotlib artist, for example color, alpha, label.
        """
        from invariant_sets.plotting import plot_polytope

        return plot_polytope(self, ax=ax, **style)


def _hit_and_run(body: Body, n: int, rng: np.random.Generator) -> Array:
    """Sample of n points (n, k) in coordinates y, one chain each from y = 0."""
    # directions have the covariance that a shorter run has found: without that a slanted body mixes slowly
    k = body.F.shape[1]
    shape: Array = np.eye(k)
    for _ in range(2):
        trial = _walk(body, np.zeros((40 * k, k)), shape, 10 * k, rng)
        shape = np.linalg.cholesky(np.cov(trial, rowvar=False).reshape(k, k))
    return _walk(body, np.zeros((n, k)), shape, 20 * k, rng)


def _walk(body: Body, Y: Array, shape: Array, steps: int, rng: np.random.Generator) -> Array:
    """Points Y (n, k) after `steps` moves to uniform points of chords."""
    for _ in range(steps):
        direction = rng.standard_normal(Y.shape) @ shape.T
        speed = direction @ body.F.T
        room = np.maximum(body.g - Y @ body.F.T, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = room / speed
        ahead = np.where(speed > 0, reach, np.inf).min(axis=1)
        behind = np.where(speed < 0, reach, -np.inf).max(axis=1)
        Y = Y + (behind + (ahead - behind) * rng.random(len(Y)))[:, None] * direction
    return Y
