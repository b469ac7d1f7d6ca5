"""What test_library_turbine_and_tanks.py claims, seen from inside."""

import casadi as ca
import numpy as np
import pytest
from library_oracles import rates
from scipy.optimize import minimize_scalar

from ccdtools.plants.library import Tanks, Turbine, two_tanks
from ccdtools.plants.library.two_tanks import operating_point
from ccdtools.plants.library.wind_turbine import operating_pitch, power_coefficient

TORRICELLI = np.sqrt(2 * 981.0)


def test_the_power_coefficient_is_largest_where_its_source_says_and_below_the_limit_of_betz():
    best = minimize_scalar(lambda ratio: -float(power_coefficient(ca.SX(ratio), ca.SX(0.0))), bounds=(4, 12),
                           method="bounded")  # fmt: skip
    assert best.x == pytest.approx(8.1, abs=0.01)
    assert -best.fun == pytest.approx(0.48, abs=1e-3)
    assert -best.fun < 16 / 27


@pytest.mark.parametrize(("ratio", "pitch"), [(6.0, 0.0), (5.0, 2.0), (4.0, 15.0), (8.0, 10.0)])
def test_the_power_coefficient_is_that_of_its_source(ratio, pitch):
    between = 1 / (1 / (ratio + 0.08 * pitch) - 0.035 / (1 + pitch * pitch * pitch))
    expected = 0.5176 * (116 / between - 0.4 * pitch - 5) / np.exp(21 / between) + 0.0068 * ratio
    assert float(power_coefficient(ca.SX(ratio), ca.SX(pitch))) == pytest.approx(expected, rel=1e-12)


def test_the_rotor_takes_its_power_at_the_operating_point():
    turbine = Turbine()
    share = float(power_coefficient(ca.SX(turbine.speed * 63.0 / 16.0), ca.SX(operating_pitch(turbine))))
    assert share * 1.225 / 2 * np.pi * 63.0**2 * 16.0**3 == pytest.approx(5e6 / 0.944, rel=1e-10)


def test_the_operating_point_is_a_steady_state_of_torricelli():
    for p in two_tanks().design.spread():
        (upper, lower), voltage = (np.asarray(ca.DM(value)).ravel() for value in operating_point(Tanks(), ca.SX(p)))
        assert lower == 10.0
        flow = 3.33 * voltage[0]
        assert flow == pytest.approx(p[2] * TORRICELLI * np.sqrt(upper), rel=1e-4)
        assert flow == pytest.approx(0.071 * TORRICELLI * np.sqrt(lower), rel=1e-4)
        level = rates(two_tanks(absolute=True), p, [upper, lower], voltage)
        np.testing.assert_allclose(level, 0.0, atol=1e-14)


def test_deviations_are_levels_about_the_operating_point(rng):
    p = [30.0, 25.0, 0.08]
    (upper, lower), voltage = (np.asarray(ca.DM(value)).ravel() for value in operating_point(Tanks(), ca.SX(p)))
    for real in (False, True):
        x, u, w = rng.standard_normal(2), rng.standard_normal(1), rng.standard_normal(2)
        shifted = rates(two_tanks(absolute=True, real=real), p, x + np.array([upper, lower]), u + voltage, w)
        np.testing.assert_allclose(rates(two_tanks(real=real), p, x, u, w), shifted, rtol=1e-12)
