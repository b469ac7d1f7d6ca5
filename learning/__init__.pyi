from learning.checkpoint import load as load, save as save
from learning.exceptions import InputError as InputError, LearningError as LearningError
from learning.networks import ActorCritic as ActorCritic, NetworkConfig as NetworkConfig
from learning.ppo import PPO as PPO, PPOConfig as PPOConfig, gae as gae, train as train
from learning.quantile import QuantileConfig as QuantileConfig, fit_quantiles as fit_quantiles
from learning.rollout import VectorEnv as VectorEnv, collect as collect
from learning.warm_start import CloningConfig as CloningConfig, fit_actor_critic as fit_actor_critic
