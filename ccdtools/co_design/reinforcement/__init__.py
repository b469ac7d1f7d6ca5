"""Co-design by gradients through the model, with PPO beside them."""

from ccdtools.co_design.reinforcement.gradients import GradientCheck, check_gradients
from ccdtools.co_design.reinforcement.ppo import CoDesignConfig, CoDesignResult, History, codesign_ppo

__all__ = [
    "CoDesignConfig",
    "CoDesignResult",
    "GradientCheck",
    "History",
    "check_gradients",
    "codesign_ppo",
]
