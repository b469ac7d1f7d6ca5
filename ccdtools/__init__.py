"""Control co-design: a plant's physical parameters and its controller, designed together.

`ccdtools.studies` runs case studies; everything below it is callable alone.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ccdtools.co_design.expert import expert_dataset
    from ccdtools.co_design.objective import QuadraticObjective
    from ccdtools.co_design.problem import CoDesignProblem
    from ccdtools.co_design.solve import codesign
    from ccdtools.controllers.learned import LearnedPolicy, load_policy
    from ccdtools.exceptions import CCDError, InputError
    from ccdtools.plants.design_space import DesignSpace
    from ccdtools.plants.discretisation import LinearModel, discretise
    from ccdtools.plants.plant import Plant
    from ccdtools.simulation import simulate
    from ccdtools.twin.deployment import deploy
    from ccdtools.twin.twin import DigitalTwin

__all__ = [
    "CCDError",
    "CoDesignProblem",
    "DesignSpace",
    "DigitalTwin",
    "InputError",
    "LearnedPolicy",
    "LinearModel",
    "Plant",
    "QuadraticObjective",
    "codesign",
    "deploy",
    "discretise",
    "expert_dataset",
    "load_policy",
    "simulate",
]

_HOMES = {
    "CCDError": "exceptions",
    "CoDesignProblem": "co_design.problem",
    "DesignSpace": "plants.design_space",
    "DigitalTwin": "twin.twin",
    "InputError": "exceptions",
    "LearnedPolicy": "controllers.learned",
    "LinearModel": "plants.discretisation",
    "Plant": "plants.plant",
    "QuadraticObjective": "co_design.objective",
    "codesign": "co_design.solve",
    "deploy": "twin.deployment",
    "discretise": "plants.discretisation",
    "expert_dataset": "co_design.expert",
    "load_policy": "controllers.learned",
    "simulate": "simulation",
}


def __getattr__(name: str) -> Any:
    """Public names, loaded when asked for: the command line's --help must not wait for torch."""
    if name not in _HOMES:
        raise AttributeError(f"module 'ccdtools' has no attribute {name!r}")
    return getattr(import_module(f"ccdtools.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
