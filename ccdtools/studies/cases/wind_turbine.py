"""A wind turbine's drivetrain after a gust; shaft and gear are the design."""

from ccdtools.disturbances.disturbance import Gaussian
from ccdtools.plants.library import wind_turbine
from ccdtools.studies.cases._regulated import regulated_study

study = regulated_study(
    "wind_turbine", "Wind turbine", wind_turbine,
    limits=[0.002, 0.3, 0.3],  # rad (0.005 at rest), rad/s (a quarter of 12.1 rpm)
    tolerable=[0.0005, 0.05, 0.05],
    inputs=[3.0, 6.0], effort=[1.5, 3.0],  # kN·m, °; the real ones end at 4 and 8
    # White gusts of 1 m/s have the slow part of wind of a few per cent of turbulence, and shake the shaft besides.
    disturbance=Gaussian(std=[1.0]),
    x0=[0.0, 0.1, 0.1], p0=[867.637e6, 97.0], steps=200,  # the design is that of the library's source
)  # fmt: skip
