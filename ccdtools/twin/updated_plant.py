"""Model updated by the logs, for comparing candidates on other disturbances."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccdtools.arrays import Array
from ccdtools.plants.models import Model, PlantOfModel
from ccdtools.twin.residuals import Residuals, stacked
from ccdtools.twin.tolerances import FEWEST_FITTED
from ccdtools.twin.transport import ErrorSplit, Transport, carried
from learning.quantile import QuantileConfig, QuantileNetwork, fit_quantiles


@dataclass(frozen=True, eq=False)
class UpdatedPlant(PlantOfModel):
    """Updated model x⁺ = f(x, u, ŵ, p) + T(p) g(x, u) + ρ.

    Logged errors hold E(p) w, and a model fitted in closed loop can mistake a coloured disturbance for a consequence of
    the state. Of a single drive g is therefore the median of what does not enter through E(p); the rest of the errors
    is a disturbance ŵ, as it was logged or drawn afresh. Of several runs g is the median of the whole errors. What g
    does not explain is replayed as (ŵ, ρ).

    Attributes
    ----------
    model : Model
        The nominal one, driven by (ŵ, ρ).
    split : ErrorSplit
    transport : Transport
        From the newest design, where g was learned, to others.
    follows : (nx, nx) array
        Of errors, what g is the median of; zero where nothing is.
    median : QuantileNetwork or None
        g, of one level.
    """

    model: Model
    split: ErrorSplit
    transport: Transport
    follows: Array
    median: QuantileNetwork | None

    @classmethod
    def from_logs(
        cls, split: ErrorSplit, logs: Sequence[Residuals], *, rng: np.random.Generator, config: QuantileConfig
    ) -> UpdatedPlant:  # fmt: skip
        """Updated model of logged errors, whose median alone is fitted with `config`."""
        transport = Transport.at(split.model, logs[-1].p, split.scale)
        identity = np.eye(split.model.nx)
        single = all(log.runs == 1 for log in logs)
        follows = identity - transport.E @ transport.inverse if single else identity
        plant = cls(split.replayed_model, split, transport, follows, None)
        own = plant.unexplained(logs)
        _, x, u, _, errors = stacked(own)
        if len(x) < FEWEST_FITTED or not np.abs(follows).max() > np.sqrt(np.finfo(float).eps):
            return plant
        network = fit_quantiles(
            np.hstack([x, u]), errors @ follows.T, stretches=[log.runs * log.steps for log in own], rng=rng,
            config=replace(config, levels=(0.5,)),
        )  # fmt: skip
        return replace(plant, median=network)

    def learned(self, x: Array, u: Array) -> Array:
        """Learned error g (..., nx) at x (..., nx) and u (..., nu)."""
        if self.median is None:
            return np.zeros(x.shape)
        inputs = np.concatenate([x, u], axis=-1)
        return self.median.predict(inputs.reshape(-1, inputs.shape[-1]))[:, 0].reshape(x.shape)

    def unexplained(self, logs: Sequence[Residuals]) -> list[Residuals]:
        """Logs at the newest design, less the learned errors."""
        newest = logs[-1].p
        own = [replace(carried(self.split.model, log, newest, np.asarray(self.split.scale)), p=newest) for log in logs]
        return [replace(log, e_next=log.e_next - self.learned(log.x, log.u)) for log in own]

    def drawn(self, logs: Sequence[Residuals], w: Array) -> Array:
        """Drive (ŵ, ρ) of a disturbance (n, T, nw), with the logged mean."""
        nw = w.shape[-1]
        logged = [self.split.disturbances(log)[..., :nw].reshape(-1, nw) for log in self.unexplained(logs)]
        return np.concatenate([w + np.concatenate(logged).mean(axis=0), np.zeros((*w.shape[:2], self.nx))], axis=-1)

    def stepper(self, p: Array, *, batch: int) -> Callable[[Array, Array, Array], Array]:
        """Steps (x, u, (ŵ, ρ)) → x⁺ at design `p` (np,)."""
        step = self.model.stepper(p, batch=batch)
        if self.median is None:
            return step
        carry = self.transport.matrix(self.split.model.matrices(p)[2])
        return lambda x, u, w: step(x, u, w) + self.learned(x, u) @ carry.T
