"""Tolerance of a design, by the user or by MPC."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import torch
from torch import Tensor

from ccdtools.co_design.budgets import MPC_RUNS
from ccdtools.co_design.design_controllers import HORIZON, linear_mpc
from ccdtools.co_design.differentiable_model import Stepper, to_design
from ccdtools.co_design.episodes import Episode, fewer_runs, simulated
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.tolerances import BESIDE_MPC, LEAST_TOLERANCE, MEASURED_NEARBY, TOLERANCE_STEP
from mpc import NotStabilisableError

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
    """Tolerance at designs of the unit box.

    Attributes
    ----------
    allowed : Pair
        At the design `v`.
    source : str
        Where it comes from.
    v : (np,) tensor or None
        Where MPC was measured; None where the design does not matter.
    slopes : (2, np) tensor or None
        Of the logarithms of both measures with the design.
    """

    allowed: Pair
    source: str
    v: Tensor | None = None
    slopes: Tensor | None = None

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
    x0, w = scenarios
    runs = fewer_runs(MPC_RUNS, w.shape[1])
    with torch.no_grad():
        step = Stepper.at(problem, to_design(problem, v.detach().to(x0.dtype)))
        return simulated(step, lambda x: x.new_tensor(mpc(x.double().numpy())), (x0[:runs], w[:runs]), depths=True)


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
