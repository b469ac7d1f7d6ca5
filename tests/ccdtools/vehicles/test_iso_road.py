"""What the wheels of a car feel on a road of a class: the right power, the rear wheels what the front ones felt."""

from dataclasses import replace

import numpy as np
import pytest

from ccdtools.exceptions import InputError
from ccdtools.vehicles import ISORoad

DT = 0.01
SPEED = 20.0
CAR = ISORoad("C", SPEED, DT, track=1.5, wheelbase=2.6)


def sample(road, runs=2, steps=300, seed=0):
    return road.sample(runs, steps, np.random.default_rng(seed))


@pytest.mark.parametrize(
    ("layout", "wheels"),
    [
        ({}, ("wheel",)),
        ({"track": 1.5}, ("left", "right")),
        ({"wheelbase": 2.6}, ("front", "rear")),
        ({"track": 1.5, "wheelbase": 2.6}, ("front left", "front right", "rear left", "rear right")),
    ],
)
def test_the_channels_are_the_wheels(layout, wheels):
    road = ISORoad("C", SPEED, DT, **layout)
    assert road.wheels == wheels
    assert road.nw == len(wheels)
    assert sample(road).shape == (2, 300, len(wheels))


def test_rear_wheels_feel_what_the_front_ones_felt_a_wheelbase_ago():
    w = sample(CAR)
    late = round(2.6 / (SPEED * DT))
    np.testing.assert_allclose(w[:, late:, 2:], w[:, :-late, :2], rtol=0, atol=1e-10)


def test_a_delay_of_half_a_step_lies_between_two_steps():
    road = ISORoad("C", SPEED, DT, wheelbase=2.7, band=(0.011, 0.05))  # waves far longer than a step
    w = sample(road)
    between = 0.5 * (w[:, :-14, 0] + w[:, 1:-13, 0])
    np.testing.assert_allclose(w[:, 14:, 1], between, rtol=0, atol=3e-3 * w.std())


def test_heights_are_those_of_the_road_half_way_through_each_step_since_the_start():
    band = (0.011, 0.05)  # waves far longer than a step
    road = ISORoad("C", SPEED, DT, wheelbase=2.6, band=band)
    z = sample(replace(road, heights=True))
    rates = sample(road)
    np.testing.assert_allclose(np.diff(z, axis=1) / DT, 0.5 * (rates[:, 1:] + rates[:, :-1]), rtol=0, atol=1e-10)
    np.testing.assert_allclose(z[:, 0], 0.5 * DT * rates[:, 0], rtol=0, atol=1e-12)


def test_left_and_right_differ_but_not_entirely():
    w = sample(CAR, runs=20)
    left, right = w[:, :, 0].ravel(), w[:, :, 1].ravel()
    elevation = np.cumsum(w, axis=1)
    assert not np.array_equal(left, right)
    assert np.corrcoef(elevation[:, :, 0].ravel(), elevation[:, :, 1].ravel())[0, 1] > 0.5


def test_a_run_does_not_depend_on_how_many_there_are():
    many = sample(CAR, runs=5)
    np.testing.assert_array_equal(sample(CAR, runs=2), many[:2])
    np.testing.assert_array_equal(sample(CAR, runs=5), many)
    assert not np.allclose(many[0], many[1])
    assert not np.allclose(sample(CAR, seed=1), sample(CAR))


def test_obstacles_are_added_to_the_same_road_in_both_tracks():
    bare = ISORoad("A", SPEED, DT, track=1.5)
    added = sample(replace(bare, obstacles=True), steps=1000) - sample(bare, steps=1000)
    np.testing.assert_allclose(added[:, :, 0], added[:, :, 1], atol=1e-10)
    assert np.abs(added).max() > 0.3


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"road_class": "Z"}, "road_class: got 'Z', expected one of A, B"),
        ({"speed": "sleepy"}, "speed: got 'sleepy', expected one of mild, aggressive"),
        ({"speed": 0.0}, r"speed: got 0.0, expected a positive number \[m/s\]"),
        ({"speed": None}, "speed: got nothing, expected a positive number"),
        ({"dt": -1.0}, "dt: got -1.0, expected a positive number"),
        ({"track": 0.0}, "track: got 0.0, expected a positive number"),
        ({"wheelbase": np.inf}, "wheelbase: got inf, expected a positive number"),
        ({"obstacles": 1}, "obstacles: got 1, expected True or False"),
        ({"band": (0.0, 1.0)}, "band: got 0 to 1, expected 0 < lowest < highest"),
        ({"spacing": 0.5}, "spacing: got 0.5 m, expected at most 0.0883 m"),
    ],
)
def test_a_wrong_road_is_refused_when_it_is_made(wrong, message):
    with pytest.raises(InputError, match=f"^{message}"):
        ISORoad(**wrong)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [((0, 5), "runs: got 0, expected a whole"), ((1, 0), "steps: got 0, expected a whole"), ((1, 5), "rng: got 7")],
)
def test_a_wrong_draw_is_refused(wrong, message):
    with pytest.raises(InputError, match=f"^{message}"):
        CAR.sample(*wrong, 7)
