"""What test_roads.py claims, seen from inside."""

import numpy as np
import pytest
from scipy.integrate import trapezoid

from ccdtools.exceptions import InputError
from ccdtools.vehicles import road_disturbance
from ccdtools.vehicles.roads import OBSTACLES, STYLES, generate_road, generate_speed

DT = 0.05
SLOPE = ([0.0, 100.0], [0.0, 10.0])  # a road that rises by one in ten
CRUISE = ([0.0, 4.0], [20.0, 20.0])  # four seconds at 20 m/s


def drive(seed: int, driver: str = "mild", duration: float = 450.0):
    """Road, speed and disturbance of one generated drive."""
    rng = np.random.default_rng(seed)
    time, speed = generate_speed(duration, rng=rng, driver=driver)
    distance, elevation = generate_road(trapezoid(speed, time), rng=rng)
    return distance, elevation, time, speed, road_disturbance(distance, elevation, time, speed, dt=DT)


@pytest.mark.parametrize("driver", STYLES)
def test_integrating_the_disturbance_gives_back_the_elevation_along_the_drive(driver):
    distance, elevation, time, speed, w = drive(0, driver)
    travelled = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(time))])
    np.testing.assert_allclose(
        DT * np.cumsum(w), np.interp(travelled[1:], distance, elevation) - elevation[0], atol=1e-9
    )


def test_the_same_seed_gives_the_same_drive_and_another_seed_another():
    first, again, other = drive(1, duration=30.0), drive(1, duration=30.0), drive(2, duration=30.0)
    for one, two in zip(first, again):
        np.testing.assert_array_equal(one, two)
    assert not np.array_equal(first[-1], other[-1])


@pytest.mark.parametrize("length", [0.01, 1.0, 99.97, 1000.0])
def test_a_road_covers_its_length_in_equal_steps_from_the_origin(length):
    distance, elevation = generate_road(length, rng=np.random.default_rng(0))
    assert distance.shape == elevation.shape
    assert length <= distance[-1] + 1e-9 < length + 0.05 + 1e-9
    np.testing.assert_allclose(np.diff(distance), 0.05)
    assert distance[0] == elevation[0] == 0.0


def test_every_slope_is_finite_and_no_obstacle_is_steeper_than_a_jump():
    slopes = []
    for seed in range(5):
        distance, elevation = generate_road(5000.0, rng=np.random.default_rng(seed))
        slopes.append(np.abs(np.diff(elevation) / np.diff(distance)).max())
    steepest = OBSTACLES["jump"][1][1] / 0.4
    assert max(slopes) < steepest + 6 * 0.0318  # six standard deviations of the noise on top


def test_every_kind_of_obstacle_reaches_its_height_between_level_ends():
    for (shortest, _), _, _, profile in OBSTACLES.values():
        x = np.linspace(0.0, shortest, 1001)
        share = profile(x, shortest)
        assert share[0] == pytest.approx(0.0, abs=1e-12)
        assert share[-1] == pytest.approx(0.0, abs=1e-12)
        assert share.max() == pytest.approx(1.0, abs=1e-5)


def test_noise_has_the_spectrum_of_iso_8608_class_c(monkeypatch):
    monkeypatch.setattr("ccdtools.vehicles.roads.generate_obstacles", lambda distance, rng: 0.0)
    periods, spacing = 200, 0.05
    _, elevation = generate_road(periods * 100.0, rng=np.random.default_rng(0), spacing=spacing)
    blocks = elevation[: periods * 2000].reshape(periods, 2000)
    window = np.hanning(2000)
    power = np.abs(np.fft.rfft(blocks * window)) ** 2 * 2 * spacing / (window**2).sum()
    frequency = np.fft.rfftfreq(2000, spacing)  # [1/m]
    band = (frequency > 0.08) & (frequency < 1.0)
    roughness = (power.mean(axis=0) * (frequency / 0.1) ** 2)[band].mean()
    assert roughness == pytest.approx(256e-6, rel=0.05)


def test_a_mild_drive_is_as_rough_as_the_recorded_one():
    for seed in range(8):
        w = drive(seed)[-1]
        assert 0.2 <= w.std() <= 0.35
        assert 2.0 <= np.abs(w).max() <= 3.5
        assert 0.2 <= np.corrcoef(w[1:], w[:-1])[0, 1] <= 0.5  # recorded: 0.34
        assert abs(np.corrcoef(w[10:], w[:-10])[0, 1]) <= 0.15  # recorded: 0.07


def test_an_aggressive_drive_is_clearly_rougher_than_a_mild_one():
    for seed in range(8):
        assert drive(seed, "aggressive")[-1].std() > 1.2 * drive(seed)[-1].std()


@pytest.mark.parametrize("driver", STYLES)
def test_a_driver_keeps_to_the_speeds_and_the_acceleration_of_the_style(driver):
    (slowest, fastest), _, acceleration = STYLES[driver]
    for seed in range(5):
        time, speed = generate_speed(300.0, rng=np.random.default_rng(seed), driver=driver)
        assert slowest <= speed.min()
        assert speed.max() <= fastest
        assert np.abs(np.diff(speed) / np.diff(time)).max() <= acceleration + 1e-9


@pytest.mark.parametrize("duration", [0.02, 5.0, 7.77, 750.0])
def test_a_drive_covers_its_duration_in_equal_steps(duration):
    time, speed = generate_speed(duration, rng=np.random.default_rng(0))
    assert time.shape == speed.shape
    assert time[0] == 0.0
    assert duration <= time[-1] + 1e-9 < duration + DT + 1e-9


def test_a_generated_drive_of_15000_steps_yields_15000_values():
    assert drive(0, duration=15_000 * DT)[-1].shape == (15_000,)


def test_an_unknown_driver_is_refused():
    with pytest.raises(InputError, match=r"^driver: got 'sleepy', expected one of mild, aggressive.$"):
        generate_speed(5.0, rng=np.random.default_rng(0), driver="sleepy")


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_lengths_durations_and_steps_must_be_positive_numbers(bad):
    rng = np.random.default_rng(0)
    for name, call in {
        "length": lambda: generate_road(bad, rng=rng),
        "spacing": lambda: generate_road(1.0, rng=rng, spacing=bad),
        "duration": lambda: generate_speed(bad, rng=rng),
        "dt": lambda: road_disturbance(*SLOPE, *CRUISE, dt=bad),
    }.items():
        with pytest.raises(InputError, match=rf"^{name}: got {bad}, expected a positive number"):
            call()
