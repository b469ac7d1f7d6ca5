from ccdtools.studies.by_fit import FittedGeneration as FittedGeneration, fitted_generations as fitted_generations
from ccdtools.studies.generations import Generations as Generations
from ccdtools.studies.loading import load_study as load_study
from ccdtools.studies.on_sensors import OnSensors as OnSensors
from ccdtools.studies.options import study_names as study_names
from ccdtools.studies.presets import StudyConfig as StudyConfig, configuration as configuration
from ccdtools.studies.real_plant import RealPlant as RealPlant
from ccdtools.studies.redesign_cost import RedesignCost as RedesignCost, decide_redesign as decide_redesign
from ccdtools.studies.run_folder import RunFolder as RunFolder
from ccdtools.studies.side_by_side import SideBySide as SideBySide
from ccdtools.studies.study import Study as Study
