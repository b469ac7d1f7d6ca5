from ccdtools.evidence.drift import Drift as Drift, detect_drift as detect_drift
from ccdtools.evidence.switchback import Trial as Trial, switchback as switchback
from ccdtools.twin.deployment import deploy as deploy, deploy_and_update as deploy_and_update
from ccdtools.twin.error_set import disturbance_set as disturbance_set
from ccdtools.twin.experiments import ExperimentPlan as ExperimentPlan, plan_experiment as plan_experiment
from ccdtools.twin.free_running import free_running_bands as free_running_bands
from ccdtools.twin.identified import (
    identified_change as identified_change,
    identified_lqr as identified_lqr,
    identified_plant as identified_plant,
)
from ccdtools.twin.log_drift import drift_of_log as drift_of_log, outside_data as outside_data
from ccdtools.twin.online import OnlineConfig as OnlineConfig
from ccdtools.twin.output_log import OutputLog as OutputLog
from ccdtools.twin.plant_fit import PlantFit as PlantFit, fit_plant as fit_plant
from ccdtools.twin.replay import replay_problem as replay_problem, updated_problem as updated_problem
from ccdtools.twin.tightened import RobustMPC as RobustMPC, robust_mpc as robust_mpc
from ccdtools.twin.trial import TrialConfig as TrialConfig, switchback_on as switchback_on
from ccdtools.twin.twin import DigitalTwin as DigitalTwin
