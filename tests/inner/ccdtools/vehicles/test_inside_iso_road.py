"""What test_iso_road.py claims, seen from inside."""

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid, quad
from scipy.stats import chi2

from ccdtools.vehicles import ISORoad
from ccdtools.vehicles.iso8608 import BAND
from ccdtools.vehicles.roads import STYLES, generate_speed

DT = 0.01
SPEED = 20.0


def sample(road, runs=2, steps=300, seed=0):
    return road.sample(runs, steps, np.random.default_rng(seed))


@pytest.mark.check
def test_one_wheel_feels_the_class_at_its_speed():
    w = sample(ISORoad("C", SPEED, DT), runs=400, steps=1)[:, 0, 0]

    def felt(n):
        """Spectrum of the mean velocity over a step."""
        return 256e-6 * (0.1 / n) ** 2 * (2 * np.sin(np.pi * n * SPEED * DT) / DT) ** 2

    least, most = chi2.ppf([1e-4, 1 - 1e-4], 400) / 400
    assert least < np.mean(w**2) / quad(felt, *BAND)[0] < most


@pytest.mark.parametrize("driver", STYLES)
def test_under_a_driver_the_rear_wheels_roll_over_the_same_road(driver):
    wheelbase, steps = 2.6, 800
    road = ISORoad("C", driver, DT, wheelbase=wheelbase, band=(0.011, 0.05))
    front, rear = DT * np.cumsum(sample(road, runs=1, steps=steps)[0], axis=0).T  # elevations since the start
    time, speed = generate_speed(steps * DT, rng=np.random.default_rng(0).spawn(1)[0], driver=driver, dt=DT)
    travelled = cumulative_trapezoid(speed, time)
    there = travelled > 2 * wheelbase
    expected = np.interp(travelled[there] - wheelbase, travelled, front) + np.interp(wheelbase, travelled, rear)
    np.testing.assert_allclose(rear[there], expected, rtol=0, atol=2e-3 * rear.std())


def test_heights_of_a_band_stay_bounded_on_a_long_road():
    z = sample(ISORoad("C", SPEED, DT, heights=True), runs=20, steps=12000)[:, :, 0]
    power = 256e-6 * 0.1**2 * (1 / BAND[0] - 1 / BAND[1])
    assert np.var(z, axis=1).mean() == pytest.approx(power, rel=0.15)
    assert np.abs(z).max() < 12 * np.sqrt(power)
