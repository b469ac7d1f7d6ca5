"""State limits in a co-design: an augmented Lagrangian on how often and how far episodes leave X.

The two measures are the fraction of the states outside X and the mean over the runs of the peak depth. Their excess
over the tolerance moves the multipliers, once per evaluation; the gradient goes through the peak depth itself, and for
the fraction, which has none, through the mean depth. While no measure was ever in excess every multiplier is zero, and
the co-design is what it would be without limits.

References
----------
Nocedal, Wright, "Numerical Optimization", 2006, section 17.4 (inequalities in an augmented Lagrangian).
Cotter, Jiang, Sridharan, "Two-player games for efficient non-convex constrained optimization", ALT 2019 (multipliers
moved by the measure itself, gradients of a differentiable stand-in).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ccdtools.co_design.differentiable_model import Stepper, to_design
from ccdtools.co_design.episodes import Episode, fewer_runs, simulated
from ccdtools.co_design.problem import CoDesignProblem
from mpc import LinearMPC

HORIZON = 20  # steps, of the MPC that sets the tolerance
MPC_RUNS = 16  # episodes of 100 steps that it is measured on
BESIDE_MPC = 1.25  # the tolerance relative to what MPC does: a network in its place has a resolution,
FLOOR = 0.005  # of the states, or half-widths: and less than this is granted to it always
AIM = 0.9  # of the tolerance: what the multipliers aim at, so that some iterates are within
MOVED = 0.03  # of the unit box: a design that moved further has a tolerance of its own
WEIGHT = 5.0  # first quadratic weight, of the return a unit of the measure; it doubles while the excess does not halve,
HEAVIEST = 320.0  # up to this
LARGEST_EXCESS = 1.0  # that moves a multiplier at once: lost runs are hundreds of half-widths away


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
        Price of each measure at the end, in parts of the return; zero where the limits never bound.
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
    multipliers, weights : Pair
    spread : float
        Mean depth of the states outside X at the last evaluation: what turns the mean depth into a fraction.
    """

    judge: CoDesignProblem
    tolerance: Pair = Pair(FLOOR, FLOOR)
    source: str = "never left further than a network resolves"
    measured_at: Tensor | None = None
    seen: Pair = Pair(0.0, 0.0)
    multipliers: Pair = Pair(0.0, 0.0)
    weights: Pair = Pair(WEIGHT, WEIGHT)
    spread: float = 0.01

    @property
    def active(self) -> bool:
        """Whether leaving X costs anything at present."""
        return any(multiplier > 0 for multiplier in self.multipliers.values()) or self.excess(self.seen, AIM) > 0

    def excess(self, measured: Pair, part: float = 1.0) -> float:
        """By how much the worse measure exceeds its tolerance, or a part of it; 0 where neither does."""
        return max(0.0, *_excess(measured, self.tolerance, part))

    def violation(self, episode: Episode) -> float:
        """By how much the tolerance is exceeded; 0 where it is kept."""
        return self.excess(_measured(episode))

    def cost(self, episode: Episode) -> Tensor:
        """What leaving X costs, (n,) in the units of the return; differentiable."""
        prices = [
            max(0.0, multiplier + weight * min(over, LARGEST_EXCESS))
            for multiplier, weight, over in zip(
                self.multipliers.values(), self.weights.values(), _excess(_measured(episode), self.tolerance, AIM)
            )
        ]
        size = episode.total.detach().mean().abs()
        return size * (prices[0] / self.spread * episode.depth + prices[1] * episode.peak)

    def updated(self, episode: Episode, v: Tensor, scenarios: tuple[Tensor, Tensor]) -> StateLimitPenalty:
        """The penalty after an evaluation on `scenarios` at the point `v` of the unit box."""
        seen = _measured(episode)
        now = replace(self, seen=seen)._granted(v, scenarios)
        before = _excess(self.seen, self.tolerance, AIM)
        after = _excess(seen, now.tolerance, AIM)
        spread = float(episode.depth[~episode.diverged].mean()) / max(seen.fraction, 1e-6) if seen.fraction > 0 else 0.0
        multipliers = []
        weights = []
        for old, new, multiplier, weight in zip(before, after, self.multipliers.values(), self.weights.values()):
            multipliers.append(max(0.0, multiplier + weight * min(new, LARGEST_EXCESS)))
            stuck = multiplier > 0 and new > 0.5 * max(old, 0.0) and new > 0
            weights.append(min(2 * weight, HEAVIEST) if stuck else weight)
        return replace(
            now, multipliers=Pair(*multipliers), weights=Pair(*weights), spread=spread if spread > 1e-4 else self.spread
        )

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


def _excess(measured: Pair, tolerance: Pair, part: float) -> list[float]:
    """By how much each measure exceeds a part of its tolerance; negative within."""
    return [value - part * granted for value, granted in zip(measured.values(), tolerance.values())]
