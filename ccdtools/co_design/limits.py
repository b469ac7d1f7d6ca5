"""State limits in a co-design: an augmented Lagrangian on how often and how far episodes leave X.

The two measures are the fraction of the states outside X and the mean over the runs of the peak depth. Their excess
over the tolerance moves the multipliers, once per evaluation; the gradient goes through the peak depth itself, and for
the fraction, which has none, through the mean depth. While no measure was ever in excess every multiplier is zero, and
the co-design is what it would be without limits.

References
----------
Bertsekas, "Constrained Optimization and Lagrange Multiplier Methods", 1982, chapter 5: the exponential method of
multipliers, an augmented Lagrangian whose multipliers grow and shrink by factors, so that their size need not be known.
Cotter, Jiang, Sridharan, "Two-player games for efficient non-convex constrained optimization", ALT 2019 (multipliers
moved by the measure itself, gradients of a differentiable stand-in).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ccdtools.co_design.differentiable_model import Stepper, to_design
from ccdtools.co_design.episodes import Episode, fewer_runs, simulated
from ccdtools.co_design.problem import CoDesignProblem
from mpc import LinearMPC

HORIZON = 20  # steps, of the MPC that sets the tolerance
MPC_RUNS = 32  # episodes of 100 steps that it is measured on
BESIDE_MPC = 1.25  # the tolerance relative to what MPC does: a network in its place has a resolution,
FLOOR = 0.002  # of the states, or half-widths: and less than this is granted to it always
AIM = 0.9  # of the tolerance: what the multipliers aim at, so that some iterates are within
RESOLVED = 1e-4  # half-widths: smaller depths say nothing of how far the states outside X are
MOVED = 0.03  # of the unit box: a design that moved further has a tolerance of its own
FIRST_PRICE = 0.02  # of the return, for leaving X by once more than what is granted
CHEAPEST = 0.001  # a smaller multiplier is zero
STEP = 0.4  # a multiplier grows by exp(0.4) at an evaluation where twice as much as granted is left, or more
DAMPING = 0.5  # by this part the price follows the excess of each batch at once


@dataclass(frozen=True)
class Pair:
    """A value for each measure: the fraction of the states outside X, and the peak depth in half-widths."""

    fraction: float
    depth: float

    def values(self) -> tuple[float, float]:
        """Both, in that order."""
        return (self.fraction, self.depth)


@dataclass(frozen=True)
class LimitsOutcome:
    """How a co-design kept its state limits.

    Attributes
    ----------
    achieved : Pair
        Of the iterate returned, on the evaluation scenarios.
    tolerance : Pair
        What was asked for at that design.
    source : str
        Where the tolerance comes from.
    multipliers : Pair
        Price of each measure in parts of the return, for as much again as is granted; zero where no limit binds.
    """

    achieved: Pair
    tolerance: Pair
    source: str
    multipliers: Pair

    @property
    def kept(self) -> bool:
        """Whether neither measure exceeds its tolerance."""
        return all(a <= t for a, t in zip(self.achieved.values(), self.tolerance.values()))

    def __str__(self) -> str:
        achieved = f"{self.achieved.fraction:.2%} of the states outside X, peak depth {self.achieved.depth:.3g}"
        asked = f"{self.tolerance.fraction:.2%} and {self.tolerance.depth:.3g} granted ({self.source})"
        if self.kept:
            return f"state limits kept: {achieved}; {asked}"
        cure = "Grant more with limit_tolerance, give more iterations, or put the filter in service."
        return f"state limits not kept: {achieved}; {asked}. {cure}"


@dataclass(frozen=True, eq=False)
class StateLimitPenalty:
    """The augmented Lagrangian at one iterate; `updated` gives the next.

    Attributes
    ----------
    judge : CoDesignProblem
        What iterates are evaluated on; its `limit_tolerance` says what is granted.
    tolerance : Pair
        At the present design.
    source : str
        Where it comes from.
    measured_at : (np,) tensor or None
        The design, in the unit box, at which MPC was measured last.
    seen : Pair
        The measures at the last evaluation.
    multipliers : Pair
    spread : float
        Mean depth of the states outside X at the last evaluation: what turns the mean depth into a fraction.
    """

    judge: CoDesignProblem
    tolerance: Pair = Pair(FLOOR, FLOOR)
    source: str = "never left further than a network resolves"
    measured_at: Tensor | None = None
    seen: Pair = Pair(0.0, 0.0)
    multipliers: Pair = Pair(0.0, 0.0)
    spread: float = 0.01  # until X is left for the first time

    @property
    def active(self) -> bool:
        """Whether leaving X costs anything at present."""
        return any(multiplier > 0 for multiplier in self.multipliers.values())

    def violation(self, episode: Episode) -> float:
        """By how much the tolerance is exceeded; 0 where it is kept."""
        measured = _measured(episode).values()
        return max(0.0, *(value - granted for value, granted in zip(measured, self.tolerance.values())))

    def cost(self, episode: Episode) -> Tensor:
        """What leaving X costs, (n,) in the units of the return; differentiable."""
        excess = self._relative_excess(_measured(episode))
        prices = [
            multiplier * (1 + DAMPING * min(max(over, -1.0), 2.0)) / unit
            for multiplier, over, unit in zip(self.multipliers.values(), excess, self._units)
        ]
        size = episode.total.detach().mean().abs()
        return size * (prices[0] / self.spread * episode.depth + prices[1] * episode.peak)

    def updated(self, episode: Episode, v: Tensor, scenarios: tuple[Tensor, Tensor]) -> StateLimitPenalty:
        """The penalty after an evaluation on `scenarios` at the point `v` of the unit box."""
        seen = _measured(episode)
        now = replace(self, seen=seen)._granted(v, scenarios)
        pairs = zip(self.multipliers.values(), now._relative_excess(seen))
        multipliers = Pair(*(_next_multiplier(multiplier, over) for multiplier, over in pairs))
        depth = float(episode.depth[~episode.diverged].sum() / episode.outside[~episode.diverged].sum().clamp(min=1e-9))
        return replace(now, multipliers=multipliers, spread=depth if depth > RESOLVED else self.spread)

    @property
    def _units(self) -> tuple[float, ...]:
        """What counts as once more of each measure."""
        return tuple(max(value, FLOOR) for value in self.tolerance.values())

    def _relative_excess(self, measured: Pair) -> list[float]:
        """By how much each measure exceeds what the multipliers aim at, relative to what is granted."""
        values = zip(measured.values(), self.tolerance.values(), self._units)
        return [(value - AIM * granted) / unit for value, granted, unit in values]

    def outcome(self, episode: Episode) -> LimitsOutcome:
        """How the iterate of these episodes keeps the limits."""
        return LimitsOutcome(_measured(episode), self.tolerance, self.source, self.multipliers)

    def _granted(self, v: Tensor, scenarios: tuple[Tensor, Tensor]) -> StateLimitPenalty:
        """The same with the tolerance of the design `v`: the user's, or what MPC does there if X is left at all."""
        asked = self.judge.limit_tolerance
        if not isinstance(asked, str):
            return replace(self, tolerance=Pair(*asked), source="asked for")
        if max(self.seen.values()) <= FLOOR:
            return self
        if self.measured_at is not None and float((v - self.measured_at).abs().max()) <= MOVED:
            return self
        by_mpc = _measured(mpc_episodes(self.judge, v, scenarios))
        granted = Pair(*(max(FLOOR, BESIDE_MPC * value) for value in by_mpc.values()))
        return replace(self, tolerance=granted, source=f"MPC of the same design, N = {HORIZON}", measured_at=v.clone())


def mpc_episodes(problem: CoDesignProblem, v: Tensor, scenarios: tuple[Tensor, Tensor]) -> Episode:
    """Episodes of online MPC, state limits relaxed where they cannot be kept, on the first few of some scenarios."""
    A, B, _ = problem.model.matrices(problem.design.from_unit(v.detach().double().numpy()))
    objective = problem.objective
    mpc = LinearMPC(A, B, Q=objective.Q, R=objective.R, horizon=HORIZON, X=problem.X, U=problem.U)
    x0, w = scenarios
    runs = fewer_runs(MPC_RUNS, w.shape[1])
    with torch.no_grad():
        step = Stepper.at(problem, to_design(problem, v.detach()))
        return simulated(step, lambda x: x.new_tensor(mpc(x.double().numpy())), (x0[:runs], w[:runs]), depths=True)


def _measured(episode: Episode) -> Pair:
    """The measures of episodes: mean fraction outside, and mean peak depth."""
    return Pair(float(episode.outside.detach().mean()), float(episode.peak.detach().mean()))


def _next_multiplier(multiplier: float, over: float) -> float:
    """The multiplier after an evaluation with a relative excess: larger above zero, smaller below."""
    start = max(multiplier, FIRST_PRICE) if over > 0 else multiplier
    moved = start * math.exp(STEP * min(max(over, -1.0), 1.0))
    return moved if moved > CHEAPEST else 0.0
