"""Settings of a co-design."""

from __future__ import annotations

from dataclasses import dataclass, field

from ccdtools_ground.door import as_choice, as_count, as_flag, as_instance, as_number, as_share
from learning.ppo import PPOConfig

METHODS = ("pathwise", "ppo", "pathwise+ppo")
DESIGN_GRADIENTS = ("pathwise", "network_input")


@dataclass(frozen=True)
class CoDesignConfig:
    """Settings of a co-design.

    Attributes
    ----------
    iterations : int
        The budget of one start; each is one gradient of policy and design.
    block : int
        Iterations after which the gain is measured. Another block follows while it is significant and matters, or the
        design has not settled.
    tolerance : float
        Part of the return that a block must gain for another to follow.
    starts : int or None
        Designs that are climbed from: the given one, and the best of the landscape's other valleys. By default three of
        up to three parameters, two of more; with whole numbers every combination of up to eight, and of more the best
        three beside the given one, each kept from its start on. 1 leaves out the landscape.
    runs : int
        Parallel episodes of a PPO rollout.
    pathwise_runs : int
        Episodes per gradient through the dynamics.
    design_gradient : {"pathwise", "network_input"}
        Through the dynamics, or the paper's.
    design_rate : float
        0 freezes the design; else Adam's first rate in the unit box, where Adam is used.
    policy_rate : float
        0 keeps the policy from its gradient through the dynamics; else Adam's first rate, where Adam is used.
    constant_rates : bool
        Keep Adam's rates; by default they fall along a cosine to zero in every block.
    evaluate_every : int
        Iterations between evaluations of the current iterate.
    evaluation_runs : int
        Episodes of an evaluation, the same scenarios each time.
    ppo : PPOConfig

    Numbers of episodes are those of 100 steps; of longer ones fewer are taken, so that an iteration sees about as many
    samples, but no fewer than 16.
    """

    iterations: int = 400
    block: int = 40
    tolerance: float = 5e-4
    starts: int | None = None
    runs: int = 32
    pathwise_runs: int = 256
    design_gradient: str = "pathwise"
    design_rate: float = 0.03
    policy_rate: float = 1e-3
    constant_rates: bool = False
    evaluate_every: int = 10
    evaluation_runs: int = 1000
    ppo: PPOConfig = field(default_factory=lambda: PPOConfig(first_std=0.3))

    def __post_init__(self) -> None:
        as_choice("design_gradient", self.design_gradient, DESIGN_GRADIENTS)
        for name in ("iterations", "block", "runs", "pathwise_runs", "evaluate_every", "evaluation_runs"):
            as_count(name, getattr(self, name))
        if self.starts is not None:
            as_count("starts", self.starts)
        as_share("tolerance", self.tolerance)
        for name in ("design_rate", "policy_rate"):
            as_number(name, getattr(self, name), expected="a number ≥ 0", low=0.0)
        as_flag("constant_rates", self.constant_rates)
        as_instance("ppo", self.ppo, PPOConfig, "a PPOConfig")
