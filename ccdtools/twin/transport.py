"""Transport of logged one-step errors from one design to another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, ArrayField, Immutable, frozen
from ccdtools.exceptions import InputError
from ccdtools.plants.linear_model import LinearModel
from ccdtools.plants.models import Model, as_model
from ccdtools.plants.sampled_model import SampledModel
from ccdtools.plants.simulated_model import SimulatedModel
from ccdtools.twin.residuals import Residuals
from ccdtools.twin.tolerances import UNTOLD
from ccdtools_ground.door import as_floats


@dataclass(frozen=True, eq=False, repr=False)
class Transport(Immutable):
    """Split of an error into what enters through E and the rest.

    e = E(p) ŵ + r with ŵ = E(p)⁺ e. At a design q the same disturbance enters through E(q), and the rest as it is:
    E(q) ŵ + r = T e with T = I + (E(q) − E(p)) E(p)⁺, the identity where E does not depend on the design.

    Attributes
    ----------
    E : (nx, nw) array
        At the design p of the log.
    inverse : (nw, nx) array
        E(p)⁺: the least-squares solution in states divided by their scale, so that no unit matters.
    """

    E: Array
    inverse: Array

    def __post_init__(self) -> None:
        for name in ("E", "inverse"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    def __repr__(self) -> str:
        return f"Transport({self.E.shape[0]} states, {self.E.shape[1]} disturbances)"

    @classmethod
    def at(cls, model: Model, p: ArrayLike, scale: ArrayLike) -> Transport:
        """Split at a design (np,); `scale` (nx,) is each state's extent."""
        model = as_model("model", model)
        scale = as_extent(scale, model.nx)
        E = model.matrices(p)[2]
        scaled, lengths = _columns_of_length_one(E / scale[:, None])
        inverse = np.linalg.pinv(scaled, rcond=UNTOLD) / scale / lengths[:, None]
        return cls(E, inverse)

    def split(self, e: Array) -> tuple[Array, Array]:
        """Disturbances ŵ (..., nw) and rest r (..., nx) of errors (..., nx)."""
        w = e @ self.inverse.T
        return w, e - w @ self.E.T

    def matrix(self, E: Any) -> Any:
        """Matrix T (nx, nx) at a design with `E` (nx, nw), array, tensor or expression."""
        if not hasattr(E, "new_tensor"):
            return (E - self.E) @ self.inverse + np.eye(len(self.E))
        own = E.new_tensor(self.E.tolist()).reshape(self.E.shape)
        inverse = E.new_tensor(self.inverse.tolist()).reshape(self.inverse.shape)
        return E.new_tensor(np.eye(len(self.E)).tolist()) + (E - own) @ inverse


@dataclass(frozen=True, eq=False, repr=False)
class ErrorSplit(Immutable):
    """Logged errors as disturbances (ŵ, r) that enter through [E(p) I].

    Of a nonlinear model x⁺ = f(x, u, ŵ, p) + r along the log, with the ŵ that leaves least; see `met_disturbances`.

    Parameters
    ----------
    model : Model
        The nominal one.
    scale : (nx,) array
        Extent of each state, such as half the width of X.
    """

    model: Model
    scale: ArrayField

    def __post_init__(self) -> None:
        object.__setattr__(self, "model", as_model("model", self.model))
        object.__setattr__(self, "scale", as_extent(self.scale, self.model.nx))

    def __repr__(self) -> str:
        return f"ErrorSplit({self.model!r})"

    @property
    def replayed_model(self) -> Model:
        """Model driven by (ŵ, r): ŵ through E(p) of any design, r directly."""
        return self.model.with_errors()

    def disturbances(self, log: Residuals) -> Array:
        """Disturbances (ŵ, r) of all logged errors, (n, T, nw + nx)."""
        if isinstance(self.model, LinearModel):
            return np.concatenate(Transport.at(self.model, log.p, self.scale).split(log.e_next), axis=-1)
        return self._nonlinear(self.model, log)

    def share_of_the_rest(self, logs: Sequence[Residuals]) -> float:
        """Share of the rest r in the scaled errors' energy; 0 without errors."""
        rest = sum(float(np.square(self.rest(log) / self.scale).sum()) for log in logs)
        whole = sum(float(np.square(log.e_next / self.scale).sum()) for log in logs)
        return rest / whole if whole > 0 else 0.0

    def rest(self, log: Residuals) -> Array:
        """Rest r (n, T, nx) of all logged errors."""
        return self.disturbances(log)[..., self.model.nw :]

    def _nonlinear(self, model: SampledModel | SimulatedModel, log: Residuals) -> Array:
        """Split of a nonlinear model's logged next states f(x, u, ŵ, p) + r."""
        from ccdtools.twin.met_disturbances import met_disturbances  # imports torch, which a study need not wait for

        w = met_disturbances(model, log, np.asarray(self.scale))
        after = model.undisturbed(log.p)(log.x, log.u) + log.e_next
        return np.concatenate([w, after - model.advance(log.x, log.u, w, log.p)], axis=-1)


def carried(model: Model, log: Residuals, p: ArrayLike, scale: ArrayLike) -> Residuals:
    """Log with its errors carried to another design (np,).

    E(q) ŵ + r of a linear model, f(x, u, ŵ, q) + r − f(x, u, 0, q) of another.
    """
    if isinstance(model, LinearModel):
        return log.carried(Transport.at(model, log.p, scale).matrix(model.matrices(p)[2]))
    q = model.design.check_one(p)
    if np.array_equal(q, log.p):
        return log
    w, rest = np.split(ErrorSplit(model, scale).disturbances(log), [model.nw], axis=-1)
    e_next = model.advance(log.x, log.u, w, q) + rest - model.undisturbed(q)(log.x, log.u)
    return replace(log, e=np.concatenate([log.e[:, :1], e_next[:, :-1]], axis=1), e_next=e_next)


def as_extent(scale: ArrayLike, nx: int) -> Array:
    """Extent of each state (nx,), all positive. Else an `InputError`."""
    extent = as_floats("scale", scale)
    if extent.shape != (nx,) or not ((extent > 0) & np.isfinite(extent)).all():
        got = f"{extent.tolist()} of shape {extent.shape}"
        raise InputError("scale", got, f"({nx},) positive numbers, such as the half-widths of X")
    return frozen(extent.copy())


def full_rank(model: Model, p: ArrayLike, scale: Array) -> bool:
    """Whether E(p) has full column rank, so errors tell every disturbance."""
    scaled, lengths = _columns_of_length_one(model.matrices(p)[2] / scale[:, None])
    if model.nw == 0 or not np.isfinite(lengths).all():
        return model.nw == 0
    values = np.linalg.svd(scaled, compute_uv=False)
    return len(values) == model.nw and bool(values[-1] > UNTOLD * values[0])


def check_disturbance_enters(model: Model) -> None:
    """Raise an `InputError` if the disturbance enters at no design.

    Into a nonlinear one it enters if the dynamics depend on it: E may be zero at rest, as that of w |w| or w sin(x) is.
    """
    cure = "Let w act on the dynamics, for example as a force beside u."
    if isinstance(model, SampledModel):
        if model.plant.nw and not ca.depends_on(model.plant.dynamics, model.plant.w):
            raise InputError("plant", "dynamics without w: the disturbance enters nowhere", "one that enters", cure)
        return
    designs = np.zeros((1, 0)) if model.design is None else model.design.spread()
    if model.nw and not any(np.any(model.matrices(p)[2]) for p in designs):
        raise InputError("plant", "an E(p) of rank zero: the disturbance w enters nowhere", "one that enters", cure)


def _columns_of_length_one(M: Array) -> tuple[Array, Array]:
    """Columns of M over their lengths, and those lengths; infinite for zeros."""
    lengths = np.linalg.norm(M, axis=0)
    lengths = np.where(lengths > 0, lengths, np.inf)
    return M / lengths, lengths
