from ccdtools.plants.black_box import BlackBox as BlackBox, from_gymnasium as from_gymnasium
from ccdtools.plants.design_space import DesignSpace as DesignSpace
from ccdtools.plants.discretisation import discretise as discretise
from ccdtools.plants.fmu import from_fmu as from_fmu
from ccdtools.plants.holds import first_order_hold as first_order_hold, noise_covariance as noise_covariance
from ccdtools.plants.linear_model import LinearModel as LinearModel
from ccdtools.plants.linear_plants import (
    plant_from_matrices as plant_from_matrices,
    plant_from_state_space as plant_from_state_space,
)
from ccdtools.plants.linearisation import deviations as deviations, linearise as linearise
from ccdtools.plants.plant import Plant as Plant
from ccdtools.plants.preview import with_preview as with_preview
from ccdtools.plants.sampled_model import SampledModel as SampledModel
from ccdtools.plants.torch_function import to_torch as to_torch
