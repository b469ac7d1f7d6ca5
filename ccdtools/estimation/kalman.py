"""Kalman filters of linear models."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, ArrayField, frozen
from ccdtools.estimation.belief import (
    Belief,
    Filter,
    as_noise_covariances,
    as_start,
    gain_of,
    propagated_covariance,
    rows_of,
    settled_plant,
    updated_covariance,
)
from ccdtools.estimation.outputs import LINEARISED, output_matrices
from ccdtools.estimation.steady_state import steady_covariance
from ccdtools.estimation.tolerances import MOVED_AT_REST
from ccdtools.exceptions import InputError
from ccdtools.plants.discretisation import discretise
from ccdtools.plants.linear_model import LinearModel
from ccdtools.plants.plant import Plant
from ccdtools_ground.door import as_array, as_count, as_finite, as_flag, as_floats, as_instance, as_vector


@dataclass(frozen=True, eq=False, repr=False)
class KalmanFilter(Filter):
    """Least-variance estimates of the state of a linear model.

    In current form: x̂_{k|k} has y_k in it. The filter has no memory itself; `Observed` gives it one in a closed loop,
    `filter` runs it along a record. The model is x⁺ = A x + B u + c + w, y_k = C x_k + D u_{k-1} + y0 + v_k.

    Parameters
    ----------
    A, B, C : (nx, nx), (nx, nu) and (ny, nx) array_like
        Of a discrete model, such as ``model.matrices(p)``; `of` takes all of them from a linear plant with outputs.
    W, V : (nx, nx) and (ny, ny) array_like
        Covariances of the process noise of a sample, in states, and of the measurement noise; variances (nx,), (ny,)
        where they are diagonal. `noise_covariance` gives W of continuous noise; held noise of covariance S has E S Eᵀ.
    D : (ny, nu) array_like, optional
        Of outputs that depend on the input, which see the one applied until then; 0 by default.
    y0 : (ny,) array_like, optional
        Outputs at x = 0, u = 0, such as those of a plant at rest; 0 by default.
    c : (nx,) array_like, optional
        Mean of the process noise of a sample, in states; 0 by default.
    steady : bool
        Whether the gain is the constant one of long runs; else it starts at P0 and changes over time.
    x0 : (nx,) array_like, optional
        Estimate before the first measurement; 0 by default.
    P0 : (nx, nx) or (nx,) array_like, optional
        Its covariance, needed without `steady`; with it, it is the covariance of long runs.

    Attributes
    ----------
    gain : (nx, ny) array
        M of the steady x̂_{k|k} = x̂_{k|k-1} + M (y_k − ŷ_k); the predicting form has A M.
    covariance, predicted : (nx, nx) array
        Of x given y up to the present, and up to a sample ago, in the long run.
    poles : (nx,) array
        Eigenvalues of the error of the steady filter.

    Raises
    ------
    InputError
        If sizes disagree, W is not positive semidefinite or V not positive definite, P0 is missing or not asked for.
    NotDetectableError
        With `steady`, if the outputs do not see a mode that does not decay, or no noise reaches one on the unit circle.

    References
    ----------
    Anderson, Moore (1979), Optimal filtering, chapters 3 and 4; Bucy, Joseph (1968) for the update of covariances.

    Examples
    --------
    >>> estimator = KalmanFilter(A, B, [[1.0, 0.0]], W=E @ E.T * 0.01, V=[1e-4])
    >>> controller = Observed(LinearFeedback(K), estimator)
    """

    A: ArrayField
    B: ArrayField
    C: ArrayField
    W: ArrayField
    V: ArrayField
    D: ArrayField = field(default=None, kw_only=True)
    y0: ArrayField = field(default=None, kw_only=True)
    c: ArrayField = field(default=None, kw_only=True)
    steady: bool = field(default=True, kw_only=True)
    x0: ArrayField = field(default=None, kw_only=True)
    P0: ArrayField = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        A = as_array("A", np.atleast_2d(as_floats("A", self.A)), ("nx", "nx"))
        nx = len(A)
        if A.shape != (nx, nx):
            raise InputError("A", f"shape {A.shape}", "a square matrix (nx, nx)")
        B = as_finite("B", as_floats("B", self.B))
        if B.ndim != 2 or len(B) != nx:
            raise InputError("B", f"shape {B.shape}", f"({nx}, nu)")
        C = as_array("C", self.C, ("ny", nx))
        ny = len(C)
        D = np.zeros((ny, B.shape[1])) if self.D is None else as_array("D", self.D, (ny, B.shape[1]))
        y0 = np.zeros(ny) if self.y0 is None else as_vector("y0", self.y0, ny, of="one per output")
        c = np.zeros(nx) if self.c is None else as_vector("c", self.c, nx, of="one per state")
        W, V = as_noise_covariances(self.W, self.V, nx, ny)
        self._set(steady=as_flag("steady", self.steady))
        if self.steady and self.P0 is not None:
            raise InputError("P0", "a covariance", "nothing with steady=True", "Pass steady=False to start from it.")
        self._set(A=A, B=B, C=C, D=D, y0=y0, c=c, W=W, V=V)
        x0, P0 = as_start(self.x0, self.predicted if self.steady else self.P0, nx)
        self._set(x0=x0, P0=None if self.steady else P0)

    @classmethod
    def of(
        cls, plant: Plant, *, W: ArrayLike, V: ArrayLike, design: ArrayLike = (), steady: bool = True,
        x0: ArrayLike | None = None, P0: ArrayLike | None = None,
    ) -> KalmanFilter:  # fmt: skip
        """Filter of a linear plant's outputs at a design (np,), as of `linearise`.

        Raises
        ------
        InputError
            Also if the dynamics or the outputs are not linear in x and u, there are no outputs, or x = 0 is no rest: a
            constant term is rounding below a millionth of the deviation that the filter predicts for its state.
        """
        as_instance("plant", plant, Plant, "a Plant")
        model = discretise(plant, sampling_guard="ignore") if plant.linear else None
        if not isinstance(model, LinearModel):
            raise InputError("plant", "nonlinear dynamics", "a linear plant that rests at 0", LINEARISED)
        A, B, _ = model.matrices(design)
        c = model.constant(design)
        C, D, y0 = output_matrices(plant, model.design.check_one(design) if model.design is not None else np.zeros(0))
        found = cls(A, B, C, W, V, D=D, y0=y0, steady=steady, x0=x0, P0=P0)
        P = found.predicted if found.steady else propagated_covariance(found.P0, A, found.W)
        if (np.abs(c) > MOVED_AT_REST * np.sqrt(np.maximum(np.diag(P), 0.0))).any():
            got = f"a constant term in the dynamics, up to {np.abs(c).max():.3g} a sample"
            raise InputError("plant", got, "a linear plant that rests at 0", LINEARISED)
        return found

    def __repr__(self) -> str:
        kind = "steady" if self.steady else "time-varying"
        return f"KalmanFilter({self.nx} states, {self.nu} inputs, {self.ny} outputs, {kind})"

    def expressed(self) -> Plant:
        """Discrete plant of predicted states, without c, and outputs."""
        x, u = ca.SX.sym("x", self.nx), ca.SX.sym("u", self.nu)
        after, y = (ca.DM(M) @ x + ca.DM(N) @ u for M, N in ((self.A, self.B), (self.C, self.D)))
        return settled_plant(x, u, ca.SX(0, 1), after, dt=1.0, continuous=False, outputs=y + self.y0)

    def to_dict(self) -> dict[str, Any]:
        """Filter as plain values, which `KalmanFilter` takes."""
        given = ((one.name, getattr(self, one.name)) for one in fields(self))
        return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in given}

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return int(self.B.shape[1])

    @cached_property
    def predicted(self) -> Array:
        """Steady covariance (nx, nx) of x_k given y up to k − 1."""
        return frozen(steady_covariance(self.A, self.C, self.W, self.V))

    @cached_property
    def gain(self) -> Array:
        """Gain M (nx, ny) of the steady filter."""
        return frozen(np.ascontiguousarray(gain_of(self.predicted, self.C, self.V)))

    @cached_property
    def covariance(self) -> Array:
        """Steady covariance (nx, nx) of x_k given y up to k."""
        return frozen(updated_covariance(self.predicted, self.C, self.V, self.gain))

    @property
    def poles(self) -> Array:
        """Eigenvalues (nx,) of A − A M C."""
        return np.linalg.eigvals(self.A - self.A @ self.gain @ self.C)

    def start(self, n: int) -> Belief:
        """Belief of n runs before the first measurement."""
        return Belief(np.tile(self.x0, (as_count("n", n), 1)), self.predicted if self.steady else self.P0)

    def predict(self, belief: Belief, u: ArrayLike) -> Belief:
        """Belief one sample later, after inputs (n, nu)."""
        if self.steady:
            return Belief(self._transition(belief, rows_of("u", u, belief, self.nu))[0], self.predicted)
        return super().predict(belief, u)

    def _transition(self, belief: Belief, u: Array) -> tuple[Array, Array, Any]:
        return belief.mean @ self.A.T + u @ self.B.T + self.c, self.A, 0.0

    def _expected(self, belief: Belief, u: Array) -> tuple[Array, Array, Any]:
        return belief.mean @ self.C.T + u @ self.D.T + self.y0, self.C, 0.0

    def _corrected(self, P: Array, H: Array, V: Array) -> tuple[Array, Array]:
        return (self.gain, self.covariance) if self.steady else super()._corrected(P, H, V)
