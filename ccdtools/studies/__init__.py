"""Case studies: the only place that runs experiments. `__init__.pyi` lists what it offers."""

from ccdtools_ground.front_door import front_door

__all__, __getattr__ = front_door(__name__, __file__)


def __dir__() -> list[str]:
    return __all__
