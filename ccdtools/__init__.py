"""Control co-design: a plant's physical parameters and its controller, designed together.

Everything that the README and the notebooks use is here (`__init__.pyi` lists it), and is loaded when it is asked for:
the command line's --help must not wait for torch. `ccdtools.studies` runs whole case studies.
"""

from importlib.metadata import version
from typing import Any

from ccdtools_ground.front_door import front_door
from ccdtools_ground.packages import what_hides_ours

if what_hides_ours():
    raise ImportError(what_hides_ours())

__all__, _load = front_door(__name__, __file__)


def __getattr__(name: str) -> Any:
    return version("ccdtools") if name == "__version__" else _load(name)


def __dir__() -> list[str]:
    return __all__
