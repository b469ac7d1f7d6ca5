"""Co-design by gradients through the model, with PPO beside them."""

from ccdtools.co_design.reinforcement.gradients import check_gradients
from ccdtools.co_design.reinforcement.ppo import CoDesignConfig

__all__ = ["CoDesignConfig", "check_gradients"]
