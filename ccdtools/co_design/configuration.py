"""How a co-design runs."""

from __future__ import annotations

from dataclasses import dataclass, field

from ccdtools.checks import as_choice, as_count, as_flag, as_instance, as_number
from learning.ppo import PPOConfig

METHODS = ("pathwise", "ppo", "pathwise+ppo")
DESIGN_GRADIENTS = ("pathwise", "network_input")


@dataclass(frozen=True)
class CoDesignConfig:
    """How a co-design runs.

    Attributes
    ----------
    iterations : int
        Each is one step of the policy and one of the design.
    runs : int
        Parallel episodes of a PPO rollout.
    pathwise_runs : int
        Episodes per gradient through the dynamics.
    design_gradient : {"pathwise", "network_input"}
        Through the dynamics, or the paper's.
    design_rate : float
        Adam's first rate for the design in the unit box; 0 freezes the design.
    policy_rate : float
        Adam's first rate for the policy's own gradient through the dynamics.
    constant_rates : bool
        Keep every rate; by default they fall along a cosine to zero.
    evaluate_every : int
        Iterations between evaluations of the current iterate.
    evaluation_runs : int
        Episodes of an evaluation, the same scenarios each time.
    ppo : PPOConfig

    Numbers of episodes are those of 100 steps; of longer ones fewer are taken, so that an iteration sees about as many
    samples, but no fewer than 16.
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
        as_choice("design_gradient", self.design_gradient, DESIGN_GRADIENTS)
        for name in ("iterations", "runs", "pathwise_runs", "evaluate_every", "evaluation_runs"):
            as_count(name, getattr(self, name))
        for name in ("design_rate", "policy_rate"):
            as_number(name, getattr(self, name), expected="a number ≥ 0", low=0.0)
        as_flag("constant_rates", self.constant_rates)
        as_instance("ppo", self.ppo, PPOConfig, "a PPOConfig")
