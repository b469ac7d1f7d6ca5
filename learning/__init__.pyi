from learning.checkpoint import load as load, save as save
from learning.conformal import AdaptiveConformal as AdaptiveConformal, Conformal as Conformal
from learning.exceptions import (
    CheckpointError as CheckpointError,
    DivergedError as DivergedError,
    InputError as InputError,
    LearningError as LearningError,
    SimulatorError as SimulatorError,
)
from learning.gymnasium_envs import GymnasiumEnvs as GymnasiumEnvs
from learning.networks import ActorCritic as ActorCritic, NetworkConfig as NetworkConfig
from learning.ppo import PPO as PPO, PPOConfig as PPOConfig, UpdateStatistics as UpdateStatistics, gae as gae
from learning.quantile import QuantileConfig as QuantileConfig, fit_quantiles as fit_quantiles
from learning.quantile_regressor import QuantileRegressor as QuantileRegressor
from learning.rollout import Collector as Collector, VectorEnv as VectorEnv, collect as collect
from learning.training import Training as Training, TrainingRow as TrainingRow, train as train
from learning.warm_start import CloningConfig as CloningConfig, fit_actor_critic as fit_actor_critic
