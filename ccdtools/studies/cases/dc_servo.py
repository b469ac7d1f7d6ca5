"""A geared DC servo that turns a load by 1 rad; gear and flywheel are the design."""

import numpy as np

from ccdtools.disturbances.disturbance import Gaussian
from ccdtools.plants.library import dc_servo
from ccdtools.studies.cases._regulated import regulated_study

study = regulated_study(
    "dc_servo", "DC servo", dc_servo,
    limits=[np.pi, 60.0],  # rad, rad/s; at 24 V and the start's gear the motor runs at 44 rad/s of the load
    tolerable=[0.1, 20.0], inputs=[24.0], effort=[12.0],  # V; the first is that of the supply
    disturbance=Gaussian(std=[0.1]),  # N·m, on the load
    x0=[-1.0, 0.0], p0=[20.0, 1e-3], steps=100,
)  # fmt: skip
