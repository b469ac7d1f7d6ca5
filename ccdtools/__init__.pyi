from ccdtools.co_design.closed_loop import closed_loop_returns as closed_loop_returns
from ccdtools.co_design.codesign import codesign as codesign
from ccdtools.co_design.compare_methods import compare_methods as compare_methods
from ccdtools.co_design.configuration import CoDesignConfig as CoDesignConfig
from ccdtools.co_design.custom_objective import CustomObjective as CustomObjective, output_objective as output_objective
from ccdtools.co_design.design_controllers import (
    linear_mpc as linear_mpc,
    nonlinear_mpc as nonlinear_mpc,
    saturated_lqr as saturated_lqr,
)
from ccdtools.co_design.design_sensitivity import design_sensitivity as design_sensitivity
from ccdtools.co_design.expert import expert_dataset as expert_dataset, feasible_sets as feasible_sets
from ccdtools.co_design.least_depth import least_depth as least_depth
from ccdtools.co_design.methods.learned import Learned as Learned
from ccdtools.co_design.methods.nested import Nested as Nested
from ccdtools.co_design.methods.search import Search as Search
from ccdtools.co_design.methods.sequential import Sequential as Sequential
from ccdtools.co_design.methods.simultaneous import Simultaneous as Simultaneous
from ccdtools.co_design.multi_start import multi_start as multi_start
from ccdtools.co_design.objective import QuadraticObjective as QuadraticObjective
from ccdtools.co_design.optimum_sensitivity import optimum_sensitivity as optimum_sensitivity
from ccdtools.co_design.problem import CoDesignProblem as CoDesignProblem, FixedStart as FixedStart
from ccdtools.co_design.random_starts import RandomStarts as RandomStarts
from ccdtools.co_design.risk import CVaR as CVaR, Mean as Mean, MeanSpread as MeanSpread, WorstCase as WorstCase
from ccdtools.co_design.trade_off import trade_off as trade_off
from ccdtools.comparison.comparison import compare as compare
from ccdtools.comparison.experiment import experiment as experiment
from ccdtools.comparison.pid_tuning import baselines as baselines
from ccdtools.controllers.controllers import PID as PID, LinearFeedback as LinearFeedback
from ccdtools.controllers.history import load_policy as load_policy
from ccdtools.controllers.learned import LearnedPolicy as LearnedPolicy
from ccdtools.disturbances.disturbance import Gaussian as Gaussian, Recorded as Recorded
from ccdtools.disturbances.recordings import read_disturbance as read_disturbance
from ccdtools.estimation.kalman import KalmanFilter as KalmanFilter
from ccdtools.estimation.measurement import Measurement as Measurement
from ccdtools.exceptions import CCDError as CCDError, InputError as InputError
from ccdtools.imitation import imitate as imitate
from ccdtools.limits import depth_outside as depth_outside, excursions as excursions
from ccdtools.output_limits import OutputLimits as OutputLimits
from ccdtools.plants.design_space import DesignSpace as DesignSpace
from ccdtools.plants.discretisation import discretise as discretise
from ccdtools.plants.equilibrium import equilibrium as equilibrium
from ccdtools.plants.linear_plants import (
    plant_from_matrices as plant_from_matrices,
    plant_from_state_space as plant_from_state_space,
)
from ccdtools.plants.linearisation import deviations as deviations, linearise as linearise
from ccdtools.plants.plant import Plant as Plant
from ccdtools.scenario import Scenario as Scenario
from ccdtools.simulation import simulate as simulate
from ccdtools.statistics import mean_interval as mean_interval
from ccdtools.studies.loading import load_study as load_study
from ccdtools.studies.presets import StudyConfig as StudyConfig
from ccdtools.studies.real_plant import RealPlant as RealPlant
from ccdtools.studies.study import Study as Study
from ccdtools.trajectory import Trajectory as Trajectory
from ccdtools.twin.deployment import deploy as deploy, deploy_and_update as deploy_and_update
from ccdtools.twin.online import OnlineConfig as OnlineConfig
from ccdtools.twin.twin import DigitalTwin as DigitalTwin
from invariant_sets.polytope import Polytope as Polytope
from mpc.linear_mpc import LinearMPC as LinearMPC

__version__: str
