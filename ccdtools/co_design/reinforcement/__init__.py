"""PPO's part in a co-design, and the design gradients compared."""

from ccdtools.co_design.configuration import CoDesignConfig
from ccdtools.co_design.reinforcement.gradients import check_gradients

__all__ = ["CoDesignConfig", "check_gradients"]
