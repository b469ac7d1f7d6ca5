from ccdtools.twin.deployment import deploy as deploy, deploy_and_update as deploy_and_update
from ccdtools.twin.error_set import disturbance_set as disturbance_set
from ccdtools.twin.free_running import free_running_bands as free_running_bands
from ccdtools.twin.identified import identified_lqr as identified_lqr
from ccdtools.twin.online import OnlineConfig as OnlineConfig
from ccdtools.twin.replay import replay_problem as replay_problem, updated_problem as updated_problem
from ccdtools.twin.tightened import RobustMPC as RobustMPC, robust_mpc as robust_mpc
from ccdtools.twin.twin import DigitalTwin as DigitalTwin
