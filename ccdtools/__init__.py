"""Control co-design: a plant's physical parameters and its controller, designed together.

`ccdtools.studies` runs case studies; everything below it is callable alone.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ccdtools.deployment import deploy
    from ccdtools.design_space import DesignSpace
    from ccdtools.discretisation import LinearModel, discretise
    from ccdtools.exceptions import CCDError, InputError
    from ccdtools.expert import expert_dataset
    from ccdtools.methods import codesign
    from ccdtools.objective import QuadraticObjective
    from ccdtools.plant import Plant
    from ccdtools.policy import LearnedPolicy, load_policy
    from ccdtools.problem import CoDesignProblem
    from ccdtools.simulation import simulate
    from ccdtools.twin import DigitalTwin

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
    "CoDesignProblem": "problem",
    "DesignSpace": "design_space",
    "DigitalTwin": "twin",
    "InputError": "exceptions",
    "LearnedPolicy": "policy",
    "LinearModel": "discretisation",
    "Plant": "plant",
    "QuadraticObjective": "objective",
    "codesign": "methods",
    "deploy": "deployment",
    "discretise": "discretisation",
    "expert_dataset": "expert",
    "load_policy": "policy",
    "simulate": "simulation",
}


def __getattr__(name: str) -> Any:
    """Public names, loaded when asked for: the command line's --help must not wait for torch."""
    if name not in _HOMES:
        raise AttributeError(f"module 'ccdtools' has no attribute {name!r}")
    return getattr(import_module(f"ccdtools.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
