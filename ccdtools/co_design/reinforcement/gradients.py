"""Three estimates of how the return changes with the design, in the unit box."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.co_design.differentiable_model import observe, returns, scenario_tensors, to_design
from ccdtools.co_design.environment import DesignEnv
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.exceptions import InputError
from learning.networks import ActorCritic
from learning.ppo import Batch, PPOConfig, ppo_loss, prepare
from learning.rollout import collect

METHODS = ("pathwise", "network_input")


@dataclass(frozen=True, eq=False)
class GradientCheck:
    """The design gradient of the mean return by each method, at one design, (np,) per unit-box length.

    Attributes
    ----------
    names : tuple of str
    finite_difference : array
        Central differences under common random numbers: the reference.
    pathwise : array
        Backpropagation through dynamics, policy and reward.
    network_input : array
        The paper's: through the networks' inputs of the PPO loss, the states taken as constants.
    """

    names: tuple[str, ...]
    finite_difference: Array
    pathwise: Array
    network_input: Array

    def cosine(self, method: str) -> float:
        """Cosine of the angle between a method's gradient and the finite differences."""
        a, b = getattr(self, method), self.finite_difference
        return float(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-300))

    def __str__(self) -> str:
        rows = [f"{'design gradient (unit box)':<28}" + "".join(f"{name:>14}" for name in self.names) + "     cosine"]
        for label, method in (
            ("finite differences", "finite_difference"),
            ("pathwise", "pathwise"),
            ("network input (paper)", "network_input"),
        ):
            values = "".join(f"{value:14.5g}" for value in getattr(self, method))
            rows.append(f"{label:<28}{values}{self.cosine(method):11.3f}")
        return "\n".join(rows)


def check_gradients(
    problem: CoDesignProblem,
    agent: ActorCritic,
    design: Array,
    *,
    rng: np.random.Generator,
    runs: int = 512,
    step: float = 1e-2,
    ppo: PPOConfig | None = None,
) -> GradientCheck:
    """Every design gradient beside finite differences, on the same scenarios.

    Parameters
    ----------
    design : (np,) array_like
        Where to compare, in physical units.
    runs : int
        Scenarios.
    step : float
        Step of the central differences in the unit box.
    """
    design = problem.design.check(design)
    v = torch.tensor(problem.design.to_unit(design), dtype=torch.float32)
    scenarios = scenario_tensors(problem, runs, rng)
    differences = []
    for i in range(len(v)):
        ends = []
        for sign in (1, -1):
            moved = v.clone()
            moved[i] += sign * step
            with torch.no_grad():
                ends.append(returns(problem, agent, to_design(problem, moved), *scenarios)[0].double().mean().item())
        differences.append((ends[0] - ends[1]) / (2 * step))
    pathwise = pathwise_gradient(problem, agent, v, *scenarios)[0]
    network = network_input_gradient(problem, agent, v, rng=rng, runs=runs, config=ppo or PPOConfig())
    return GradientCheck(
        tuple(problem.design.names), np.array(differences), pathwise.double().numpy(), network.double().numpy()
    )


def pathwise_gradient(
    problem: CoDesignProblem, agent: ActorCritic, v: Tensor, x0: Tensor, w: Tensor
) -> tuple[Tensor, Tensor]:
    """∂/∂v of the mean return through dynamics, policy and reward, (np,); and the mean return."""
    v = v.detach().clone().requires_grad_(True)
    mean = returns(problem, agent, to_design(problem, v), x0, w)[0].mean()
    (gradient,) = torch.autograd.grad(mean, v)
    return gradient, mean.detach()


def network_input_gradient(
    problem: CoDesignProblem,
    agent: ActorCritic,
    v: Tensor,
    *,
    rng: np.random.Generator,
    runs: int,
    config: PPOConfig,
) -> Tensor:
    """−∂/∂v of the PPO loss through the design inputs of policy and value network, states constant, (np,)."""
    env = DesignEnv(problem, to_design(problem, v), runs=runs, rng=rng)
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    rollout = collect(env, agent, steps=problem.steps, generator=generator)
    return loss_gradient(problem, agent, v, prepare(agent, rollout, config), config)


def loss_gradient(problem: CoDesignProblem, agent: ActorCritic, v: Tensor, batch: Batch, config: PPOConfig) -> Tensor:
    """−∂/∂v of the PPO loss on a batch, through the design columns of its observations."""
    v = v.detach().clone().requires_grad_(True)
    x = batch.observations[:, : problem.model.nx]
    moved = Batch(observe(x, to_design(problem, v)), batch.latents, batch.log_probs, batch.advantages, batch.targets)
    surrogate, value_loss, _ = ppo_loss(agent, moved, config)
    (gradient,) = torch.autograd.grad(surrogate + value_loss, v)
    return -gradient


def require_method(name: str) -> str:
    """`name`, if it is a design gradient; else an `InputError`."""
    if name not in METHODS:
        raise InputError(f"design_gradient: got {name!r}, expected one of {', '.join(METHODS)}.")
    return name
