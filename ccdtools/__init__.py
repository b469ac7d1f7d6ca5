"""Control co-design: a plant's physical parameters and its controller, designed together.

What most scripts use is here; `__init__.pyi` lists it. The rest is in groups, each with a list of its own: `plants`,
`disturbances`, `controllers`, `estimation`, `vehicles`, `co_design`, `twin`, `exceptions`. `ccdtools.studies` runs
whole case studies. All is loaded when it is asked for: the command line's --help must not wait for torch.
"""

from importlib.metadata import version
from typing import Any

from ccdtools_ground.front_door import front_door
from ccdtools_ground.packages import what_hides_ours

if what_hides_ours():
    raise ImportError(what_hides_ours())

GROUPS = ("plants", "disturbances", "controllers", "estimation", "vehicles", "co_design", "twin", "exceptions")

__all__, _load, __dir__ = front_door(__name__, __file__, GROUPS)


def __getattr__(name: str) -> Any:
    return version("ccdtools") if name == "__version__" else _load(name)
