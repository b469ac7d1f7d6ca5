"""Plants that are ready to use: each a function that returns a `Plant`, nominal or as a real one is (`real=True`)."""

from ccdtools.plants.library.car import Car
from ccdtools.plants.library.full_car import full_car
from ccdtools.plants.library.half_car import half_car
from ccdtools.plants.library.quarter_car import QuarterCar, quarter_car

__all__ = ["Car", "QuarterCar", "full_car", "half_car", "quarter_car"]
