"""Two tanks filled to their levels; areas and outlet are the design.

Both plants are in deviations from where the nominal one rests; the real one leaks and rests lower.
"""

from ccdtools.disturbances.disturbance import Gaussian
from ccdtools.plants.library import two_tanks
from ccdtools.studies.cases._regulated import regulated_study

study = regulated_study(
    "two_tanks", "Two tanks", two_tanks,
    limits=[4.5, 6.0],  # cm; the upper tank rests at 5 to 17 cm, as its outlet says, the lower one at 10 cm
    tolerable=[3.0, 0.5], inputs=[2.9], effort=[1.0],  # cm, V; at rest 2.99 V, and the pump does not draw
    disturbance=Gaussian(std=[1.0, 1.0]),  # cm³/s, of inflows beside 10 cm³/s of the pump
    x0=[-3.0, -4.0], p0=[28.0, 28.0, 0.071], steps=200,  # the design is that of the library's source
)  # fmt: skip
