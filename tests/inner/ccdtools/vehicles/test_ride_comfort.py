"""The weights are those of ISO 2631-1's table, and a sampled acceleration gets them at every rate it is sampled at."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.signal import StateSpace, lsim, zpk2ss

import ccdtools as cc
from ccdtools.exceptions import InputError
from ccdtools.vehicles import comfort, weighted_acceleration
from ccdtools.vehicles.ride_comfort import frequency_weighting

# ISO 2631-1:1997, table 3: factors times 1000 at the nominal third octaves.
THIRD_OCTAVES = [
    0.1, 0.125, 0.16, 0.2, 0.25, 0.315, 0.4, 0.5, 0.63, 0.8, 1, 1.25, 1.6, 2, 2.5, 3.15, 4, 5, 6.3, 8, 10, 12.5, 16,
    20, 25, 31.5, 40, 50, 63, 80, 100, 125, 160, 200, 250, 315, 400,
]  # fmt: skip
WK = [
    31.2, 48.6, 79.0, 121, 182, 263, 352, 418, 459, 477, 482, 484, 494, 531, 631, 804, 967, 1039, 1054, 1036, 988, 902,
    768, 636, 513, 405, 314, 246, 186, 132, 88.7, 54.0, 28.5, 15.2, 7.90, 3.98, 1.95,
]  # fmt: skip
WD = [
    62.4, 97.3, 158, 243, 365, 530, 713, 853, 944, 992, 1011, 1008, 968, 890, 776, 642, 512, 409, 323, 253, 202, 161,
    125, 100, 80.0, 63.2, 49.4, 38.8, 29.5, 21.1, 14.1, 8.63, 4.55, 2.43, 1.26, 0.64, 0.31,
]  # fmt: skip  # 202 at 10 Hz: printed as 212, but beside it −13.9 dB


def sine(frequency, dt, seconds=40.0):
    return np.sin(2 * np.pi * frequency * dt * np.arange(round(seconds / dt)) + 0.3)


def noise(runs, samples, seed=0):
    return np.random.default_rng(seed).standard_normal((runs, samples))


# ── the weights ──


@pytest.mark.parametrize(("weighting", "table"), [("Wk", WK), ("Wd", WD)])
def test_the_weights_are_those_of_the_standard_at_every_third_octave(weighting, table):
    weights = 1e3 * np.abs(frequency_weighting(THIRD_OCTAVES, weighting))
    last_digit = [0.1 if v < 100 else 1.0 for v in table]
    last_digit = np.where(np.array(table) < 10, 0.01, last_digit)
    assert (np.abs(weights - table) <= 0.75 * last_digit).all()


def test_constant_and_very_fast_accelerations_are_not_felt():
    for weighting in ("Wk", "Wd"):
        assert frequency_weighting(0.0, weighting) == 0.0
        assert abs(frequency_weighting(1e4, weighting)) < 1e-6


# ── sampled accelerations ──


@pytest.mark.parametrize("dt", [0.05, 0.02, 0.005])
def test_a_sine_gets_its_weight_and_phase_at_every_sampling_rate(dt):
    for frequency in (0.5, 1, 2, 4, 6.3, 8, 16, 31.5, 80):
        if frequency > 0.8 * 0.5 / dt:
            continue
        steady = slice(round(10 / dt), -round(5 / dt))
        weighted = weighted_acceleration(sine(frequency, dt), dt)[steady]
        phase = 2 * np.pi * frequency * dt * np.arange(round(40 / dt)) + 0.3
        expected = np.imag(frequency_weighting(frequency) * np.exp(1j * phase))[steady]
        np.testing.assert_allclose(weighted, expected, atol=5e-3)  # its ends ring


@pytest.mark.parametrize("weighting", ["Wk", "Wd"])
def test_a_fast_record_is_weighted_as_by_the_analogue_filter(weighting):
    dt = 5e-4
    time = dt * np.arange(12_000)
    acceleration = sum(np.sin(2 * np.pi * f * time + f) for f in (0.7, 3.1, 7.7, 23.0)) * np.minimum(time, 1.0)
    _, filtered, _ = lsim(analogue(weighting), acceleration, time)
    weighted = weighted_acceleration(acceleration, dt, weighting=weighting)
    np.testing.assert_allclose(weighted, filtered, atol=2e-3 * filtered.std())


def analogue(weighting):
    """The weighting by its poles and zeros [rad/s], scaled at 1 Hz."""
    f3, Q4, step = {"Wk": (12.5, 0.63, (2.37, 3.35)), "Wd": (2.0, 0.63, ())}[weighting]

    def roots(f, Q):
        return 2 * np.pi * f * np.roots([1, 1 / Q, 1])

    zeros = [0, 0, -2 * np.pi * f3, *(roots(step[0], 0.91) if step else ())]
    poles = [*roots(0.4, 0.5**0.5), *roots(100, 0.5**0.5), *roots(f3, Q4), *(roots(step[1], 0.91) if step else ())]
    s = 2j * np.pi
    gain = np.abs(np.prod(s - np.array(poles)) / np.prod(s - np.array(zeros)))
    return StateSpace(*zpk2ss(zeros, poles, gain * abs(frequency_weighting(1.0, weighting))))


def test_comfort_of_white_noise_is_the_power_under_the_weights():
    dt = 0.01
    power = 2 * dt * quad(lambda f: abs(frequency_weighting(f)) ** 2, 0, 0.5 / dt, limit=200)[0]
    assert np.mean(comfort(noise(40, 6000), dt) ** 2) == pytest.approx(power, rel=0.02)


def test_comfort_is_one_number_a_record_and_grows_with_it():
    records = noise(6, 500).reshape(2, 3, 500)
    values = comfort(records, 0.01)
    assert values.shape == (2, 3)
    np.testing.assert_allclose(comfort(-3 * records, 0.01), 3 * values)
    assert comfort(records[0, 0], 0.01) == pytest.approx(values[0, 0])


def test_a_vertical_shake_of_five_hertz_is_felt_more_than_a_horizontal_one():
    shake = sine(5.0, 0.01)
    assert comfort(shake, 0.01) > 2 * comfort(shake, 0.01, weighting="Wd")


def test_the_record_is_left_as_it_was():
    record = noise(1, 50)
    before = record.copy()
    weighted_acceleration(record, 0.05)
    np.testing.assert_array_equal(record, before)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: frequency_weighting(1.0, "Wz"), "weighting: got 'Wz', expected one of Wk, Wd"),
        (lambda: frequency_weighting("low"), "frequency: got 'low', expected an array of real numbers"),
        (lambda: cc.weighted_acceleration([], 0.1), r"acceleration: got shape \(0,\), expected samples"),
        (lambda: cc.weighted_acceleration(1.0, 0.1), r"acceleration: got shape \(\), expected samples"),
        (lambda: cc.comfort([1.0, np.nan], 0.1), "acceleration: got (nan|-?inf) at index"),
        (lambda: cc.comfort([1.0, 2.0], 0.0), r"dt: got 0.0, expected a positive number \[s\]"),
        (lambda: cc.comfort([1.0, 2.0], 0.1, weighting="k"), "weighting: got 'k', expected one of Wk, Wd"),
    ],
)
def test_wrong_calls_name_the_argument(call, message):
    with pytest.raises(InputError, match=f"^{message}"):
        call()
