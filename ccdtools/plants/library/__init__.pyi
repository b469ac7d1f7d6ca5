from ccdtools.plants.library.dc_servo import Servo as Servo, dc_servo as dc_servo
from ccdtools.plants.library.illustrative import illustrative as illustrative
from ccdtools.plants.library.mass_chain import mass_chain as mass_chain
from ccdtools.plants.library.pendulum_on_cart import CartPole as CartPole, pendulum_on_cart as pendulum_on_cart
from ccdtools.plants.library.two_tanks import Tanks as Tanks, two_tanks as two_tanks
from ccdtools.plants.library.wind_turbine import Turbine as Turbine, wind_turbine as wind_turbine
from ccdtools.vehicles.car import Car as Car, full_car as full_car, half_car as half_car
from ccdtools.vehicles.quarter_car import QuarterCar as QuarterCar, quarter_car as quarter_car
