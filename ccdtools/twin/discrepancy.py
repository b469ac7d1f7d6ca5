"""Learned quantiles of a model's error, and the model they update."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ccdtools.arrays import Array, ArrayField, Immutable
from ccdtools.exceptions import InputError
from ccdtools.plants.models import Model, PlantOfModel, as_model
from ccdtools.twin.residuals import Residuals
from ccdtools.twin.transport import Transport
from ccdtools_ground.door import as_array, as_choice, as_flag, as_instance, as_weight
from learning.quantile import QuantileNetwork, pinball

NOISES = ("none", "quantiles", "replayed")


@dataclass(frozen=True, eq=False, repr=False)
class Discrepancy(Immutable):
    """Learned quantiles of the one-step error e⁺ given (e, x, u[, p]).

    Attributes
    ----------
    network : QuantileNetwork
    weight : (nx, nx) array
        Q_q of the penalty Δeᵀ Q_q Δe on the width Δe between the outer levels; positive semidefinite.
    design_as_feature : bool
        Whether the network also sees p. The default follows the paper, which takes the error as independent
        of p; E(p) w and input gains that depend on p break that assumption.
    noise : {"none", "quantiles", "replayed"}
        What is added to the median. Nothing: the model is then deterministic. Draws from the learned distribution,
        joint across the states. Or given innovations: what the median left unexplained in the log, replayed with its
        own correlation in time.
    transport : Transport, optional
        From the design in whose coordinates the network works to any other. Without it e⁺ does not depend on p.
    """

    network: QuantileNetwork
    weight: ArrayField
    design_as_feature: bool = False
    noise: str = "none"
    transport: Transport | None = None

    def __post_init__(self) -> None:
        as_instance("network", self.network, QuantileNetwork, "a QuantileNetwork", "fit_quantiles makes one.")
        object.__setattr__(self, "weight", as_weight("weight", self.weight, self.network.outputs))
        as_flag("design_as_feature", self.design_as_feature)
        as_choice("noise", self.noise, NOISES)
        if self.transport is not None:
            as_instance("transport", self.transport, Transport, "a Transport or None")
        if self.noise == "quantiles" and len(self.network.levels) < 3:
            raise InputError("noise", "'quantiles' of 1 level", "a network of at least three levels")

    def __repr__(self) -> str:
        levels = ", ".join(f"{level:g}" for level in self.network.levels)
        return f"Discrepancy({self.network.outputs} states, levels {levels}, noise {self.noise!r})"

    def features(self, e: Tensor, x: Tensor, u: Tensor, p: Tensor) -> Tensor:
        """Inputs of the network, (n, ·)."""
        columns = [e, x, u]
        if self.design_as_feature:
            columns.append(p.expand(*x.shape[:-1], p.shape[-1]))
        return torch.cat(columns, dim=-1)

    def median(self, log: Residuals) -> Array:
        """Predicted median of e⁺ along a log (n, T, nx), in network coordinates."""
        e, x, u, p = (torch.tensor(a, dtype=torch.float32) for a in (log.e, log.x, log.u, log.p))
        with torch.no_grad():
            median = self.network(self.features(e, x, u, p))[..., len(self.network.levels) // 2, :]
            return np.asarray(median.double().numpy())

    def errors(self, p: Tensor) -> Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]:
        """Steps (e, x, u, w) → e⁺ (n, nx) at a design (np,), or at one for each run (n, np).

        The first e is zero, or an error that was measured. The noise w (n, nx) is uniform in [0, 1], or innovations, as
        `noise` says; it is not used for "none".
        """
        if self.noise == "quantiles":
            return lambda e, x, u, w: self.network.draw(self.network(self.features(e, x, u, p)), w)
        median = self.network.medians()
        if self.noise == "none":
            return lambda e, x, u, w: median(self.features(e, x, u, p))
        return lambda e, x, u, w: median(self.features(e, x, u, p)) + w

    def penalty(self, e: Tensor, x: Tensor, u: Tensor, p: Tensor) -> Tensor:
        """Width penalty (...,) at present errors and states (..., nx) and inputs (..., nu).

        No step depends on it, so that those of all steps are found at once.
        """
        if not self.weight.any():
            return x.new_zeros(x.shape[:-1])
        quantiles = self.network(self.features(e, x, u, p))
        width = quantiles[..., -1, :] - quantiles[..., 0, :]
        penalty: Tensor = ((width @ x.new_tensor(self.weight.tolist())) * width).sum(-1)
        return penalty

    def double(self) -> Discrepancy:
        """Discrepancy in double precision."""
        return replace(self, network=copy.deepcopy(self.network).double())


@dataclass(frozen=True, eq=False, repr=False)
class TwinPlant(Immutable, PlantOfModel):
    """Updated model as a plant to simulate.

    x⁺ = f(x, u, 0, p) + e⁺ with e⁺ of the discrepancy and f the model's step, A(p) x + B(p) u + c(p) of a linear one.

    Its disturbance w (nx,) is what the discrepancy's noise asks for.

    Attributes
    ----------
    error : (n, nx) array, optional
        Error before the first step of each of n runs, as at the design of the log; none by default.
    """

    model: Model
    discrepancy: Discrepancy
    error: ArrayField | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "model", as_model("model", self.model))
        as_instance("discrepancy", self.discrepancy, Discrepancy, "a Discrepancy")
        if self.discrepancy.network.outputs != self.model.nx:
            raise InputError("discrepancy", f"{self.discrepancy.network.outputs} states", f"{self.model.nx}")
        if self.error is not None:
            error = as_array("error", self.error, ("n", self.model.nx))
            object.__setattr__(self, "error", error)

    def __repr__(self) -> str:
        return f"TwinPlant({self.model!r}, {self.discrepancy!r})"

    @property
    def nw(self) -> int:
        """Number of disturbances, one per state."""
        return self.model.nx

    def stepper(self, p: Array, *, batch: int) -> Callable[[Array, Array, Array], Array]:
        """Steps (x, u, w) → x⁺ at design `p` (np,), which remember e from 0 or the error given."""
        if self.error is not None and len(self.error) != batch:
            raise InputError("error", f"those of {len(self.error)} runs", f"one for each of the {batch} runs")
        undisturbed = self.model.undisturbed(p)
        transport = self.discrepancy.transport
        carry = np.eye(self.nx) if transport is None else transport.matrix(self.model.matrices(p)[2])
        errors = self.discrepancy.errors(torch.tensor(p, dtype=torch.float32))
        e = np.zeros((batch, self.nx)) if self.error is None else self.error  # at the log's design

        def step(x: Array, u: Array, w: Array) -> Array:
            """Next states (n, nx) for inputs (n, nu) and noise (n, nx)."""
            nonlocal e
            before, state, applied, drawn = (torch.tensor(a, dtype=torch.float32) for a in (e, x, u, w))
            with torch.no_grad():
                e = errors(before, state, applied, drawn).double().numpy()
            return undisturbed(x, u) + e @ carry.T

        return step


@dataclass(frozen=True)
class QuantileScores:
    """Held-out scores of the learned quantiles, per state where a tuple.

    Attributes
    ----------
    rmse, nominal_rmse : tuple of float
        Root mean square one-step error of the median model, and of the nominal one, in the units of the states.
    pinball, constant_pinball : tuple of float
        Mean pinball loss of the network, and of the constant quantiles of the training stretch.
    coverage : tuple of float
        Fraction of e⁺ between the outer levels.
    nominal_coverage : float
        What the outer levels state.
    samples : int
    """

    rmse: tuple[float, ...]
    nominal_rmse: tuple[float, ...]
    pinball: tuple[float, ...]
    constant_pinball: tuple[float, ...]
    coverage: tuple[float, ...]
    nominal_coverage: float
    samples: int


def score_quantiles(network: QuantileNetwork, inputs: Array, e_next: Array, trained: Array) -> QuantileScores:
    """Scores of `network` on errors e⁺ (n, nx), beside the fitted ones `trained`."""
    quantiles = network.predict(inputs)
    levels = network.levels
    constant = np.broadcast_to(np.quantile(trained, levels, axis=0)[None], quantiles.shape)
    inside = (e_next >= quantiles[:, 0]) & (e_next <= quantiles[:, -1])
    rmse, nominal = (np.sqrt(np.mean(error**2, axis=0)) for error in (e_next - quantiles[:, len(levels) // 2], e_next))
    return QuantileScores(
        rmse=tuple(rmse.tolist()),
        nominal_rmse=tuple(nominal.tolist()),
        pinball=tuple(pinball(e_next, quantiles, levels).tolist()),
        constant_pinball=tuple(pinball(e_next, constant, levels).tolist()),
        coverage=tuple(inside.mean(axis=0).tolist()),
        nominal_coverage=levels[-1] - levels[0],
        samples=len(e_next),
    )
