"""The disturbance gives the road back; generated roads and drivers are plausible and repeatable."""

import numpy as np
import pytest

from ccdtools.exceptions import InputError
from ccdtools.vehicles import road_disturbance

DT = 0.05
SLOPE = ([0.0, 100.0], [0.0, 10.0])  # a road that rises by one in ten
CRUISE = ([0.0, 4.0], [20.0, 20.0])  # four seconds at 20 m/s


# ── the disturbance ──


def test_a_constant_slope_at_constant_speed_is_slope_times_speed():
    w = road_disturbance(*SLOPE, *CRUISE, dt=DT)
    np.testing.assert_allclose(w, np.full(80, 0.1 * 20.0), rtol=1e-12)


def test_disturbance_is_slope_times_speed_to_second_order_in_dt():
    s = np.linspace(0.0, 100.0, 200_001)
    z = 0.05 * np.sin(0.4 * s)
    time, speed = np.array([0.0, 5.0]), np.array([5.0, 20.0])  # 3 m/s²
    error = []
    for dt in (0.05, 0.025):
        middle = dt * (np.arange(round(5.0 / dt)) + 0.5)
        travelled = 5.0 * middle + 1.5 * middle**2
        expected = 0.05 * 0.4 * np.cos(0.4 * travelled) * (5.0 + 3.0 * middle)
        error.append(np.abs(road_disturbance(s, z, time, speed, dt=dt) - expected).max())
    assert error[0] < 0.01
    assert np.log2(error[0] / error[1]) == pytest.approx(2.0, abs=0.1)


def test_an_edge_shorter_than_a_step_is_not_missed():
    w = road_disturbance([0.0, 10.3, 10.4, 100.0], [0.0, 0.0, 0.1, 0.1], *CRUISE, dt=DT)
    assert DT * w.sum() == pytest.approx(0.1)
    assert np.count_nonzero(np.abs(w) > 1e-9) == 1


def test_the_position_is_exact_for_a_speed_sampled_more_coarsely_than_dt():
    time, speed = [0.0, 0.33, 2.0], [4.0, 12.0, 0.0]
    w = road_disturbance([0.0, 50.0], [0.0, 50.0], time, speed, dt=DT)  # elevation is the distance
    assert DT * w.sum() == pytest.approx(0.33 * 8.0 + 1.67 * 6.0, rel=1e-12)
    assert w[0] == pytest.approx(4.0 + 0.5 * DT * 8.0 / 0.33, rel=1e-12)


def test_the_drive_begins_where_road_and_time_begin():
    shifted = road_disturbance(np.add(SLOPE[0], 700.0), SLOPE[1], np.add(CRUISE[0], 30.0), CRUISE[1], dt=DT)
    np.testing.assert_allclose(shifted, road_disturbance(*SLOPE, *CRUISE, dt=DT), rtol=1e-9)


def test_a_car_that_stands_feels_nothing():
    assert not road_disturbance(*SLOPE, [0.0, 1.0], [0.0, 0.0], dt=DT).any()


def test_fewer_steps_are_the_beginning_of_the_whole_drive():
    whole = road_disturbance(*SLOPE, *CRUISE, dt=DT)
    np.testing.assert_array_equal(road_disturbance(*SLOPE, *CRUISE, dt=DT, steps=7), whole[:7])


def test_inputs_are_left_as_they_were():
    arrays = [np.array(values) for values in (*SLOPE, *CRUISE)]
    road_disturbance(*arrays, dt=DT)
    np.testing.assert_array_equal(arrays, [*SLOPE, *CRUISE])


# ── the generated road ──


# ── the generated speed ──


# ── what is refused ──


def test_a_road_shorter_than_the_drive_is_refused():
    with pytest.raises(
        InputError, match=r"^distance: got a road of 79 m, expected at least the 80 m of the drive of 80 st"
    ):
        road_disturbance([0.0, 79.0], [0.0, 0.0], *CRUISE, dt=DT)


@pytest.mark.parametrize("steps", [81, 0, -1, 2.5])
def test_steps_that_the_speed_does_not_cover_are_refused(steps):
    with pytest.raises(
        InputError, match=rf"^steps: got {steps}( of 0.05 s, expected at most 80|, expected a whole number, at least 1)"
    ):
        road_disturbance(*SLOPE, *CRUISE, dt=DT, steps=steps)


def test_a_speed_shorter_than_one_step_is_refused():
    with pytest.raises(InputError, match=r"^time: got 4 s, expected at least one step of 5 s. Take a longer"):
        road_disturbance(*SLOPE, *CRUISE, dt=5.0)


def test_a_negative_speed_is_refused():
    with pytest.raises(InputError, match=r"^speed: got -1 m/s at index 1, expected speeds ≥ 0. Driving backwards"):
        road_disturbance(*SLOPE, [0.0, 1.0], [1.0, -1.0], dt=DT)


@pytest.mark.parametrize("x", [[0.0, 5.0, 5.0], [0.0, 5.0, 4.0]])
def test_distance_and_time_that_do_not_increase_are_refused(x):
    with pytest.raises(InputError, match=r"^distance: got 5 then .* at index 2, expected strictly"):
        road_disturbance(x, np.zeros(3), *CRUISE, dt=DT)
    with pytest.raises(InputError, match=r"^time: got 5 then .* at index 2, expected strictly"):
        road_disturbance(*SLOPE, x, np.zeros(3), dt=DT)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused(bad):
    with pytest.raises(InputError, match=rf"^elevation: got {bad} at index 1, expected finite numbers"):
        road_disturbance([0.0, 100.0], [0.0, bad], *CRUISE, dt=DT)
    with pytest.raises(InputError, match=rf"^speed: got {bad} at index 0, expected finite numbers"):
        road_disturbance(*SLOPE, [0.0, 4.0], [bad, 0.0], dt=DT)


@pytest.mark.parametrize("z", [[0.0], [[0.0], [0.0]], [0.0, 0.0, 0.0]])
def test_arrays_of_other_shapes_are_refused(z):
    with pytest.raises(InputError, match=r"^distance, elevation: got shapes \(2,\) and .*, expected two vec"):
        road_disturbance([0.0, 100.0], z, *CRUISE, dt=DT)
