"""Control co-design: a plant's physical parameters and its controller, designed together.

Everything that the README and the notebooks use is here, and is loaded when it is asked for. `ccdtools.studies` runs
whole case studies.
"""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from ccdtools_ground.packages import what_hides_ours

if TYPE_CHECKING:
    from ccdtools.co_design.admissible import admissible_inputs
    from ccdtools.co_design.closed_loop import closed_loop_returns
    from ccdtools.co_design.codesign import codesign
    from ccdtools.co_design.compare_methods import compare_methods
    from ccdtools.co_design.configuration import CoDesignConfig
    from ccdtools.co_design.custom_objective import CustomObjective, output_objective
    from ccdtools.co_design.design_controllers import linear_mpc, nonlinear_mpc, saturated_lqr
    from ccdtools.co_design.design_sensitivity import DesignSensitivity, design_sensitivity
    from ccdtools.co_design.expert import expert_dataset, feasible_sets
    from ccdtools.co_design.learned_result import LearnedCoDesign
    from ccdtools.co_design.least_depth import least_depth
    from ccdtools.co_design.methods.learned import Learned
    from ccdtools.co_design.methods.nested import Nested
    from ccdtools.co_design.methods.search import Search
    from ccdtools.co_design.methods.sequential import Sequential
    from ccdtools.co_design.methods.simultaneous import Simultaneous
    from ccdtools.co_design.multi_start import MultiStart, multi_start
    from ccdtools.co_design.objective import QuadraticObjective
    from ccdtools.co_design.optimum_sensitivity import optimum_sensitivity
    from ccdtools.co_design.preview import previewed_limits, previewed_objective, previewed_problem
    from ccdtools.co_design.problem import CoDesignProblem, FixedStart
    from ccdtools.co_design.random_starts import RandomStarts
    from ccdtools.co_design.result import CoDesignResult
    from ccdtools.co_design.risk import CVaR, Mean, MeanSpread, WorstCase
    from ccdtools.co_design.trade_off import TradeOff, trade_off
    from ccdtools.comparison.baselines import baselines
    from ccdtools.comparison.comparison import compare
    from ccdtools.comparison.ride import Ride
    from ccdtools.comparison.ride_comfort import comfort, weighted_acceleration
    from ccdtools.comparison.suspension import SuspensionMetrics, suspension_metrics
    from ccdtools.controllers.controllers import PID, LinearFeedback, Passive
    from ccdtools.controllers.filtered import Filtered
    from ccdtools.controllers.learned import LearnedPolicy, load_policy
    from ccdtools.controllers.observed import Observed
    from ccdtools.controllers.previewing import Previewing
    from ccdtools.controllers.signals import Reference
    from ccdtools.disturbances.combinations import Cases, Constant, Mixture, Stacked, Sum
    from ccdtools.disturbances.disturbance import Gaussian, Recorded, Uniform
    from ccdtools.disturbances.iso_road import ISORoad
    from ccdtools.disturbances.recordings import read_disturbance, read_road, read_speed
    from ccdtools.disturbances.roads import GeneratedRoad, road_disturbance
    from ccdtools.estimation.extended import ExtendedKalmanFilter
    from ccdtools.estimation.kalman import KalmanFilter
    from ccdtools.estimation.measurement import Measurement
    from ccdtools.exceptions import CCDError, InputError, JumpWarning, LimitWarning, NotDetectableError, SamplingWarning
    from ccdtools.limits import depth_outside, excursions
    from ccdtools.output_limits import OutputLimits
    from ccdtools.plants.design_space import DesignSpace
    from ccdtools.plants.discretisation import discretise
    from ccdtools.plants.equilibrium import equilibrium
    from ccdtools.plants.first_order_hold import first_order_hold
    from ccdtools.plants.linear_model import LinearModel
    from ccdtools.plants.linear_plants import plant_from_matrices, plant_from_state_space
    from ccdtools.plants.linearisation import deviations, linearise
    from ccdtools.plants.noise_covariance import noise_covariance
    from ccdtools.plants.plant import Plant
    from ccdtools.plants.preview import with_preview
    from ccdtools.plants.sampled_model import SampledModel
    from ccdtools.plants.torch_function import to_torch
    from ccdtools.scenario import Scenario
    from ccdtools.simulation import simulate
    from ccdtools.statistics import mean_interval
    from ccdtools.studies.loading import load_study
    from ccdtools.studies.presets import StudyConfig
    from ccdtools.studies.real_plant import RealPlant
    from ccdtools.studies.study import Study
    from ccdtools.trajectory import Trajectory
    from ccdtools.twin.deployment import deploy, deploy_and_update
    from ccdtools.twin.free_running import free_running_bands
    from ccdtools.twin.online import OnlineConfig
    from ccdtools.twin.replay import replay_problem, updated_problem
    from ccdtools.twin.twin import DigitalTwin
    from invariant_sets.polytope import Polytope
    from mpc.linear_mpc import LinearMPC

if what_hides_ours():
    raise ImportError(what_hides_ours())

__all__ = [
    "PID", "CCDError", "CVaR", "Cases", "CoDesignConfig", "CoDesignProblem", "CoDesignResult", "Constant",
    "CustomObjective", "DesignSensitivity", "DesignSpace", "DigitalTwin", "ExtendedKalmanFilter", "Filtered",
    "FixedStart", "Gaussian", "GeneratedRoad", "ISORoad", "InputError", "JumpWarning", "KalmanFilter", "Learned",
    "LearnedCoDesign", "LearnedPolicy", "LimitWarning", "LinearFeedback", "LinearMPC", "LinearModel", "Mean",
    "MeanSpread", "Measurement", "Mixture", "MultiStart", "Nested", "NotDetectableError", "Observed", "OnlineConfig",
    "OutputLimits", "Passive", "Plant", "Polytope", "Previewing", "QuadraticObjective", "RandomStarts", "RealPlant",
    "Recorded", "Reference", "Ride", "SampledModel", "SamplingWarning", "Scenario", "Search", "Sequential",
    "Simultaneous", "Stacked", "Study", "StudyConfig", "Sum", "SuspensionMetrics", "TradeOff", "Trajectory", "Uniform",
    "WorstCase", "admissible_inputs", "baselines", "closed_loop_returns", "codesign", "comfort", "compare",
    "compare_methods", "deploy", "deploy_and_update", "depth_outside", "design_sensitivity", "deviations", "discretise",
    "equilibrium", "excursions", "expert_dataset", "feasible_sets", "first_order_hold", "free_running_bands",
    "least_depth", "linear_mpc", "linearise", "load_policy", "load_study", "mean_interval", "multi_start",
    "noise_covariance", "nonlinear_mpc", "optimum_sensitivity", "output_objective", "plant_from_matrices",
    "plant_from_state_space", "previewed_limits", "previewed_objective", "previewed_problem", "read_disturbance",
    "read_road", "read_speed", "replay_problem", "road_disturbance", "saturated_lqr", "simulate", "suspension_metrics",
    "to_torch", "trade_off", "updated_problem", "weighted_acceleration", "with_preview",
]  # fmt: skip

_MODULES = {
    "ccdtools.co_design.admissible": "admissible_inputs",
    "ccdtools.co_design.closed_loop": "closed_loop_returns",
    "ccdtools.co_design.codesign": "codesign",
    "ccdtools.co_design.compare_methods": "compare_methods",
    "ccdtools.co_design.configuration": "CoDesignConfig",
    "ccdtools.co_design.custom_objective": "CustomObjective output_objective",
    "ccdtools.co_design.design_controllers": "linear_mpc nonlinear_mpc saturated_lqr",
    "ccdtools.co_design.design_sensitivity": "DesignSensitivity design_sensitivity",
    "ccdtools.co_design.expert": "expert_dataset feasible_sets",
    "ccdtools.co_design.learned_result": "LearnedCoDesign",
    "ccdtools.co_design.least_depth": "least_depth",
    "ccdtools.co_design.methods.learned": "Learned",
    "ccdtools.co_design.methods.nested": "Nested",
    "ccdtools.co_design.methods.search": "Search",
    "ccdtools.co_design.methods.sequential": "Sequential",
    "ccdtools.co_design.methods.simultaneous": "Simultaneous",
    "ccdtools.co_design.multi_start": "MultiStart multi_start",
    "ccdtools.co_design.objective": "QuadraticObjective",
    "ccdtools.co_design.optimum_sensitivity": "optimum_sensitivity",
    "ccdtools.co_design.preview": "previewed_limits previewed_objective previewed_problem",
    "ccdtools.co_design.problem": "CoDesignProblem FixedStart",
    "ccdtools.co_design.random_starts": "RandomStarts",
    "ccdtools.co_design.result": "CoDesignResult",
    "ccdtools.co_design.risk": "CVaR Mean MeanSpread WorstCase",
    "ccdtools.co_design.trade_off": "TradeOff trade_off",
    "ccdtools.comparison.baselines": "baselines",
    "ccdtools.comparison.comparison": "compare",
    "ccdtools.comparison.ride": "Ride",
    "ccdtools.comparison.ride_comfort": "comfort weighted_acceleration",
    "ccdtools.comparison.suspension": "SuspensionMetrics suspension_metrics",
    "ccdtools.controllers.controllers": "PID LinearFeedback Passive",
    "ccdtools.controllers.filtered": "Filtered",
    "ccdtools.controllers.learned": "LearnedPolicy load_policy",
    "ccdtools.controllers.observed": "Observed",
    "ccdtools.controllers.previewing": "Previewing",
    "ccdtools.controllers.signals": "Reference",
    "ccdtools.disturbances.combinations": "Cases Constant Mixture Stacked Sum",
    "ccdtools.disturbances.disturbance": "Gaussian Recorded Uniform",
    "ccdtools.disturbances.iso_road": "ISORoad",
    "ccdtools.disturbances.recordings": "read_disturbance read_road read_speed",
    "ccdtools.disturbances.roads": "GeneratedRoad road_disturbance",
    "ccdtools.estimation.extended": "ExtendedKalmanFilter",
    "ccdtools.estimation.kalman": "KalmanFilter",
    "ccdtools.estimation.measurement": "Measurement",
    "ccdtools.exceptions": "CCDError InputError JumpWarning LimitWarning NotDetectableError SamplingWarning",
    "ccdtools.limits": "depth_outside excursions",
    "ccdtools.output_limits": "OutputLimits",
    "ccdtools.plants.design_space": "DesignSpace",
    "ccdtools.plants.discretisation": "discretise",
    "ccdtools.plants.equilibrium": "equilibrium",
    "ccdtools.plants.first_order_hold": "first_order_hold",
    "ccdtools.plants.linear_model": "LinearModel",
    "ccdtools.plants.linear_plants": "plant_from_matrices plant_from_state_space",
    "ccdtools.plants.linearisation": "deviations linearise",
    "ccdtools.plants.noise_covariance": "noise_covariance",
    "ccdtools.plants.plant": "Plant",
    "ccdtools.plants.preview": "with_preview",
    "ccdtools.plants.sampled_model": "SampledModel",
    "ccdtools.plants.torch_function": "to_torch",
    "ccdtools.scenario": "Scenario",
    "ccdtools.simulation": "simulate",
    "ccdtools.statistics": "mean_interval",
    "ccdtools.studies.loading": "load_study",
    "ccdtools.studies.presets": "StudyConfig",
    "ccdtools.studies.real_plant": "RealPlant",
    "ccdtools.studies.study": "Study",
    "ccdtools.trajectory": "Trajectory",
    "ccdtools.twin.deployment": "deploy deploy_and_update",
    "ccdtools.twin.free_running": "free_running_bands",
    "ccdtools.twin.online": "OnlineConfig",
    "ccdtools.twin.replay": "replay_problem updated_problem",
    "ccdtools.twin.twin": "DigitalTwin",
    "invariant_sets.polytope": "Polytope",
    "mpc.linear_mpc": "LinearMPC",
}
_HOMES = {name: module for module, names in _MODULES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    """Public names, loaded when asked for: the command line's --help must not wait for torch."""
    if name == "__version__":
        return version("ccdtools")
    if name not in _HOMES:
        raise AttributeError(f"module 'ccdtools' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
