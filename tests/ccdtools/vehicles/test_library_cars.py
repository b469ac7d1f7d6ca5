"""Quarter, half and full car: frequencies, energy, symmetry, and each as a part of the next."""

import numpy as np
import pytest
from library_oracles import frequencies, matrices, motion, oscillations, rates, springs

from ccdtools.plants.library import Car, QuarterCar, full_car, half_car, quarter_car

START = np.array([27692.0, 1906.5])
AXLES = np.array([28e3, 2500.0, 21e3, 2000.0])
UNDAMPED = np.array([28e3, 0.0, 21e3, 0.0])
HZ = 2 * np.pi


# ── quarter car ──


def test_the_quarter_car_has_the_natural_frequencies_of_its_masses_and_springs():
    M = np.diag([325.0, 65.0])
    K = springs((27692.0, [1, -1]), (232.5e3, [0, 1]))
    own = oscillations(matrices(quarter_car(), [27692.0, 0.0])[0], 2)
    np.testing.assert_allclose(own, frequencies(M, K), rtol=1e-12)


def test_body_bounce_and_wheel_hop_are_where_textbooks_have_them():
    bounce, hop = oscillations(matrices(quarter_car(), START)[0], 2) / HZ
    assert 1.0 < bounce < 1.5
    assert 9.0 < hop < 11.0


@pytest.mark.check
def test_the_nonlinear_quarter_car_without_damper_keeps_its_energy():
    def energy(x):
        tyre, wheel, travel, body = x
        spring = 27692.0 * (travel**2 / 2 + 20.0 * travel**4 / 4)
        return 325.0 * body**2 / 2 + 65.0 * wheel**2 / 2 + 232.5e3 * tyre**2 / 2 + spring

    path = motion(quarter_car(nonlinear=True), [27692.0, 0.0], [0.02, 0.5, -0.15, 1.0], np.linspace(0, 3, 50))
    assert np.ptp(path[2]) > 0.2  # far enough for the spring to harden
    np.testing.assert_allclose(energy(path), energy(path[:, 0]), rtol=1e-8)


def test_the_nonlinear_quarter_car_has_the_slopes_of_the_linear_one_at_rest():
    for own, other in zip(matrices(quarter_car(nonlinear=True), START), matrices(quarter_car(), START)):
        np.testing.assert_allclose(own, other, rtol=1e-12, atol=1e-12)


def test_the_damper_is_stiffer_in_rebound_than_in_bump_and_only_takes_energy():
    plant = quarter_car(nonlinear=True)
    forces = {rate: -325.0 * rates(plant, [0.0, 1000.0], [0, 0, 0, rate])[3] for rate in (-2.0, -0.01, 0.01, 2.0)}
    assert forces[2.0] == pytest.approx(1000 * (2.0 + 0.3 * (2.0025 - 0.1)), rel=1e-3)
    assert forces[-2.0] == pytest.approx(-1000 * (2.0 - 0.3 * (2.0025 - 0.1)), rel=1e-3)
    assert all(force * rate > 0 for rate, force in forces.items())


def test_the_real_tyre_cannot_pull_and_is_linear_while_it_is_loaded():
    plant = quarter_car(real=True)
    load = 9.81 * (325.0 + 65.0)
    lifted = 65.0 * rates(plant, START, [0.2, 0, 0, 0])[1]
    assert lifted == pytest.approx(-load, rel=3e-3)
    pressed = 65.0 * rates(plant, START, [-0.05, 0, 0, 0])[1]
    assert pressed == pytest.approx(0.05 * 232.5e3, rel=3e-3)


def test_the_real_actuator_has_a_largest_force_and_the_real_strut_dry_friction():
    plant = quarter_car(real=True)
    assert 325.0 * rates(plant, START, np.zeros(4), u=[1e5])[3] == pytest.approx(2500.0)
    assert 325.0 * rates(plant, START, np.zeros(4), u=[10.0])[3] == pytest.approx(10.0, rel=1e-4)
    friction = rates(plant, [0.0, 0.0], [0, 0, 0, 0.5])[3]
    assert -325.0 * friction == pytest.approx(40.0)


@pytest.mark.parametrize("real", [False, True])
def test_the_active_force_follows_with_its_lag_and_reaches_what_is_asked_for(real):
    plant = quarter_car(actuator_lag=True, real=real)
    assert rates(plant, START, np.zeros(5), u=[6.0])[4] == pytest.approx(360.0, rel=1e-4)
    held = [0.01, 0.2, -0.03, 0.1]
    largest = 2500.0 if real else 1e5
    assert rates(plant, START, [0, 0, 0, 0, 100.0], u=[1e5])[4] == pytest.approx(60 * (largest - 100.0))
    with_force = rates(plant, START, [*held, 70.0], u=[70.0])
    without_lag = rates(quarter_car(real=real), START, held, u=[70.0])
    np.testing.assert_allclose(with_force[:4], without_lag, rtol=1e-3)
    poles = np.linalg.eigvals(matrices(quarter_car(actuator_lag=True), START)[0])
    assert np.abs(poles + 60.0).min() < 1e-9


# ── half car ──


def half_car_modes():
    """Frequencies of heave, pitch, front and rear wheel, with masses and springs written down again."""
    M = np.diag([600.0, 1050.0, 50.0, 50.0])
    K = springs((28e3, [1, 0.9, -1, 0]), (21e3, [1, -1.2, 0, -1]), (2e5, [0, 0, 1, 0]), (2e5, [0, 0, 0, 1]))
    return frequencies(M, K)


def test_the_half_car_has_the_natural_frequencies_of_its_masses_and_springs():
    own = oscillations(matrices(half_car(), UNDAMPED)[0], 4)
    np.testing.assert_allclose(own, half_car_modes(), rtol=1e-12)
    assert ((own[:2] / HZ > 0.9) & (own[:2] / HZ < 1.6)).all()
    assert ((own[2:] / HZ > 9) & (own[2:] / HZ < 12)).all()


@pytest.mark.check
def test_the_half_car_without_dampers_keeps_its_energy():
    def energy(x):
        springs_ = 28e3 * x[2] ** 2 + 21e3 * x[3] ** 2 + 2e5 * (x[0] ** 2 + x[1] ** 2)
        return (springs_ + 50 * (x[4] ** 2 + x[5] ** 2) + 600 * x[6] ** 2 + 1050 * x[7] ** 2) / 2

    x0 = [0.01, -0.01, 0.05, -0.02, 0.3, 0.1, 0.2, -0.1]
    path = motion(half_car(), UNDAMPED, x0, np.linspace(0, 3, 40))
    np.testing.assert_allclose(energy(path), energy(path[:, 0]), rtol=1e-8)


def test_a_step_up_of_the_front_road_lifts_the_nose(rng):
    plant = half_car()
    path = motion(plant, AXLES, np.zeros(8), [0.0, 0.1], w=lambda t: np.array([1.0, 0.0]))
    assert path[7, -1] > 0
    assert path[6, -1] > 0


@pytest.mark.parametrize("real", [False, True])
def test_a_half_car_whose_axles_do_not_feel_each_other_is_two_quarter_cars(real, rng):
    """The inertia m a b puts each axle at the other's centre of percussion."""
    car = Car(pitch_inertia=1200.0 * 0.9 * 1.2)
    half = half_car(real=real, car=car)
    x, u, w = 0.1 * rng.standard_normal(8), 500 * rng.standard_normal(2), rng.standard_normal(2)
    got = rates(half, AXLES, x, u, w)
    for i, arm, sprung in ((0, 0.9, 600 * 1.2 / 2.1), (1, -1.2, 600 * 0.9 / 2.1)):
        quarter = quarter_car(real=real, car=QuarterCar(sprung=sprung, unsprung=50.0, tyre=2e5))
        state = [x[i], x[4 + i], x[2 + i], x[6] + arm * x[7]]
        expected = rates(quarter, AXLES[2 * i : 2 * i + 2], state, [u[i]], [w[i]])
        corner = [got[i], got[4 + i], got[2 + i], got[6] + arm * got[7]]
        np.testing.assert_allclose(corner, expected, rtol=1e-10, atol=1e-10)


# ── full car ──


def full_car_modes():
    """Frequencies of the seven degrees of freedom, with masses and springs written down again."""
    M = np.diag([1200.0, 2100.0, 1500.0, 50.0, 50.0, 50.0, 50.0])
    terms = []
    for i, (k, along, across) in enumerate(
        ((28e3, 0.9, 0.9), (28e3, 0.9, -0.9), (21e3, -1.2, 0.9), (21e3, -1.2, -0.9))
    ):
        wheel = np.eye(4)[i]
        terms += [(k, [1, along, across, *-wheel]), (2e5, [0, 0, 0, *wheel])]
    return frequencies(M, springs(*terms))


@pytest.mark.parametrize("road", ["speed", "height"])
def test_the_full_car_has_the_natural_frequencies_of_its_masses_and_springs(road):
    A = matrices(full_car(road=road, twist_decay=0.0), UNDAMPED)[0]
    np.testing.assert_allclose(oscillations(A, 7), full_car_modes(), rtol=1e-10)


def test_the_fifteenth_state_forgets_the_twist_of_the_road_at_the_rate_it_is_told():
    poles = np.linalg.eigvals(matrices(full_car(twist_decay=0.7), AXLES)[0])
    assert np.abs(poles + 0.7).min() < 1e-9
    assert poles.real.max() < 0
    others = np.sort_complex(np.delete(poles, np.abs(poles + 0.7).argmin()))
    np.testing.assert_allclose(
        others, np.sort_complex(np.linalg.eigvals(matrices(full_car(road="height"), AXLES)[0])), rtol=1e-8
    )


@pytest.mark.check
def test_roads_given_by_speeds_and_by_heights_move_the_same_car():
    pace, size = np.array([7.0, 9.0, 5.0, 8.0]), np.array([0.03, -0.02, 0.025, 0.01])
    height = lambda t: size * np.sin(pace * t) ** 2  # noqa: E731
    speed = lambda t: size * pace * np.sin(2 * pace * t)  # noqa: E731
    times = np.linspace(0, 1.5, 20)
    by_height = motion(full_car(road="height"), AXLES, np.zeros(14), times, w=height)
    by_speed = motion(full_car(twist_decay=0.0), AXLES, np.zeros(15), times, w=speed)
    np.testing.assert_allclose(by_speed[8:], by_height[7:], atol=1e-8)
    heights = np.stack([height(t) for t in times], axis=1)
    np.testing.assert_allclose(by_speed[:4], by_height[:4] - heights, atol=1e-9)
    corner = by_height[4] + 0.9 * by_height[5] + 0.9 * by_height[6]
    np.testing.assert_allclose(by_speed[4], corner - by_height[0], atol=1e-9)


def mirrored(x):
    """The state of a full car in a mirror: left and right swapped, roll reversed."""
    swapped = x.copy()
    for first in (0, 4, 8):
        swapped[first : first + 4] = x[[first + 1, first, first + 3, first + 2]]
    swapped[14] = -x[14]
    return swapped


@pytest.mark.parametrize("real", [False, True])
def test_left_and_right_of_the_full_car_are_alike(real, rng):
    plant = full_car(real=real)
    x, u, w = 0.1 * rng.standard_normal(15), 300 * rng.standard_normal(4), rng.standard_normal(4)
    swap = [1, 0, 3, 2]
    np.testing.assert_allclose(
        rates(plant, AXLES, mirrored(x), u[swap], w[swap]), mirrored(rates(plant, AXLES, x, u, w)), rtol=1e-12
    )


def test_roll_is_decoupled_from_heave_and_pitch(rng):
    A, B, E = matrices(full_car(), AXLES)
    odd = rng.standard_normal(15)
    odd = odd - mirrored(odd)
    assert np.abs((A @ odd)[12:14]).max() < 1e-10 * np.abs(A @ odd).max()
    even = odd + 2 * mirrored(rng.standard_normal(15))
    even = even + mirrored(even)
    assert abs((A @ even)[14]) < 1e-10 * np.abs(A @ even).max()
    np.testing.assert_allclose(B[14] @ [1, 1, 1, 1], 0, atol=1e-15)
    np.testing.assert_allclose(B[12] @ [1, -1, 1, -1], 0, atol=1e-15)
    assert not E[12:].any()  # the road reaches the body through tyres and struts only


@pytest.mark.parametrize("real", [False, True])
def test_a_full_car_on_two_equal_tracks_is_the_half_car(real, rng):
    half, whole = half_car(real=real), full_car(real=real)
    y, u, w = 0.1 * rng.standard_normal(8), 500 * rng.standard_normal(2), rng.standard_normal(2)
    both = [0, 0, 1, 1]
    x = np.concatenate([y[:2][both], y[2:4][both], y[4:6][both], y[6:8], [0.0]])
    got, expected = rates(whole, AXLES, x, u[both], w[both]), rates(half, AXLES, y, u, w)
    np.testing.assert_allclose(got[[0, 2, 4, 6, 8, 10, 12, 13]], expected, rtol=1e-12, atol=1e-12)
    assert abs(got[14]) < 1e-12
