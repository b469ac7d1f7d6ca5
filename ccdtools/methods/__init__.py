"""Co-design: policy, value and design optimised together."""

from ccdtools.methods.gradients import GradientCheck, check_gradients
from ccdtools.methods.ppo import CoDesignConfig, CoDesignResult, History, codesign_ppo
from ccdtools.methods.solve import codesign

__all__ = [
    "CoDesignConfig",
    "CoDesignResult",
    "GradientCheck",
    "History",
    "check_gradients",
    "codesign",
    "codesign_ppo",
]
