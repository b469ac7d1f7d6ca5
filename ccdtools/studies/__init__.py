"""Case studies: the only place that runs experiments."""

from ccdtools.studies.comparison import Comparison, compare
from ccdtools.studies.configuration import StudyConfig, configuration
from ccdtools.studies.generations import Generations
from ccdtools.studies.run_folder import RunFolder
from ccdtools.studies.study import RealPlant, Study, load_study, study_names

__all__ = [
    "Comparison",
    "Generations",
    "RealPlant",
    "RunFolder",
    "Study",
    "StudyConfig",
    "compare",
    "configuration",
    "load_study",
    "study_names",
]
