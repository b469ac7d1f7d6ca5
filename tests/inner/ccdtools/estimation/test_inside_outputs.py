"""Slopes of an output that is a function of arrays, by central differences."""

import numpy as np
import pytest

from ccdtools.estimation.outputs import output_at

NOTHING = np.zeros(0)


def error_of_slope(h, slope, x, spread):
    """Largest error of the slopes of h(x), relative to the largest slope."""
    found = output_at(h, 1, 0, NOTHING).slope(x[:, None], np.zeros((len(x), 0)), np.full((len(x), 1), spread))
    return np.abs(found[:, 0, 0] - slope(x)).max() / np.abs(slope(x)).max()


@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_slopes_over_the_spread_of_a_state_are_exact_to_ten_digits(unit):
    x = unit * np.linspace(-1, 1, 401)
    assert error_of_slope(lambda x: np.exp(x / unit), lambda x: np.exp(x / unit) / unit, x, unit) < 1.5e-10


def test_slopes_over_a_spread_near_the_last_digits_of_a_state_are_neither_rounding_nor_blunt():
    """A state of about one, known to a billionth: five digits of a straight output, one per cent of a steep one."""
    x = np.linspace(1, 1.9, 401)
    assert error_of_slope(lambda x: x, np.ones_like, x, 1e-9) < 1e-9
    assert error_of_slope(lambda x: 3 * np.sin(x), lambda x: 3 * np.cos(x), x, 1e-9) < 2e-5
    near = 1 + 1e-9 * np.linspace(-1, 1, 41)
    steep = (lambda x: np.tanh((x - 1) / 1e-9), lambda x: 1e9 / np.cosh((x - 1) / 1e-9) ** 2)
    assert error_of_slope(*steep, near, 1e-9) < 0.01
