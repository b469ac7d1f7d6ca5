"""Learning on arrays: networks, PPO, cloning and quantile regression."""

from learning.checkpoint import load, save
from learning.copula_fit import fit_copula
from learning.exceptions import InputError, LearningError
from learning.networks import ActorCritic, NetworkConfig
from learning.ppo import PPO, PPOConfig, gae, train
from learning.quantile import QuantileConfig, fit_quantiles
from learning.rollout import VectorEnv, collect
from learning.warm_start import CloningConfig, fit_actor_critic

__all__ = [
    "PPO",
    "ActorCritic",
    "CloningConfig",
    "InputError",
    "LearningError",
    "NetworkConfig",
    "PPOConfig",
    "QuantileConfig",
    "VectorEnv",
    "collect",
    "fit_actor_critic",
    "fit_copula",
    "fit_quantiles",
    "gae",
    "load",
    "save",
    "train",
]
