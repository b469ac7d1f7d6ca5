"""Plants that are ready to use: each a function that returns a `Plant`, nominal or as a real one is (`real=True`)."""

from ccdtools.plants.library.car import Car, full_car, half_car
from ccdtools.plants.library.dc_servo import Servo, dc_servo
from ccdtools.plants.library.illustrative import illustrative
from ccdtools.plants.library.mass_chain import mass_chain
from ccdtools.plants.library.pendulum_on_cart import CartPole, pendulum_on_cart
from ccdtools.plants.library.quarter_car import QuarterCar, quarter_car
from ccdtools.plants.library.two_tanks import Tanks, two_tanks
from ccdtools.plants.library.wind_turbine import Turbine, wind_turbine

__all__ = [
    "Car",
    "CartPole",
    "QuarterCar",
    "Servo",
    "Tanks",
    "Turbine",
    "dc_servo",
    "full_car",
    "half_car",
    "illustrative",
    "mass_chain",
    "pendulum_on_cart",
    "quarter_car",
    "two_tanks",
    "wind_turbine",
]
