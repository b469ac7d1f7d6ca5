"""Learning on arrays: networks, PPO, cloning and quantile regression."""

from ccdtools_ground.front_door import front_door

__all__, __getattr__ = front_door(__name__, __file__)


def __dir__() -> list[str]:
    return __all__
