"""Beliefs about a state, their checks, prediction and update."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, Immutable, frozen
from ccdtools.estimation.tolerances import SINGULAR
from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import NO_DESIGN
from ccdtools.plants.plant import Plant
from ccdtools_ground.door import as_count, as_finite, as_floats, as_record, as_vector, as_weight
from mpc.exceptions import NotConvexError


@dataclass(frozen=True, eq=False)
class Belief:
    """Beliefs of n runs: estimates and their covariance.

    Attributes
    ----------
    mean : (n, nx) array
    covariance : (nx, nx) array of all runs, or (n, nx, nx)
    """

    mean: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class Estimates:
    """Estimates along a record of n runs and T samples.

    Attributes
    ----------
    means : (n, T, nx) array
        x̂_{k|k}.
    covariances : (T, nx, nx) array of all runs, or (n, T, nx, nx)
    innovations : (n, T, ny) array
        y_k less what was expected.
    innovation_covariances : (T, ny, ny) or (n, T, ny, ny) array
        What they should be like.
    """

    means: Array
    covariances: Array
    innovations: Array
    innovation_covariances: Array


def transposed(M: Array) -> Array:
    """Transposes of matrices (..., n, m)."""
    return M.swapaxes(-1, -2)


def propagated_covariance(P: Array, M: Array, noise: Array) -> Array:
    """Covariance M P Mᵀ + noise of M x with added noise, symmetric under rounding.

    With (F, W) that of a prediction, with (H, V) that of an innovation.
    """
    after = M @ P @ transposed(M) + noise
    return np.asarray((after + transposed(after)) / 2)


def gain_of(P: Array, H: Array, V: Array) -> Array:
    """Kalman gain P Hᵀ (H P Hᵀ + V)⁻¹ (..., nx, ny), in any units."""
    S = propagated_covariance(P, H, V)
    unit = np.sqrt(np.diagonal(S, axis1=-2, axis2=-1))
    scaled = S / unit[..., :, None] / unit[..., None, :]
    found = np.linalg.solve(scaled, (H @ P) / unit[..., :, None]) / unit[..., :, None]
    return transposed(found)


def updated_covariance(P: Array, H: Array, V: Array, K: Array) -> Array:
    """Updated covariance in Joseph's form, positive semidefinite under rounding."""
    rest = np.eye(P.shape[-1]) - K @ H
    return propagated_covariance(P, rest, K @ V @ transposed(K))


class Filter(Immutable):
    """Base of the filters, which have no memory: constant and costly to build, so copies are the same object."""

    x0: Any
    P0: Any
    W: Any
    V: Any
    nu: Any
    disturbance: Any = np.zeros(0), np.zeros((0, 0))  # mean and covariance of what else moves the plant

    @property
    def nx(self) -> int:
        """Number of states."""
        return len(self.x0)

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return len(self.V)

    def _transition(self, belief: Belief, u: Array) -> tuple[Array, Array, Any]:
        """Next states (n, nx), slopes (nx, nx) or (n, nx, nx), and covariance that they miss."""
        raise NotImplementedError

    def _expected(self, belief: Belief, u: Array) -> tuple[Array, Array, Any]:
        """Outputs (n, ny), slopes (ny, nx) or (n, ny, nx), and covariance that they miss."""
        raise NotImplementedError

    def expressed(self) -> Plant:
        """Plant of predicted states and outputs."""
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """Filter as plain values."""
        raise NotImplementedError

    def start(self, n: int) -> Belief:
        """Belief of n runs before the first measurement."""
        return Belief(np.tile(self.x0, (as_count("n", n), 1)), np.tile(self.P0, (n, 1, 1)))

    def predict(self, belief: Belief, u: ArrayLike) -> Belief:
        """Belief one sample later, after inputs (n, nu)."""
        mean, F, missed = self._transition(belief, rows_of("u", u, belief, self.nu))
        return Belief(mean, propagated_covariance(belief.covariance, F, self.W + missed))

    def innovation(self, belief: Belief, y: ArrayLike, u: ArrayLike) -> tuple[Array, Array]:
        """Innovation of y (n, ny) after u (n, nu), and its covariance (ny, ny) or (n, ny, ny)."""
        expected, H, missed = self._expected(belief, rows_of("u", u, belief, self.nu))
        return rows_of("y", y, belief, self.ny) - expected, propagated_covariance(belief.covariance, H, self.V + missed)

    def update(self, belief: Belief, y: ArrayLike, u: ArrayLike) -> Belief:
        """Belief after outputs (n, ny) measured after inputs (n, nu)."""
        expected, H, missed = self._expected(belief, rows_of("u", u, belief, self.nu))
        K, P = self._corrected(belief.covariance, H, self.V + missed)
        return Belief(
            belief.mean + ((rows_of("y", y, belief, self.ny) - expected)[:, None, :] @ transposed(K))[:, 0], P
        )

    def _corrected(self, P: Array, H: Array, V: Array) -> tuple[Array, Array]:
        """Gain of a measurement, and the covariance after it."""
        K = gain_of(P, H, V)
        return K, updated_covariance(P, H, V, K)

    def __deepcopy__(self, memory: Any) -> Self:
        return self

    def filter(self, outputs: ArrayLike, inputs: ArrayLike) -> Estimates:
        """Estimates along outputs ([n,] T, ny) and inputs ([n,] T, nu).

        ``inputs[k]`` is held from sample k to k + 1, as in a `Trajectory`; before the first the input is 0.
        """
        y = as_finite("outputs", as_record("outputs", outputs, self.ny))
        n, steps = y.shape[:2]
        u = as_finite("inputs", as_record("inputs", inputs, self.nu))
        if u.shape[:2] != (n, steps):
            raise InputError("inputs", f"shape {u.shape}", f"({n}, {steps}, {self.nu}), as many as outputs")
        belief = self.start(n)
        last = np.zeros((n, self.nu))
        rows: list[tuple[Array, Array, Array, Array]] = []
        for k in range(steps):
            belief = self.predict(belief, last) if k else belief
            innovation, S = self.innovation(belief, y[:, k], last)
            belief = self.update(belief, y[:, k], last)
            rows.append((belief.mean, belief.covariance, innovation, S))
            last = u[:, k]
        means, covariances, innovations, expected = (list(column) for column in zip(*rows))
        return Estimates(
            np.stack(means, axis=1), np.stack(covariances, axis=-3), np.stack(innovations, axis=1),
            np.stack(expected, axis=-3),
        )  # fmt: skip


def settled_plant(x: ca.SX, u: ca.SX, w: ca.SX, dynamics: ca.SX, **options: Any) -> Plant:
    """Plant without design."""
    return Plant(x, u, w, ca.SX(0, 1), dynamics, NO_DESIGN, **options)


def rows_of(argument: str, value: ArrayLike, belief: Belief, size: int) -> Array:
    """Signal (n, size) of a belief's runs; NaN is kept."""
    rows = as_floats(argument, value)
    if rows.shape != (len(belief.mean), size):
        raise InputError(argument, f"shape {rows.shape}", f"({len(belief.mean)}, {size}), a row for each run")
    return rows


def as_covariance(argument: str, value: Any, size: int, *, definite: bool = False, cure: str = "") -> Array:
    """Read-only covariance (size, size), also from its diagonal, in any units."""
    given = np.atleast_1d(as_finite(argument, as_floats(argument, value)))
    if given.shape not in ((size,), (size, size)):
        raise InputError(argument, f"shape {given.shape}", f"a covariance ({size}, {size}), or variances ({size},)")
    kind = f"positive {'definite' if definite else 'semidefinite'}"
    full = np.diag(given) if given.ndim == 1 else given
    if (np.diag(full) < 0).any():
        raise InputError(argument, "a negative variance", f"a symmetric, {kind} matrix", cure)
    try:
        M = as_weight(argument, full, size)
    except NotConvexError as error:
        got = "a matrix that is not symmetric" if error.eigenvalue is None else "an indefinite matrix"
        raise InputError(argument, got, f"a symmetric, {kind} matrix", cure) from None
    deviation = np.sqrt(np.diag(M))
    if definite and not (deviation > 0).all():
        raise InputError(argument, "a variance of 0", f"a {kind} matrix", cure)
    if definite and np.linalg.eigvalsh(M / deviation / deviation[:, None])[0] < SINGULAR:
        raise InputError(argument, "a singular matrix", f"a {kind} one", cure)
    return frozen(M)


def as_noise_covariances(W: ArrayLike, V: ArrayLike, nx: int, ny: int) -> tuple[Array, Array]:
    """Covariances of the process and measurement noise."""
    cure = "Give an output without noise a small variance."
    return as_covariance("W", W, nx), as_covariance("V", V, ny, definite=True, cure=cure)


def as_start(x0: ArrayLike | None, P0: ArrayLike | None, nx: int) -> tuple[Array, Array]:
    """First estimate (nx,), 0 by default, and its covariance."""
    if P0 is None:
        cure = "How far the first state may lie from x0; steady=True of a KalmanFilter needs none."
        raise InputError("P0", "nothing", f"the covariance ({nx}, {nx}) of the first state", cure)
    estimate = frozen(np.zeros(nx)) if x0 is None else as_vector("x0", x0, nx, of="one per state")
    return estimate, as_covariance("P0", P0, nx)
