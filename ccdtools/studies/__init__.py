"""Case studies: the only place that runs experiments."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ccdtools.studies.generations import Generations
    from ccdtools.studies.loading import load_study
    from ccdtools.studies.options import study_names
    from ccdtools.studies.presets import StudyConfig, configuration
    from ccdtools.studies.real_plant import RealPlant
    from ccdtools.studies.run_folder import RunFolder
    from ccdtools.studies.study import Study

__all__ = [
    "Generations", "RealPlant", "RunFolder", "Study", "StudyConfig",
    "configuration", "load_study", "study_names",
]  # fmt: skip

_HOMES = {
    "Generations": "generations",
    "RealPlant": "real_plant",
    "RunFolder": "run_folder",
    "Study": "study",
    "StudyConfig": "presets",
    "configuration": "presets",
    "load_study": "loading",
    "study_names": "options",
}


def __getattr__(name: str) -> Any:
    """Public names, loaded when asked for: the command line checks its options without waiting for torch."""
    if name not in _HOMES:
        raise AttributeError(f"module 'ccdtools.studies' has no attribute {name!r}")
    return getattr(import_module(f"ccdtools.studies.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
