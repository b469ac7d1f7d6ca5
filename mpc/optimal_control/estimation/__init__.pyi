from mpc.optimal_control.estimation.experiment import Experiment as Experiment
from mpc.optimal_control.estimation.moving_horizon import MovingHorizonEstimator as MovingHorizonEstimator
from mpc.optimal_control.estimation.parameter_estimate import (
    EstimationStatus as EstimationStatus,
    ParameterEstimate as ParameterEstimate,
)
from mpc.optimal_control.estimation.parameter_estimation import estimate_parameters as estimate_parameters
