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
    from ccdtools.co_design.secant import stochastic_linearisation
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
    from ccdtools.plants.equilibrium import Equilibrium, equilibrium
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
    "PID",
    "CCDError",
    "CVaR",
    "Cases",
    "CoDesignConfig",
    "CoDesignProblem",
    "CoDesignResult",
    "Constant",
    "CustomObjective",
    "DesignSensitivity",
    "DesignSpace",
    "DigitalTwin",
    "Equilibrium",
    "ExtendedKalmanFilter",
    "Filtered",
    "FixedStart",
    "Gaussian",
    "GeneratedRoad",
    "ISORoad",
    "InputError",
    "JumpWarning",
    "KalmanFilter",
    "Learned",
    "LearnedCoDesign",
    "LearnedPolicy",
    "LimitWarning",
    "LinearFeedback",
    "LinearMPC",
    "LinearModel",
    "Mean",
    "MeanSpread",
    "Measurement",
    "Mixture",
    "MultiStart",
    "Nested",
    "NotDetectableError",
    "Observed",
    "OnlineConfig",
    "OutputLimits",
    "Passive",
    "Plant",
    "Polytope",
    "Previewing",
    "QuadraticObjective",
    "RandomStarts",
    "RealPlant",
    "Recorded",
    "Reference",
    "Ride",
    "SampledModel",
    "SamplingWarning",
    "Scenario",
    "Search",
    "Sequential",
    "Simultaneous",
    "Stacked",
    "Study",
    "StudyConfig",
    "Sum",
    "SuspensionMetrics",
    "TradeOff",
    "Trajectory",
    "Uniform",
    "WorstCase",
    "admissible_inputs",
    "baselines",
    "closed_loop_returns",
    "codesign",
    "comfort",
    "compare",
    "compare_methods",
    "deploy",
    "deploy_and_update",
    "depth_outside",
    "design_sensitivity",
    "deviations",
    "discretise",
    "equilibrium",
    "excursions",
    "expert_dataset",
    "feasible_sets",
    "first_order_hold",
    "free_running_bands",
    "least_depth",
    "linear_mpc",
    "linearise",
    "load_policy",
    "load_study",
    "mean_interval",
    "multi_start",
    "noise_covariance",
    "nonlinear_mpc",
    "optimum_sensitivity",
    "output_objective",
    "plant_from_matrices",
    "plant_from_state_space",
    "previewed_limits",
    "previewed_objective",
    "previewed_problem",
    "read_disturbance",
    "read_road",
    "read_speed",
    "replay_problem",
    "road_disturbance",
    "saturated_lqr",
    "simulate",
    "stochastic_linearisation",
    "suspension_metrics",
    "to_torch",
    "trade_off",
    "updated_problem",
    "weighted_acceleration",
    "with_preview",
]

_HOMES = {
    "CCDError": "exceptions",
    "CVaR": "co_design.risk",
    "Cases": "disturbances.combinations",
    "CoDesignConfig": "co_design.configuration",
    "CoDesignProblem": "co_design.problem",
    "CoDesignResult": "co_design.result",
    "Constant": "disturbances.combinations",
    "CustomObjective": "co_design.custom_objective",
    "DesignSensitivity": "co_design.design_sensitivity",
    "DesignSpace": "plants.design_space",
    "DigitalTwin": "twin.twin",
    "Equilibrium": "plants.equilibrium",
    "ExtendedKalmanFilter": "estimation.extended",
    "Filtered": "controllers.filtered",
    "FixedStart": "co_design.problem",
    "Gaussian": "disturbances.disturbance",
    "GeneratedRoad": "disturbances.roads",
    "ISORoad": "disturbances.iso_road",
    "InputError": "exceptions",
    "JumpWarning": "exceptions",
    "KalmanFilter": "estimation.kalman",
    "Learned": "co_design.methods.learned",
    "LearnedCoDesign": "co_design.learned_result",
    "LearnedPolicy": "controllers.learned",
    "LimitWarning": "exceptions",
    "LinearFeedback": "controllers.controllers",
    "LinearMPC": "mpc.linear_mpc",
    "LinearModel": "plants.linear_model",
    "Mean": "co_design.risk",
    "MeanSpread": "co_design.risk",
    "Measurement": "estimation.measurement",
    "Mixture": "disturbances.combinations",
    "MultiStart": "co_design.multi_start",
    "Nested": "co_design.methods.nested",
    "NotDetectableError": "exceptions",
    "Observed": "controllers.observed",
    "OnlineConfig": "twin.online",
    "OutputLimits": "output_limits",
    "PID": "controllers.controllers",
    "Passive": "controllers.controllers",
    "Plant": "plants.plant",
    "Polytope": "invariant_sets.polytope",
    "Previewing": "controllers.previewing",
    "QuadraticObjective": "co_design.objective",
    "RandomStarts": "co_design.random_starts",
    "RealPlant": "studies.real_plant",
    "Recorded": "disturbances.disturbance",
    "Reference": "controllers.signals",
    "Ride": "comparison.ride",
    "SampledModel": "plants.sampled_model",
    "SamplingWarning": "exceptions",
    "Scenario": "scenario",
    "Search": "co_design.methods.search",
    "Sequential": "co_design.methods.sequential",
    "Simultaneous": "co_design.methods.simultaneous",
    "Stacked": "disturbances.combinations",
    "Study": "studies.study",
    "StudyConfig": "studies.presets",
    "Sum": "disturbances.combinations",
    "SuspensionMetrics": "comparison.suspension",
    "TradeOff": "co_design.trade_off",
    "Trajectory": "trajectory",
    "Uniform": "disturbances.disturbance",
    "WorstCase": "co_design.risk",
    "admissible_inputs": "co_design.admissible",
    "baselines": "comparison.baselines",
    "closed_loop_returns": "co_design.closed_loop",
    "codesign": "co_design.codesign",
    "comfort": "comparison.ride_comfort",
    "compare": "comparison.comparison",
    "compare_methods": "co_design.compare_methods",
    "deploy": "twin.deployment",
    "deploy_and_update": "twin.deployment",
    "depth_outside": "limits",
    "design_sensitivity": "co_design.design_sensitivity",
    "deviations": "plants.linearisation",
    "discretise": "plants.discretisation",
    "equilibrium": "plants.equilibrium",
    "excursions": "limits",
    "expert_dataset": "co_design.expert",
    "feasible_sets": "co_design.expert",
    "first_order_hold": "plants.first_order_hold",
    "free_running_bands": "twin.free_running",
    "least_depth": "co_design.least_depth",
    "linear_mpc": "co_design.design_controllers",
    "linearise": "plants.linearisation",
    "load_policy": "controllers.learned",
    "load_study": "studies.loading",
    "mean_interval": "statistics",
    "multi_start": "co_design.multi_start",
    "noise_covariance": "plants.noise_covariance",
    "nonlinear_mpc": "co_design.design_controllers",
    "optimum_sensitivity": "co_design.optimum_sensitivity",
    "output_objective": "co_design.custom_objective",
    "plant_from_matrices": "plants.linear_plants",
    "plant_from_state_space": "plants.linear_plants",
    "previewed_limits": "co_design.preview",
    "previewed_objective": "co_design.preview",
    "previewed_problem": "co_design.preview",
    "read_disturbance": "disturbances.recordings",
    "read_road": "disturbances.recordings",
    "read_speed": "disturbances.recordings",
    "replay_problem": "twin.replay",
    "road_disturbance": "disturbances.roads",
    "saturated_lqr": "co_design.design_controllers",
    "simulate": "simulation",
    "stochastic_linearisation": "co_design.secant",
    "suspension_metrics": "comparison.suspension",
    "to_torch": "plants.torch_function",
    "trade_off": "co_design.trade_off",
    "updated_problem": "twin.replay",
    "weighted_acceleration": "comparison.ride_comfort",
    "with_preview": "plants.preview",
}


def __getattr__(name: str) -> Any:
    """Public names, loaded when asked for: the command line's --help must not wait for torch."""
    if name == "__version__":
        return version("ccdtools")
    if name not in _HOMES:
        raise AttributeError(f"module 'ccdtools' has no attribute {name!r}")
    home = _HOMES[name]
    theirs = home.startswith(("invariant_sets.", "mpc."))
    return getattr(import_module(home if theirs else f"ccdtools.{home}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
