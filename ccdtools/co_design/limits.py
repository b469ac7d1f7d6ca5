"""Tolerance of state limits, and an augmented Lagrangian that keeps it.

The two measures are the fraction of the states outside X and the mean over the runs of the peak depth. Each counts with
a standard error of the runs on top, so that fresh runs are expected to keep the limits, too. Their excess over the
tolerance moves the multipliers, once per evaluation; the gradient goes through the peak depth itself, and for the
fraction, which has none, through the mean depth. While no measure was ever in excess every multiplier is zero, and the
co-design is what it would be without limits.

References
----------
Bertsekas, "Constrained Optimization and Lagrange Multiplier Methods", 1982, chapter 5: the exponential method of
multipliers, an augmented Lagrangian whose multipliers grow and shrink by factors, so that their size need not be known.
Cotter, Jiang, Sridharan, "Two-player games for efficient non-convex constrained optimization", ALT 2019 (multipliers
moved by the measure itself, gradients of a differentiable stand-in).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TypeAlias

import torch
from torch import Tensor

from ccdtools.co_design.budgets import MPC_RUNS
from ccdtools.co_design.design_controllers import HORIZON, linear_mpc
from ccdtools.co_design.differentiable_model import Episode, Stepper, fewer_runs, in_double, simulated, to_design
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.tolerances import (
    AIMED_SHARE,
    BESIDE_MPC,
    EXCESS_ERRORS,
    FIRST_PRICE,
    GROWTH,
    LARGEST_EXCESS,
    LEAST_PRICE,
    LEAST_TOLERANCE,
    MEASURED_NEARBY,
    RESOLVED_VIOLATION,
    TOLERANCE_STEP,
)
from mpc import NotStabilisableError

Prices: TypeAlias = Callable[[Episode, Tensor], Tensor]  # (episodes, v) → what their violations cost each, (n,)
BY_MPC = f"a quarter more than MPC of the same design does, N = {HORIZON}"


@dataclass(frozen=True)
class Pair:
    """Fraction of states outside X, and peak depth in half-widths."""

    fraction: float
    depth: float

    def values(self) -> tuple[float, float]:
        """Both values in order."""
        return (self.fraction, self.depth)


@dataclass(frozen=True, eq=False)
class Tolerance:
    """Tolerance at designs of the unit box."""

    allowed: Pair  # at the design `v`
    source: str  # where it comes from
    v: Tensor | None = None  # (np,): where MPC was measured; None where the design does not matter
    slopes: Tensor | None = None  # (2, np): of the logarithms of both measures with the design

    def at(self, v: Tensor) -> Tensor:
        """Fraction and depth allowed at a design, (2,), differentiable."""
        allowed = torch.tensor(self.allowed.values(), dtype=torch.float64)
        if self.v is None or self.slopes is None:
            return allowed
        return (allowed * torch.exp(self.slopes @ (v - self.v).double())).clamp(min=LEAST_TOLERANCE)

    def holds_at(self, v: Tensor) -> bool:
        """Whether the tolerance was made for this design."""
        return self.v is not None and float((v - self.v).abs().max()) <= MEASURED_NEARBY


NOTHING = Pair(0.0, 0.0)
UNTIL_LEFT = Tolerance(Pair(LEAST_TOLERANCE, LEAST_TOLERANCE), "never left further than a network resolves")


def tolerance_by_mpc(problem: CoDesignProblem, v: Tensor, scenarios: tuple[Tensor, Tensor]) -> Tolerance:
    """Tolerance near a design: a quarter more than MPC violates.

    MPC runs on the first few of some scenarios.
    """
    middle = _beside(mpc_episodes(problem, v, scenarios))
    slopes = []
    for i in range(len(v)):
        known = []
        for side in (-1, 1):
            end = v.clone()
            end[i] = (v[i] + side * TOLERANCE_STEP).clamp(0.0, 1.0)
            with suppress(NotStabilisableError):  # there is no MPC beside it: the slope is one-sided
                known.append((end[i], _beside(mpc_episodes(problem, end, scenarios))))
        known = known if len(known) == 2 else [(v[i], middle), *known]
        (low, behind), (high, ahead) = known[0], known[-1]
        slopes.append((ahead / behind).log() / (high - low).double() if high != low else torch.zeros_like(middle))
    fraction, depth = middle.tolist()
    return Tolerance(Pair(fraction, depth), BY_MPC, v.clone(), torch.stack(slopes, dim=1))


def tolerance_at(problem: CoDesignProblem, v: Tensor, scenarios: tuple[Tensor, Tensor]) -> tuple[Pair, Pair]:
    """Tolerance by MPC at a design, with standard errors; least without MPC."""
    try:
        seen = mpc_episodes(problem, v, scenarios)
    except NotStabilisableError:
        return Pair(LEAST_TOLERANCE, LEAST_TOLERANCE), NOTHING
    errors = (BESIDE_MPC * error for error in measurement_errors(seen).values())
    return Pair(*_beside(seen).tolist()), Pair(*errors)


def _beside(seen: Episode) -> Tensor:
    """Tolerance (2,) by MPC episodes; the least if all are lost."""
    fraction, depth = measured(seen).values()
    beside = BESIDE_MPC * torch.tensor([fraction, depth], dtype=torch.float64)
    return beside.nan_to_num(nan=LEAST_TOLERANCE).clamp(min=LEAST_TOLERANCE)


def mpc_episodes(problem: CoDesignProblem, v: Tensor, scenarios: tuple[Tensor, Tensor]) -> Episode:
    """Episodes of online MPC with relaxed state limits, on few scenarios."""
    mpc = linear_mpc(problem, problem.design.from_unit(v.detach().double().numpy()))
    runs = fewer_runs(MPC_RUNS, scenarios[1].shape[1])
    x0, w = (part[:runs].double() for part in scenarios)
    with torch.no_grad():
        step = Stepper.at(in_double(problem), to_design(problem, v.detach().double()))
        return simulated(step, lambda x: x.new_tensor(mpc(x.numpy())), (x0, w), depths=True)


def measured(episode: Episode) -> Pair:
    """Mean fraction outside and peak depth of kept runs; NaN without any."""
    kept = ~episode.diverged
    return Pair(float(episode.outside.detach()[kept].mean()), float(episode.peak.detach()[kept].mean()))


def expected_at_most(episode: Episode) -> Pair:
    """Measures plus one standard error, expected to bound fresh runs."""
    return Pair(*(sum(pair) for pair in zip(measured(episode).values(), measurement_errors(episode).values())))


def measurement_errors(episode: Episode) -> Pair:
    """Standard errors of `measured`; 0 below two runs."""
    kept = ~episode.diverged
    parts = (episode.outside.detach()[kept], episode.peak.detach()[kept])
    fraction, depth = (float(part.std()) / len(part) ** 0.5 if len(part) > 1 else 0.0 for part in parts)
    return Pair(fraction, depth)


@dataclass(frozen=True)
class LimitsOutcome:
    """Violation of the state limits, beside its tolerance.

    Attributes
    ----------
    achieved : Pair
        Of the iterate returned, on the evaluation scenarios.
    tolerance : Pair
        What was asked for at that design.
    source : str
        Where the tolerance comes from.
    multipliers : Pair
        Price of each measure in parts of the return, for as much again as the tolerance; zero where no limit binds.
    outputs : bool
        Whether limits of outputs count beside X.
    errors : Pair
        Standard errors of what is achieved; zero where it is taken as it is.
    """

    achieved: Pair
    tolerance: Pair
    source: str
    multipliers: Pair
    outputs: bool = False
    errors: Pair = NOTHING

    @property
    def kept(self) -> bool:
        """Whether neither measure significantly exceeds its tolerance."""
        measures = zip(self.achieved.values(), self.errors.values(), self.tolerance.values())
        return all(value - EXCESS_ERRORS * error <= most for value, error, most in measures)

    def __str__(self) -> str:
        where = "samples outside the limits" if self.outputs else "states outside X"
        achieved = f"{self.achieved.fraction:.2%} of the {where}, peak depth {self.achieved.depth:.3g}"
        asked = f"tolerance {min(self.tolerance.fraction, 1.0):.2%} and {self.tolerance.depth:.3g} ({self.source})"
        name = "limits" if self.outputs else "state limits"
        if not self.kept:
            cure = "Raise limit_tolerance or iterations, or deploy with the filter."
            return f"{name} not kept: {achieved}; {asked}. {cure}"
        if self.source == BY_MPC and max(self.achieved.values()) > LEAST_TOLERANCE:
            return f"{name} left no more than MPC of the same design leaves them: {achieved}; {asked}"
        return f"{name} kept: {achieved}; {asked}"


@dataclass(frozen=True, eq=False)
class StateLimitPenalty:
    """Augmented Lagrangian at one iterate; `updated` gives the next."""

    judge: CoDesignProblem  # what iterates are evaluated on; its `limit_tolerance` says how far X may be left
    tolerance: Tolerance = UNTIL_LEFT
    v: Tensor | None = None  # (np,): the present design, in the unit box
    seen: Pair = NOTHING  # the measures at the last evaluation
    multipliers: Pair = NOTHING
    # mean depth of the states outside X at the last evaluation: what turns the mean depth into a fraction
    spread: float = 0.01  # until X is left for the first time

    @property
    def active(self) -> bool:
        """Whether leaving X costs anything now."""
        return any(multiplier > 0 for multiplier in self.multipliers.values())

    def violation(self, episode: Episode) -> float:
        """Excess over the tolerance of the present design, else 0."""
        pairs = zip(expected_at_most(episode).values(), self._allowed.values())
        return max(0.0, *(value - most for value, most in pairs))

    def cost(self, episode: Episode, v: Tensor) -> Tensor:
        """Cost () of leaving X at `v`, as part of the return.

        It is differentiable, the standard errors on top with it. The fraction of the states outside X has no gradient:
        it is as the mean depth, in units of `spread`.
        """
        size = self.judge.made_by_control(episode.total.detach().mean(), to_design(self.judge, v.detach()))
        means = _expected_at_most(torch.stack([episode.depth / self.spread, episode.peak]))
        multipliers = torch.tensor(self.multipliers.values(), dtype=torch.float64)
        cost: Tensor = size * multipliers @ _penalty(_relative_excess(means, self.tolerance.at(v)))
        return cost

    def prices(self, episode: Episode, v: Tensor) -> Prices:
        """(episodes, v) → their cost (n,), linear with the slopes that `cost` has here."""
        depth, peak, v = (tensor.detach().clone().requires_grad_(True) for tensor in (episode.depth, episode.peak, v))
        with torch.enable_grad():
            cost = self.cost(replace(episode, depth=depth, peak=peak), v)
        of_depth, of_peak, of_design = torch.autograd.grad(cost, [depth, peak, v], allow_unused=True)
        assert of_depth is not None
        assert of_peak is not None
        own = torch.zeros_like(v).double() if of_design is None else of_design.double()
        per_depth, per_peak = float(of_depth.sum()), float(of_peak.sum())
        return lambda seen, v: per_depth * seen.depth + per_peak * seen.peak + own @ v

    def updated(self, episode: Episode, v: Tensor, scenarios: tuple[Tensor, Tensor]) -> StateLimitPenalty:
        """Penalty after an evaluation on `scenarios` at `v`."""
        seen = expected_at_most(episode)
        tolerance = self._tolerance(seen, v, scenarios)
        excess = _relative_excess(torch.tensor(seen.values(), dtype=torch.float64), tolerance.at(v))
        multipliers = (_next_multiplier(*pair) for pair in zip(self.multipliers.values(), excess.tolist()))
        depth = float(episode.depth[~episode.diverged].sum() / episode.outside[~episode.diverged].sum().clamp(min=1e-9))
        spread = depth if depth > RESOLVED_VIOLATION else self.spread
        return replace(self, tolerance=tolerance, v=v, seen=seen, multipliers=Pair(*multipliers), spread=spread)

    def dearer(self, factor: float) -> StateLimitPenalty:
        """Penalty with a multiplied price of each exceeded measure."""
        broken = (value > most for value, most in zip(self.seen.values(), self._allowed.values()))
        prices = (price * factor if is_so else price for price, is_so in zip(self.multipliers.values(), broken))
        return replace(self, multipliers=Pair(*prices))

    def outcome(self, episode: Episode) -> LimitsOutcome:
        """Violation of the limits by these episodes."""
        outputs = self.judge.output_limits is not None
        achieved, errors = measured(episode), measurement_errors(episode)
        return LimitsOutcome(achieved, self._allowed, self.tolerance.source, self.multipliers, outputs, errors)

    @property
    def _allowed(self) -> Pair:
        """Tolerance at the present design."""
        return self.tolerance.allowed if self.v is None else Pair(*self.tolerance.at(self.v).tolist())

    def _tolerance(self, seen: Pair, v: Tensor, scenarios: tuple[Tensor, Tensor]) -> Tolerance:
        """Tolerance at `v`: the user's, or MPC's once X is left."""
        asked = self.judge.limit_tolerance
        if not isinstance(asked, str):
            return Tolerance(Pair(*asked), "asked for")
        if max(seen.values()) <= LEAST_TOLERANCE or self.tolerance.holds_at(v):
            return self.tolerance
        return tolerance_by_mpc(self.judge, v, scenarios)


def _expected_at_most(values: Tensor) -> Tensor:
    """Means plus one standard error of values (2, n), differentiable also where all are equal."""
    n = values.shape[1]
    mean = values.mean(dim=1)
    square = (values - mean[:, None]).square().sum(dim=1) / max(n - 1, 1) / n
    return mean + (square + torch.finfo(square.dtype).tiny).sqrt()


def _relative_excess(means: Tensor, allowed: Tensor) -> Tensor:
    """Excess (2,) over the multipliers' aim, relative to the tolerance."""
    return (means - AIMED_SHARE * allowed) / allowed.clamp(min=LEAST_TOLERANCE)


def _penalty(over: Tensor) -> Tensor:
    """(exp(c z) − 1)/c of excesses z (2,), straight beyond `LARGEST_EXCESS`."""
    near = over.clamp(max=LARGEST_EXCESS)
    return (torch.exp(GROWTH * near) - 1) / GROWTH + math.exp(GROWTH * LARGEST_EXCESS) * (over - near)


def _next_multiplier(multiplier: float, over: float) -> float:
    """Next multiplier, larger for excess above zero and smaller below."""
    start = max(multiplier, FIRST_PRICE) if over > 0 else multiplier
    moved = start * math.exp(GROWTH * min(max(over, -LARGEST_EXCESS), LARGEST_EXCESS))
    return moved if moved > LEAST_PRICE else 0.0
