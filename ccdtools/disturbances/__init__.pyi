from ccdtools.disturbances.combinations import (
    Cases as Cases,
    Constant as Constant,
    Mixture as Mixture,
    Stacked as Stacked,
    Sum as Sum,
)
from ccdtools.disturbances.disturbance import Gaussian as Gaussian, Recorded as Recorded, Uniform as Uniform
from ccdtools.disturbances.recordings import read_disturbance as read_disturbance
