"""What test_library_of_plants.py claims, seen from inside."""

import pytest

from ccdtools import InputError
from ccdtools.plants import library
from ccdtools.vehicles.corner import RealStrut


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: library.QuarterCar(sprung=0), "sprung: got 0, expected a positive number"),
        (lambda: library.QuarterCar(tyre="hard"), "tyre: got 'hard', expected a positive number"),
        (lambda: library.Car(front=float("nan")), "front: got nan, expected a positive number"),
        (lambda: library.CartPole(friction=-1), "friction: got -1, expected a finite number, at least 0"),
        (lambda: library.Servo(loss=1.0), "loss: got 1.0, expected a share, from 0 to below 1"),
        (lambda: library.Tanks(clogged=2), "clogged: got 2, expected a share"),
        (lambda: RealStrut(asymmetry=1), "asymmetry: got 1, expected a share"),
        (lambda: library.quarter_car(real=1), "real: got 1, expected True or False"),
        (lambda: library.quarter_car(nonlinear="yes"), "nonlinear: got 'yes', expected True or False"),
        (lambda: library.quarter_car(car=library.Car()), "car: got a Car, expected a QuarterCar or nothing"),
        (lambda: library.quarter_car(dt=0), "dt: got 0, expected a positive number"),
        (lambda: library.half_car(strut=3), "strut: got 3, expected a RealStrut or nothing"),
        (lambda: library.full_car(road="steep"), "road: got 'steep', expected one of speed, height"),
        (lambda: library.full_car(twist_decay=-1), "twist_decay: got -1, expected a rate"),
        (lambda: library.illustrative(real=None), "real: got nothing, expected True or False"),
        (lambda: library.pendulum_on_cart(linear=True, real=True), "linear: got True, expected False where real=True"),
        (lambda: library.pendulum_on_cart(cart=1.0), "cart: got 1.0, expected a CartPole or nothing"),
        (lambda: library.dc_servo(servo={}), "servo: got {}, expected a Servo or nothing"),
        (lambda: library.mass_chain(0), "n: got 0, expected a whole number, at least 1"),
        (lambda: library.mass_chain(3, mass=-1), "mass: got -1, expected a positive number"),
        (lambda: library.mass_chain(3, walls=3), "walls: got 3, expected 1 or 2"),
        (
            lambda: library.mass_chain(3, driven=(4,)),
            r"driven: got \[4\], expected different whole numbers from 1 to 3",
        ),
        (lambda: library.mass_chain(3, driven=(1, 1)), r"driven: got \[1, 1\], expected different whole numbers"),
        (lambda: library.mass_chain(3, disturbed="1"), "disturbed: got '1', expected different whole numbers"),
        (lambda: library.wind_turbine(turbine=2), "turbine: got 2, expected a Turbine or nothing"),
        (lambda: library.wind_turbine(turbine=library.Turbine(wind=5.0)), "turbine: got .* in wind of 5 m/s"),
        (lambda: library.two_tanks(linear=True, absolute=True), "linear: got True, expected False where absolute=True"),
        (lambda: library.two_tanks(tanks=0), "tanks: got 0, expected a Tanks or nothing"),
    ],
)
def test_parameters_that_make_no_sense_are_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()
