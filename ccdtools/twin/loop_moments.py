"""Draws that answer the state, in a loop of their own, as the errors of the log did.

A linear regression on (e, x, u) that leaves what is uncorrelated with them gives the second moments of the closed loop,
whatever the rest is like. Draws have the regression of the log at the logged samples. In a simulation they meet others:
what a network says where a hard event has just passed is right after such events, and they are rarer among draws. On a
generated road the mean of the draws answered slow states too little for that reason, and these spread up to 9 % too
little, however many drives had been learned from. The mean is therefore moved until a simulation has the log's answer.

References
----------
Gourieroux, Monfort and Renault, "Indirect inference", Journal of Applied Econometrics 8, 1993 (a simulated model is
moved until an auxiliary regression on its output is that on the data).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ccdtools.arrays import Array
from ccdtools.plants.models import Model
from ccdtools.twin.discrepancy import Discrepancy
from ccdtools.twin.residuals import Residuals, stacked
from learning.copula import InnovationCopula
from learning.copula_fit import regression
from learning.quantile import QuantileNetwork

RUNS = 300  # simulated side by side, from logged samples
STEPS = 80  # of each,
SETTLING = 20  # of which the first are left out
ROUNDS = 1  # of the mean's moves: where the regression is linear in truth, the first is the last
RUNAWAY = 10.0  # times the largest logged state: draws that go further are not in the loop of the log


def matched_in_the_loop(
    discrepancy: Discrepancy, model: Model, parts: Sequence[Residuals], rng: np.random.Generator
) -> InnovationCopula:
    """The copula of a discrepancy, its mean moved until draws in closed loop answer (e, x, u) as the log did.

    The loop is that of the log: the affine law nearest to the logged inputs, within their range. The copula is returned
    as it is where that loop does not hold the draws.

    Parameters
    ----------
    discrepancy : Discrepancy
        With a copula, at the design of the parts.
    parts : sequence of Residuals
        Stretches of one log, of one design.
    """
    assert discrepancy.copula is not None
    loop = _Loop.of(model, parts)
    inputs = discrepancy.inputs_of(parts)
    errors = stacked(parts)[-1]
    slope, mean = regression(inputs, errors)
    extent = np.where(np.ptp(errors, axis=0) > 0, errors.std(axis=0), np.inf)
    copula = discrepancy.copula
    tried: list[tuple[float, InnovationCopula]] = []
    for k in range(ROUNDS + 1):
        reached = loop.simulated(replace(discrepancy, copula=copula, noise="quantiles"), rng)
        if reached is None:
            break
        lacking = mean + (reached - inputs.mean(axis=0)) @ slope - _expected(discrepancy.network, copula, reached)
        more, shift = regression(reached, lacking)
        centre = reached.mean(axis=0)
        tried.append((float(np.square((shift + (reached - centre) @ more) / extent).mean()), copula))
        if k < ROUNDS:
            copula = copula.moved(more, centre, shift)
    return min(tried, key=lambda one: one[0])[1] if tried else discrepancy.copula


@torch.no_grad()
def _expected(network: QuantileNetwork, copula: InnovationCopula, inputs: Array) -> Array:
    """Means (n, nx) of the draws at inputs (n, d) of the network: without the noise of draws, few samples do."""
    at = torch.tensor(inputs, dtype=torch.float32)
    return copula.expected(network(at), network.clipped(at)).double().numpy()


@dataclass(frozen=True, eq=False)
class _Loop:
    """The closed loop of a log: where it was, and the law that it seems to have followed."""

    model: Model
    x: Array
    e: Array
    p: Array
    law: Callable[[Array], Array]

    @classmethod
    def of(cls, model: Model, parts: Sequence[Residuals]) -> _Loop:
        """The loop of stretches of one log."""
        e, x, u, _, _ = stacked(parts)
        slope, mean = regression(x, u)
        centre = x.mean(axis=0)
        low = u.min(axis=0)
        high = u.max(axis=0)
        return cls(model, x, e, parts[-1].p, lambda state: np.clip(mean + (state - centre) @ slope, low, high))

    @torch.no_grad()
    def simulated(self, discrepancy: Discrepancy, rng: np.random.Generator) -> Array | None:
        """Inputs (n, d) of the network along runs of draws from logged samples; None if they run away."""
        model = self.model.undisturbed(self.p)
        begun = rng.integers(0, len(self.x), RUNS)
        x = self.x[begun]
        p = torch.tensor(self.p, dtype=torch.float32)
        error = torch.tensor(self.e[begun], dtype=torch.float32)
        reached = []
        for _ in range(STEPS):
            u = self.law(x)
            state, applied, noise = (torch.tensor(a, dtype=torch.float32) for a in (x, u, rng.random(x.shape)))
            reached.append(discrepancy.features(error[:, : x.shape[1]], state, applied, p).double().numpy())
            error = discrepancy.advance(error, state, applied, p, noise)[0]
            x = model(x, u) + error[:, : x.shape[1]].double().numpy()
            if not (np.abs(x) <= RUNAWAY * np.abs(self.x).max(axis=0)).all():
                return None
        return np.concatenate(reached[SETTLING:])
