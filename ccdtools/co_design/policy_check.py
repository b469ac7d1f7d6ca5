"""Optimality check of a policy, by retuning its last layer.

The latent action l of a policy, before it is clipped to U, becomes exp(a) l + b + k x: a gain, an offset and a linear
law beside it, for every input; b and k in units of what the policy itself does and sees. Along these few numbers the
gradient through the model is compared with differences under common random numbers, run by run; and a plain search
looks for a better policy.

References
----------
Nelder and Mead, The Computer Journal 7(4), 1965 (in SciPy).
"""

from __future__ import annotations

import copy

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from ccdtools.arrays import Array, Indices
from ccdtools.co_design.design_gradients import compared
from ccdtools.co_design.differentiable_model import (
    Episode,
    ScenarioTensors,
    Stepper,
    in_double,
    latent_law,
    simulated,
    visited,
)
from ccdtools.co_design.learned_result import GradientCheck
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.risk import MEAN
from ccdtools.co_design.risk_intervals import parts_of_risk
from ccdtools.co_design.tolerances import LEAST_ACTION, NO_GRADIENT, POLICY_STEP, RETUNE_STEPS
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.statistics import PairedDifference, paired_difference
from learning.networks import scaled


class Retuned:
    """Policy with its last layer changed by r (nu, 2 + n_seen), or (n, nu, 2 + n_seen) per run.

    Parameters
    ----------
    problem : CoDesignProblem
    policy : LearnedPolicy
    scenarios : tensors (n, nx) and (n, T, nw)
    precision : torch.dtype
        That of policy and model; returns are sums in double.
    """

    def __init__(
        self, problem: CoDesignProblem, policy: LearnedPolicy, scenarios: ScenarioTensors,
        precision: torch.dtype = torch.float64,
    ) -> None:  # fmt: skip
        agent = copy.deepcopy(policy.agent).to(precision)
        p = torch.tensor(policy.design, dtype=precision)
        self._stepper = Stepper.at(in_double(problem) if precision == torch.float64 else problem, p)
        self._latent = latent_law(agent, p)
        self._range = agent.action_range(p)
        self.scenarios = _in(precision, scenarios)
        self._hidden = problem.hidden
        self.shape = (problem.model.nu, 2 + problem.model.nx - problem.hidden)
        x, latent = self._root_mean_squares()
        self._unit = latent.clamp(LEAST_ACTION, 1.0)[:, None]
        self._law = self._unit / x.clamp(min=1e-12)

    def episode(self, r: Tensor, *, depths: bool = False) -> Episode:
        """Episodes of the policy retuned by `r`."""
        gain = r[..., 0].exp()
        offset = r[..., 1] * self._unit[:, 0]
        law = r[..., 2:] * self._law

        def inputs(x: Tensor) -> Tensor:
            """Inputs (n, nu)."""
            latent = gain * self._latent(x) + offset + (x[:, None, self._hidden :] @ law.mT)[:, 0]
            return scaled(latent, self._range)

        return simulated(self._stepper, inputs, self.scenarios, depths=depths)

    def values(self, r: Tensor) -> Tensor:
        """Values (n,) of the returns by the risk."""
        values: Tensor = self._stepper.problem.risk.values(self.episode(r).total)
        return values

    def on(self, scenarios: ScenarioTensors) -> Retuned:
        """This policy in other scenarios."""
        other = copy.copy(self)
        other.scenarios = _in(self._unit.dtype, scenarios)
        return other

    def _root_mean_squares(self) -> tuple[Tensor, Tensor]:
        """Sizes of visited states (nx,) and latent actions (nu,)."""
        limit = self._stepper.limit
        x, *_ = visited(self._stepper, lambda x: scaled(self._latent(x), self._range), self.scenarios)
        with torch.no_grad():
            found = (x.clamp(-limit, limit)[:, self._hidden :], self._latent(x).clamp(-1.0, 1.0))
        states, latents = (value.square().mean(dim=0).sqrt() for value in found)
        return states, latents


def _in(precision: torch.dtype, scenarios: ScenarioTensors) -> ScenarioTensors:
    """Scenarios in a precision."""
    return scenarios[0].to(precision), scenarios[1].to(precision)


def gradient_of_policy(problem: CoDesignProblem, policy: LearnedPolicy, scenarios: ScenarioTensors) -> GradientCheck:
    """Policy slopes along random changes of its last layer.

    They are differences, and the slope through the model at a point between both ends that is drawn for each run. Of
    any return that is continuous both have the same mean, where it bends or has a kink, too.
    """
    retuned = Retuned(problem, policy, scenarios)
    size = int(np.prod(retuned.shape))
    drawn = np.random.default_rng(0)
    directions = torch.tensor(np.linalg.qr(drawn.standard_normal((size, min(4, size))))[0])
    ends = (POLICY_STEP * directions.T).reshape(-1, *retuned.shape)
    between = torch.tensor(drawn.uniform(-1, 1, (len(scenarios[0]), 1, 1)))
    pathwise, by_difference = [], []
    for end in ends:
        r = (between * end).requires_grad_()
        slopes = torch.autograd.grad(retuned.values(r).sum(), r)[0]
        pathwise.append((slopes * end).sum(dim=(1, 2)) / POLICY_STEP)
        with torch.no_grad():
            by_difference.append((retuned.values(end) - retuned.values(-end)) / (2 * POLICY_STEP))
    with torch.no_grad():
        mean = retuned.values(0 * ends[0]).mean()
    scale = float(problem.made_by_control(mean, torch.tensor(policy.design)))
    return _check(torch.stack(pathwise, dim=1), torch.stack(by_difference, dim=1), scale)


def _check(pathwise: Tensor, by_difference: Tensor, scale: float) -> GradientCheck:
    """Both means with their errors."""
    names = tuple(f"direction {i + 1}" for i in range(pathwise.shape[1]))
    blind = float((pathwise.norm(dim=1) <= NO_GRADIENT * scale).double().mean())
    return compared(names, pathwise, by_difference, scale, blind=blind)


@torch.no_grad()
def better_by_search(
    problem: CoDesignProblem, policy: LearnedPolicy, scenarios: ScenarioTensors, fresh: ScenarioTensors,
    labels: Indices | None = None,
) -> PairedDifference:  # fmt: skip
    """Gain on fresh scenarios of the best policy by search, in the precision of training.

    None that leaves the limits further, or loses more runs, counts. `labels` (n,) are of what was logged of the fresh
    ones, if they are of a log.
    """
    retuned = Retuned(problem, policy, scenarios, torch.float32)
    count = int(np.prod(retuned.shape))
    nothing = torch.zeros(retuned.shape)
    most = _left(retuned.episode(nothing, depths=True))

    def cost(z: Array) -> float:
        """Cost of a vector; infinite where limits are left further."""
        seen = retuned.episode(torch.as_tensor(z.reshape(retuned.shape), dtype=torch.float32), depths=True)
        return -float(problem.risk.values(seen.total).mean()) if (_left(seen) <= most).all() else np.inf

    gain, offset, law = (RETUNE_STEPS[name] for name in ("gain", "offset", "law"))
    steps = np.tile([gain, offset, *[law] * (retuned.shape[1] - 2)], retuned.shape[0])
    simplex = np.vstack([np.zeros(count), np.diag(steps)])
    options = {"initial_simplex": simplex, "maxfev": min(10 * count, 60), "adaptive": True}
    found = minimize(cost, np.zeros(count), method="Nelder-Mead", options=options).x
    again = retuned.on(fresh)
    better = again.values(torch.as_tensor(found.reshape(retuned.shape), dtype=torch.float32))
    parts = parts_of_risk(MEAN, (better - again.values(nothing)).double().numpy(), labels)
    return paired_difference(parts, 0 * parts)


def _left(seen: Episode) -> Array:
    """Frequency and depth of violations, and share lost, (3,)."""
    return np.array([float(part.double().mean()) for part in (seen.outside, seen.peak, seen.diverged)])
