"""A sensor that repeats a value more often than its noise allows is named, and no other."""

import warnings

import numpy as np
import pytest

from ccdtools.twin.stuck_sensors import warn_of_stuck

NAMES = ("height", "speed")


def told(signals, sigma=(1.0, 1.0), inputs=None, **level):
    """Warnings of signals (n, T, 2)."""
    moving = np.random.default_rng(9).standard_normal((*signals.shape[:2], 1)) if inputs is None else inputs
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        warn_of_stuck("log", signals, moving, NAMES, lambda: np.array(sigma), **level)
    return [str(one.message) for one in found]


@pytest.fixture
def noise(rng):
    """Return white noise of two runs."""
    return rng.standard_normal((2, 300, 2))


def test_a_stretch_of_one_value_is_named_with_its_place(noise):
    noise[1, 100:131, 1] = noise[1, 99, 1]
    (said,) = told(noise)
    assert said.startswith("log: speed repeats ")
    assert "over 32 samples, from 99 of run 1" in said
    noise[1, 110:120:2, 1] = np.nan  # gaps hide nothing
    assert "over 27 samples, from 99 of run 1" in told(noise)[0]


def test_inputs_that_are_held_hide_no_sensor_that_is_stuck(noise):
    held = np.repeat(np.random.default_rng(9).standard_normal((2, 60, 1)), 5, axis=1)
    signals = noise[..., :1]  # so nothing changes but where an input does

    def said(signals):
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            warn_of_stuck("log", signals, held, NAMES[:1], lambda: np.ones(1))
        return [str(one.message) for one in found]

    assert not said(signals)
    signals[1, 100:200] = signals[1, 99]
    (one,) = said(signals)
    assert "over 101 samples, from 99 of run 1" in one or "over 97 samples, from 99 of run 1" in one
    signals[:, 200:] = signals[:, 199:200]  # to the end
    assert len(said(signals)) == 1


def test_runs_that_round_are_not_named_beside_runs_that_do_not(rng):
    alarms = 0
    for _ in range(20):
        signals = rng.standard_normal((20, 200, 2))
        signals[:10] = np.round(signals[:10] / 0.3) * 0.3
        alarms += len(told(signals, level=1e-3))
    assert not alarms


def test_a_rest_elsewhere_hides_no_stretch(noise):
    noise[0, 50:250] *= np.exp(-0.1 * np.arange(200))[:, None]  # in small steps, to a value that is held
    noise[0, 250:] = noise[0, 249]
    noise[1, 100:150, 1] = noise[1, 99, 1]
    assert any("from 99 of run 1" in said for said in told(noise))


def test_one_value_all_along_is_named_too(noise):
    noise[..., 0] = 0.3
    (said,) = told(noise)
    assert "height repeats 0.3 over 300 samples" in said
    assert "stuck, or coarser than its noise" in said  # which of both, one value does not tell


@pytest.mark.long
@pytest.mark.parametrize("step", [0.3, 1.0, 3.0])
def test_a_sensor_that_rounds_is_not_named_at_rest_or_in_motion_as_seldom_as_stated(rng, step):
    alarms = 0
    for motion in (0.0, 0.01):
        for _ in range(150):
            drift = np.cumsum(motion * rng.standard_normal((1, 400, 2)), axis=1)
            alarms += len(told(np.round((drift + rng.standard_normal(drift.shape)) / step) * step, level=0.05))
    assert alarms <= 2 * 300 * 0.05


def test_a_coarse_sensor_is_named_where_its_noise_would_have_changed_it(rng):
    rounded = 0.3 * np.round(rng.standard_normal((1, 2000, 2)) / 0.3)
    rounded[0, 500:560, 0] = rounded[0, 499, 0]
    assert [said.split()[1] for said in told(rounded)] == ["height"]


def test_where_nothing_moves_or_no_noise_is_stated_nothing_is_named(noise):
    still = np.zeros_like(noise)
    assert told(still, inputs=np.zeros((2, 300, 1))) == []
    noise[..., 0] = 0.3
    assert told(noise, sigma=(0.0, 1.0)) == []


def test_a_plant_without_noise_that_comes_to_rest_is_not_called_stuck():
    time = np.arange(600.0)
    assert told(np.stack([0.3 + 0.9**time, 0.1 + 0.93**time], axis=1)[None]) == []


@pytest.mark.parametrize("step", [2**-9, 2**-6, 0.0])
@pytest.mark.parametrize("push", [0.0, 1.0])
def test_one_that_a_recorder_rounds_is_not_called_stuck_either(step, push):
    time = np.arange(600.0)
    signals = np.stack([0.3 + 0.9**time, 0.1 + 0.93**time], axis=1)[None]
    signals[:, 400:] += push * (1 - 0.9 ** np.arange(1.0, 201.0))[:, None]  # after a long rest
    rounded = np.round(signals / step) * step if step else signals.astype(np.float32).astype(float)
    assert told(rounded) == []
