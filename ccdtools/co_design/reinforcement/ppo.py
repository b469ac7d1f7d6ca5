"""Co-design by reinforcement learning: policy, value and design optimised together."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor
from tqdm import trange

from ccdtools.arrays import Array
from ccdtools.checks import as_choice, as_count, as_flag, as_instance, as_number
from ccdtools.co_design.differentiable_model import mean_return, returns_at, scenario_tensors, to_design
from ccdtools.co_design.environment import DesignEnv
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.reinforcement.gradients import METHODS, check_gradients, loss_gradient, pathwise_gradient
from ccdtools.co_design.result import CoDesignResult, History
from learning.networks import ActorCritic
from learning.ppo import PPO, PPOConfig, decay_exploration, prepare
from learning.rollout import collect


@dataclass(frozen=True)
class CoDesignConfig:
    """How a co-design runs.

    Attributes
    ----------
    iterations : int
        Each is one rollout, one PPO update, and one step of the design.
    runs : int
        Parallel episodes per rollout.
    pathwise_runs : int
        Episodes per gradient through the dynamics.
    design_gradient : {"pathwise", "network_input"}
        Through the dynamics, or the paper's.
    design_rate : float
        Adam's first rate for the design in the unit box; 0 freezes the design.
    policy_rate : float
        Adam's first rate for the policy's own gradient through the dynamics; 0 leaves the policy to PPO alone.
    constant_rates : bool
        Keep every rate; by default they fall along a cosine to zero.
    evaluate_every : int
        Iterations between evaluations of the current iterate.
    evaluation_runs : int
        Episodes of an evaluation, the same scenarios each time.
    ppo : PPOConfig
    """

    iterations: int = 120
    runs: int = 128
    pathwise_runs: int = 128
    design_gradient: str = "pathwise"
    design_rate: float = 0.03
    policy_rate: float = 1e-3
    constant_rates: bool = False
    evaluate_every: int = 4
    evaluation_runs: int = 1000
    ppo: PPOConfig = field(
        default_factory=lambda: PPOConfig(learning_rate=1e-4, kl_limit=0.005, passes=2, final_std=0.02)
    )

    def __post_init__(self) -> None:
        as_choice("design_gradient", self.design_gradient, METHODS)
        for name in ("iterations", "runs", "pathwise_runs", "evaluate_every", "evaluation_runs"):
            as_count(name, getattr(self, name))
        for name in ("design_rate", "policy_rate"):
            as_number(name, getattr(self, name), expected="a number ≥ 0", low=0.0)
        as_flag("constant_rates", self.constant_rates)
        as_instance("ppo", self.ppo, PPOConfig, "a PPOConfig")


def codesign_ppo(
    problem: CoDesignProblem,
    *,
    agent: ActorCritic,
    design: Array,
    rng: np.random.Generator,
    config: CoDesignConfig,
    judge: CoDesignProblem,
    progress: bool,
) -> CoDesignResult:
    """The best design and policy met on the way from `design` and a warm-started `agent`; `codesign` checks them.

    Each iteration collects episodes of the sampled policy, updates policy and value by PPO, and moves the design
    (and, unless `policy_rate` is 0, the policy) along the gradient of the mean policy's whole-episode return
    through the dynamics. The design stays in its bounds; its optimiser lives as long as the training.
    """
    run = _Run(problem, judge, copy.deepcopy(agent), design, rng, config)
    gradients = None
    if config.design_rate > 0:
        gradients = check_gradients(problem, run.agent, design, rng=rng, ppo=config.ppo)
    run.evaluate(0)
    for k in trange(config.iterations, desc="co-design", disable=not progress, leave=False):
        run.iterate(k)
        if (k + 1) % config.evaluate_every == 0 or k + 1 == config.iterations:
            run.evaluate(k + 1)
    best = problem.design.from_unit(run.best[1].numpy())
    return CoDesignResult(best, run.best[2], problem.design.active_bounds(best), run.history(), gradients)


class _Run:
    """The moving parts of one co-design."""

    def __init__(self, problem, judge, agent, design, rng, config) -> None:
        self.judge = judge
        self.problem = problem
        self.agent = agent
        self.rng = rng
        self.config = config
        self.v = torch.tensor(problem.design.to_unit(design), dtype=torch.float32).requires_grad_(True)
        self.generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
        self.ppo = PPO(agent, config.ppo)
        self.first_std = agent.log_std.exp().mean().item()
        self.design_optimiser = torch.optim.Adam([self.v], lr=config.design_rate or 1.0, betas=(0.8, 0.9))
        self.policy_optimiser = torch.optim.Adam(agent.mean_network.parameters(), lr=config.policy_rate or 1.0)
        self.env = DesignEnv(problem, self._p(), runs=config.runs, rng=rng)
        self.evaluation = scenario_tensors(judge, config.evaluation_runs, rng)
        self.best: tuple[float, Tensor, ActorCritic] = (-np.inf, self.v.detach().clone(), agent)
        self.rows: list[tuple] = []

    def _p(self) -> Tensor:
        """The present design (np,), without its gradient."""
        return to_design(self.problem, self.v.detach())

    def evaluate(self, iteration: int) -> None:
        """Score the iterate on the fixed scenarios; keep it if it is the best so far."""
        with torch.no_grad():
            total, diverged = returns_at(self.judge, self.agent, self.v.detach(), self.evaluation)
        kept = total[~diverged].double()
        mean = kept.mean().item() if len(kept) else float("nan")
        std = kept.std().item() if len(kept) > 1 else 0.0
        steps = iteration * self.config.runs * self.problem.steps
        lost = diverged.float().mean().item()
        self.rows.append((iteration, steps, self._design(), mean, std, lost))
        score = total.double().mean().item()  # a diverged run counts with its whole, huge cost
        if score > self.best[0]:
            self.best = (score, self.v.detach().clone(), copy.deepcopy(self.agent))

    def iterate(self, k: int) -> None:
        """One rollout, one PPO update, one step through the dynamics."""
        config = self.config
        self._set_rates(k)
        self.env.move(self._p())
        rollout = collect(self.env, self.agent, steps=self.problem.steps, generator=self.generator)
        design_gradient: Tensor | None = None
        if config.design_rate > 0 and config.design_gradient == "network_input":
            batch = prepare(self.agent, rollout, config.ppo)
            design_gradient = loss_gradient(self.problem, self.agent, self.v, batch, config.ppo)
        self.ppo.update(rollout, generator=self.generator, actor=k >= config.ppo.critic_only)
        if config.policy_rate > 0:
            gradient = self._improve_policy(scenario_tensors(self.problem, config.pathwise_runs, self.rng))
            design_gradient = gradient if design_gradient is None else design_gradient
        elif config.design_rate > 0 and design_gradient is None:
            scenarios = scenario_tensors(self.problem, config.pathwise_runs, self.rng)
            gradient, mean = pathwise_gradient(self.problem, self.agent, self.v, scenarios)
            design_gradient = gradient / mean.abs()
        if config.design_rate > 0 and design_gradient is not None:
            self._move_design(design_gradient)

    def _improve_policy(self, scenarios: tuple[Tensor, Tensor]) -> Tensor:
        """A step of the policy through the dynamics; the design's gradient comes from the same pass."""
        mean = mean_return(self.problem, self.agent, self.v, scenarios)
        parameters = list(self.agent.mean_network.parameters())
        relative = -mean / mean.detach().abs()  # so that a lost run's 1e8 today does not drown tomorrow's steps
        *gradients, design_gradient = torch.autograd.grad(relative, [*parameters, self.v])
        for parameter, gradient in zip(parameters, gradients):
            parameter.grad = gradient
        if torch.nn.utils.clip_grad_norm_(parameters, 1.0).isfinite():
            self.policy_optimiser.step()
        return -design_gradient

    def _move_design(self, gradient: Tensor) -> None:
        """Adam in the unit box on the clipped gradient, then back into the bounds."""
        norm = gradient.norm()
        if not norm.isfinite():
            return
        self.v.grad = -gradient / norm.clamp(min=1.0)
        self.design_optimiser.step()
        with torch.no_grad():
            self.v.clamp_(0.0, 1.0)

    def _set_rates(self, k: int) -> None:
        """Exploration and learning rates of iteration k."""
        config = self.config
        decay_exploration(self.agent, self.first_std, config.ppo.final_std, k / max(config.iterations - 1, 1))
        factor = 1.0 if config.constant_rates else 0.5 * (1 + np.cos(np.pi * k / config.iterations))
        for optimiser, rate in (
            (self.design_optimiser, config.design_rate),
            (self.policy_optimiser, config.policy_rate),
            (self.ppo.actor_optimiser, config.ppo.learning_rate),
            (self.ppo.critic_optimiser, config.ppo.value_rate),
        ):
            for group in optimiser.param_groups:
                group["lr"] = rate * factor

    def _design(self) -> Array:
        """The present design (np,), in physical units."""
        return self.problem.design.from_unit(self.v.detach().double().numpy())

    def history(self) -> History:
        """The evaluations so far."""
        return History(*(np.array(column) for column in zip(*self.rows)))
