"""What test_library_cars.py claims, seen from inside."""

import numpy as np
import pytest
from library_oracles import matrices

from ccdtools import discretise
from ccdtools.exceptions import SamplingWarning
from ccdtools.plants.library import full_car, half_car, quarter_car
from ccdtools.vehicles.corner import RealStrut

START = np.array([27692.0, 1906.5])
AXLES = np.array([28e3, 2500.0, 21e3, 2000.0])
GRIPLESS = RealStrut(friction=0.0)


def test_the_sampling_time_of_the_paper_draws_the_known_warning():
    with pytest.warns(SamplingWarning, match=r"oscillates at 10.3 Hz at k_s = 40000 N/m, c_s = 500 N·s/m"):
        discretise(quarter_car(dt=0.05))


def test_the_real_cars_have_the_slopes_of_the_linear_ones_at_rest_but_for_the_dry_friction():
    for make in (half_car, full_car, quarter_car):
        p = AXLES if make is not quarter_car else START
        for own, other in zip(matrices(make(real=True, strut=GRIPLESS), p), matrices(make(), p)):
            np.testing.assert_allclose(own, other, rtol=3e-3, atol=1e-9)  # the rounded tyre: 0.25 % softer at rest
    damped = matrices(quarter_car(real=True), START)[0][3, 3] - matrices(quarter_car(), START)[0][3, 3]
    assert damped == pytest.approx(-40.0 / 0.02 / 325.0)
