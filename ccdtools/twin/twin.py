"""The digital twin: a nominal model and what deployment has taught about its error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.exceptions import InputError
from ccdtools.plants.discretisation import LinearModel
from ccdtools.simulation import Step, Trajectory
from learning.quantile import QuantileConfig, QuantileNetwork, fit_quantiles, pinball


@dataclass(frozen=True, eq=False)
class Residuals:
    """One-step errors of a nominal model along logged runs, in time order within each run.

    Attributes
    ----------
    e, x, u : (n, T, ·) arrays
        Error before the step (e₀ = 0), measured state and applied input.
    p : (np,) array
        Design of the log.
    e_next : (n, T, nx) array
        e⁺ = x⁺ − A(p) x − B(p) u, at the measured state.
    """

    e: Array
    x: Array
    u: Array
    p: Array
    e_next: Array

    def part(self, runs: slice, steps: slice) -> Residuals:
        """A stretch of the log."""
        return replace(self, **{name: getattr(self, name)[runs, steps] for name in ("e", "x", "u", "e_next")})


@dataclass(frozen=True, eq=False)
class TwinPlant:
    """The updated model as a plant to simulate: x⁺ = A(p) x + B(p) u + e⁺, with e⁺ from a discrepancy."""

    model: LinearModel
    discrepancy: Discrepancy

    nx = property(lambda self: self.model.nx)
    nu = property(lambda self: self.model.nu)
    nw = property(lambda self: self.model.nx)
    dt = property(lambda self: self.model.dt)
    design = property(lambda self: self.model.design)

    def stepper(self, p: Array, *, batch: int) -> Step:
        """(x, u, w) → x⁺ from e₀ = 0, remembering e; w (n, nx) is what the discrepancy's noise asks for."""
        A, B, _ = self.model.matrices(p)
        e = np.zeros((batch, self.nx))
        at = torch.tensor(p, dtype=torch.float32)

        def step(x: Array, u: Array, w: Array) -> Array:
            nonlocal e
            before, state, applied, drawn = (torch.tensor(a, dtype=torch.float32) for a in (e, x, u, w))
            with torch.no_grad():
                e = self.discrepancy.advance(before, state, applied, at, drawn)[0].double().numpy()
            return x @ A.T + u @ B.T + e

        return step


def residuals(model: LinearModel, log: Trajectory) -> Residuals:
    """One-step errors e⁺ of `model` along the runs of `log` that did not diverge.

    Raises
    ------
    InputError
        If every run diverged.
    """
    kept = ~log.diverged
    if not kept.any():
        raise InputError(f"log: got {len(kept)} runs that all diverged, expected at least one that did not.")
    A, B, _ = model.matrices(log.design)
    x, u = log.states[kept], log.inputs[kept]
    e_next = x[:, 1:] - x[:, :-1] @ A.T - u @ B.T
    e = np.concatenate([np.zeros_like(e_next[:, :1]), e_next[:, :-1]], axis=1)
    return Residuals(e, x[:, :-1], u, np.asarray(log.design, dtype=float), e_next)


HELD_OUT = 0.2  # of every block of a log
BLOCKS = 20  # that a single long run is cut into
NOISES = ("none", "quantiles", "replayed")


@dataclass(frozen=True, eq=False)
class Discrepancy:
    """Learned conditional quantiles of the one-step error e⁺ given (e, x, u), or (e, x, u, p).

    Attributes
    ----------
    network : QuantileNetwork
    weight : (nx, nx) array
        Q_q of the penalty Δeᵀ Q_q Δe on the width Δe between the outer levels.
    design_as_feature : bool
        Whether the network also sees p. The default follows the paper, which takes the error as independent
        of p; E(p) w and input gains that depend on p break that assumption.
    noise : {"none", "quantiles", "replayed"}
        What is added to the median. Nothing: the model is then deterministic. Draws from the learned distribution,
        linear between and beyond the levels. Or given innovations: what the median left unexplained in the log,
        replayed with its own correlation in time.
    """

    network: QuantileNetwork
    weight: Array
    design_as_feature: bool = False
    noise: str = "none"

    def __post_init__(self) -> None:
        if self.noise not in NOISES:
            raise InputError(f"noise: got {self.noise!r}, expected one of {', '.join(NOISES)}.")

    def features(self, e: Tensor, x: Tensor, u: Tensor, p: Tensor) -> Tensor:
        """Inputs of the network, (n, ·)."""
        columns = [e, x, u]
        if self.design_as_feature:
            columns.append(p.expand(*x.shape[:-1], p.shape[-1]))
        return torch.cat(columns, dim=-1)

    def median(self, log: Residuals) -> Array:
        """Predicted median of e⁺ along a log, (n, T, nx)."""
        e, x, u, p = (torch.tensor(a, dtype=torch.float32) for a in (log.e, log.x, log.u, log.p))
        with torch.no_grad():
            return self.network(self.features(e, x, u, p))[..., len(self.network.levels) // 2, :].double().numpy()

    def advance(self, e: Tensor, x: Tensor, u: Tensor, p: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
        """e⁺ (n, nx) and the width penalty (n,).

        `w` (n, nx) holds draws uniform in [0, 1] or innovations, as `noise` says; it is not used for "none".
        """
        quantiles = self.network(self.features(e, x, u, p))
        median = quantiles[..., len(self.network.levels) // 2, :]
        width = quantiles[..., -1, :] - quantiles[..., 0, :]
        weight = torch.as_tensor(self.weight, dtype=x.dtype)
        penalty = ((width @ weight) * width).sum(-1)
        if self.noise == "quantiles":
            return self._draw(quantiles, w), penalty
        return (median + w if self.noise == "replayed" else median), penalty

    def _draw(self, quantiles: Tensor, w: Tensor) -> Tensor:
        """The inverse distribution function at `w`, piecewise linear through the quantiles."""
        levels = torch.tensor(self.network.levels, dtype=quantiles.dtype)
        k = torch.searchsorted(levels, w.contiguous()).clamp(1, len(levels) - 1)
        low, high = (quantiles.gather(-2, i.unsqueeze(-2)).squeeze(-2) for i in (k - 1, k))
        return low + (w - levels[k - 1]) / (levels[k] - levels[k - 1]) * (high - low)


@dataclass(frozen=True)
class QuantileScores:
    """How well the learned quantiles describe a held-out stretch, per state where a tuple.

    Attributes
    ----------
    rmse, nominal_rmse : tuple of float
        Root mean square one-step error of the median model, and of the nominal one, in the units of the states.
    pinball, constant_pinball : tuple of float
        Mean pinball loss of the network, and of the constant quantiles of the training stretch.
    coverage : tuple of float
        Fraction of e⁺ between the outer levels.
    nominal_coverage : float
        What the outer levels promise.
    samples : int
    """

    rmse: tuple[float, ...]
    nominal_rmse: tuple[float, ...]
    pinball: tuple[float, ...]
    constant_pinball: tuple[float, ...]
    coverage: tuple[float, ...]
    nominal_coverage: float
    samples: int


@dataclass(frozen=True, eq=False)
class DigitalTwin:
    """A nominal model with every log so far and the discrepancy learned from them.

    `update` returns a new twin; the old one is unchanged.
    """

    model: LinearModel
    logs: tuple[Residuals, ...] = ()
    discrepancy: Discrepancy | None = None
    scores: QuantileScores | None = None

    def update(
        self,
        log: Trajectory,
        *,
        weight: Array,
        rng: np.random.Generator,
        config: QuantileConfig | None = None,
        design_as_feature: bool = False,
        held_out: float = HELD_OUT,
        blocks: int = BLOCKS,
        progress: bool = False,
    ) -> DigitalTwin:
        """The twin after learning from one more log.

        The last part of every contiguous block of the log is held out for the scores: it follows in time what was
        trained on, and fit and test both see every regime of a drive. Of several runs, the last ones are held out.
        The promised coverage is that over all regimes together; within a calm one the band may be too wide.

        Parameters
        ----------
        log : Trajectory
            From `deploy` or `simulate`.
        weight : (nx, nx) array
            Penalty Q_q on the quantile width.
        rng : numpy.random.Generator
        config : QuantileConfig, optional
        design_as_feature : bool
        held_out : float
            Fraction of every block that is only tested on.
        blocks : int
            Blocks that a single long run is cut into.
        """
        logs = (*self.logs, residuals(self.model, log))
        train, lengths = _stretches(logs, held_out, blocks, last=False)
        test, _ = _stretches(logs[-1:], held_out, blocks, last=True)
        if len(test[0]) == 0:
            steps = logs[-1].x.shape[1]
            raise InputError(
                f"held_out: got {held_out} of {blocks} blocks of a log of {steps} samples, which leaves none to test "
                "on, expected a longer log, fewer blocks or a larger fraction."
            )
        columns = (0, 1, 2, 3) if design_as_feature else (0, 1, 2)
        inputs, tests = (np.hstack([part[i] for i in columns]) for part in (train, test))
        network = fit_quantiles(inputs, train[-1], stretches=lengths, rng=rng, config=config, progress=progress)
        discrepancy = Discrepancy(network, np.asarray(weight, dtype=float), design_as_feature)
        return replace(self, logs=logs, discrepancy=discrepancy, scores=_scores(network, tests, test[-1], train[-1]))

    def innovations(self) -> tuple[Residuals, ...]:
        """The logs with e⁺ less its predicted median: what the updated model leaves unexplained."""
        if self.discrepancy is None:
            raise InputError("twin: got one without a discrepancy, expected one after `update`.")
        return tuple(replace(log, e_next=log.e_next - self.discrepancy.median(log)) for log in self.logs)


def _stretches(logs: Sequence[Residuals], held_out: float, blocks: int, *, last: bool):
    """Columns (e, x, u, p, e⁺) of the training (or the held-out) part of every block, and the parts' lengths.

    A single long run is cut into blocks; several runs, one after the other, are one block of whole runs.
    """
    parts: list[list[Array]] = [[], [], [], [], []]
    lengths = []
    for log in logs:
        runs, steps = log.x.shape[:2]
        if runs == 1:
            edges = np.linspace(0, steps, blocks + 1).round().astype(int)
            cuts = edges[1:] - np.round(held_out * np.diff(edges)).astype(int)
            spans = zip(cuts, edges[1:]) if last else zip(edges[:-1], cuts)
            pieces = [(slice(None), slice(a, b)) for a, b in spans]
        else:
            cut = runs - max(1, round(held_out * runs))
            pieces = [(slice(cut, None) if last else slice(None, cut), slice(None))]
        for piece in pieces:
            e, x, u, e_next = (getattr(log, name)[piece] for name in ("e", "x", "u", "e_next"))
            flat = [column.reshape(-1, column.shape[-1]) for column in (e, x, u, np.broadcast_to(
                log.p, (*x.shape[:2], len(log.p))), e_next)]  # fmt: skip
            lengths.append(len(flat[0]))
            for part, column in zip(parts, flat):
                part.append(column)
    return [np.concatenate(part) for part in parts], lengths


def _scores(network: QuantileNetwork, inputs: Array, e_next: Array, trained: Array) -> QuantileScores:
    quantiles, levels = network.predict(inputs), network.levels
    constant = np.broadcast_to(np.quantile(trained, levels, axis=0)[None], quantiles.shape)
    inside = (e_next >= quantiles[:, 0]) & (e_next <= quantiles[:, -1])

    def root_mean_square(error: Array) -> tuple[float, ...]:
        return tuple(np.sqrt(np.mean(error**2, axis=0)).tolist())

    return QuantileScores(
        rmse=root_mean_square(e_next - quantiles[:, len(levels) // 2]),
        nominal_rmse=root_mean_square(e_next),
        pinball=tuple(pinball(e_next, quantiles, levels).tolist()),
        constant_pinball=tuple(pinball(e_next, constant, levels).tolist()),
        coverage=tuple(inside.mean(axis=0).tolist()),
        nominal_coverage=levels[-1] - levels[0],
        samples=len(e_next),
    )
