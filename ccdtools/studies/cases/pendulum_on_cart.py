"""A pole on a cart, caught from 0.5 rad; length and mass are the design."""

from ccdtools.disturbances.disturbance import Gaussian
from ccdtools.plants.library import pendulum_on_cart
from ccdtools.studies.cases._regulated import regulated_study

study = regulated_study(
    "pendulum_on_cart", "Pendulum on a cart", pendulum_on_cart,
    limits=[2.0, 5.0, 1.0, 6.0],  # m (half the track), m/s, rad, rad/s
    tolerable=[0.5, 2.0, 0.2, 2.0], inputs=[10.0], effort=[10.0],  # N; the real motor ends at 12 N
    disturbance=Gaussian(std=[0.2]),  # N, of wind
    x0=[0.0, 0.0, 0.5, 0.0], p0=[0.6, 0.5], steps=200,  # the design is that of the library's source
)  # fmt: skip
