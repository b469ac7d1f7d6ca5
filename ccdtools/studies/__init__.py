"""Case studies: the only place that runs experiments. `__init__.pyi` lists what it offers."""

from ccdtools_ground.front_door import front_door

__all__, __getattr__, __dir__ = front_door(__name__, __file__)
