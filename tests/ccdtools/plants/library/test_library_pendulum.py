"""The pendulum on a cart: textbook matrices, energy, power, and what the real one has."""

import numpy as np
import pytest
from library_oracles import matrices, motion, oscillations, rates

from ccdtools.plants.library import CartPole, pendulum_on_cart

TUTORIAL = [0.6, 0.5]  # length of the pole, mass of the cart
DESIGN = [0.8, 0.7]


def energy(x, length, mass, pole=0.2):
    """Kinetic and potential energy [J] of cart and uniform pole."""
    _, speed, angle, rate = x
    arm = length / 2
    across = speed + arm * rate * np.cos(angle)
    down = -arm * rate * np.sin(angle)
    turning = pole * length**2 / 12 * rate**2
    return (mass * speed**2 + pole * (across**2 + down**2) + turning) / 2 + pole * 9.81 * arm * np.cos(angle)


def gradient(f, x):
    """Central differences of a function of a vector."""
    h = 1e-6
    return np.array([(f(x + h * e) - f(x - h * e)) / (2 * h) for e in np.eye(len(x))])


@pytest.mark.parametrize("linear", [False, True])
def test_the_pendulum_has_the_matrices_of_the_tutorial(linear):
    """Control Tutorials for MATLAB and Simulink; its angle grows the other way."""
    A, B, _ = matrices(pendulum_on_cart(linear=linear), TUTORIAL)
    expected = [[0, 1, 0, 0], [0, -0.1818, -2.6755, 0], [0, 0, 0, 1], [0, 0.4545, 31.2136, 0]]
    np.testing.assert_allclose(A, expected, atol=5e-5)
    np.testing.assert_allclose(B.ravel(), [0, 1.8182, 0, -4.5455], atol=5e-5)


def test_the_undamped_pendulum_keeps_its_energy_over_whole_turns():
    plant = pendulum_on_cart(cart=CartPole(friction=0.0))
    path = motion(plant, DESIGN, [0.0, 0.3, 0.1, 0.5], np.linspace(0, 6, 80))
    assert path[2].max() > np.pi
    np.testing.assert_allclose(energy(path, *DESIGN), energy(path[:, 0], *DESIGN), rtol=1e-8)


def test_the_undamped_pendulum_keeps_its_momentum_where_nothing_pulls_at_the_cart():
    plant = pendulum_on_cart(cart=CartPole(friction=0.0))
    path = motion(plant, DESIGN, [0.0, 0.3, 0.1, 0.5], np.linspace(0, 3, 40))
    momentum = (0.7 + 0.2) * path[1] + 0.2 * 0.4 * np.cos(path[2]) * path[3]
    np.testing.assert_allclose(momentum, momentum[0], atol=1e-9)


def test_motor_wind_and_friction_exchange_the_power_they_should(rng):
    plant = pendulum_on_cart()
    for _ in range(20):
        x, (u,), (w,) = rng.standard_normal(4), 3 * rng.standard_normal(1), rng.standard_normal(1)
        power = gradient(lambda y: energy(y, *DESIGN), x) @ rates(plant, DESIGN, x, [u], [w])
        expected = u * x[1] + w * (x[1] + 0.4 * np.cos(x[2]) * x[3]) - 0.1 * x[1] ** 2
        assert power == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_a_pendulum_that_hangs_from_a_heavy_cart_swings_as_a_physical_pendulum():
    plant = pendulum_on_cart(cart=CartPole(friction=0.0))
    h = 1e-6
    hanging = np.array([0, 0, np.pi, 0])
    columns = [(rates(plant, [0.8, 1e7], hanging + h * e) - rates(plant, [0.8, 1e7], hanging - h * e)) / (2 * h)
               for e in np.eye(4)]  # fmt: skip
    assert oscillations(np.stack(columns, axis=1), 1)[0] == pytest.approx(np.sqrt(1.5 * 9.81 / 0.8), rel=1e-6)


def test_the_linear_pendulum_has_the_slopes_of_the_nonlinear_one():
    linear, whole = pendulum_on_cart(linear=True), pendulum_on_cart()
    for p in whole.design.spread():
        slopes = [gradient(lambda x, i=i, p=p: rates(whole, p, x)[i], np.zeros(4)) for i in range(4)]
        np.testing.assert_allclose(matrices(linear, p)[0], slopes, rtol=1e-7, atol=1e-7)


def test_upright_is_unstable_for_every_design():
    plant = pendulum_on_cart()
    assert all(np.linalg.eigvals(matrices(plant, p)[0]).real.max() > 2.0 for p in plant.design.spread())


def test_the_air_takes_the_power_of_a_force_against_the_motion_of_the_centre(rng):
    plant = pendulum_on_cart(real=True, cart=CartPole(pivot_friction=0.0, dry_friction=0.0, drag=0.3))
    for _ in range(20):
        x = rng.standard_normal(4)
        across = x[1] + 0.4 * np.cos(x[2]) * x[3]
        up = -0.4 * np.sin(x[2]) * x[3]
        power = gradient(lambda y: energy(y, *DESIGN), x) @ rates(plant, DESIGN, x)
        assert power == pytest.approx(-0.1 * x[1] ** 2 - 0.3 * np.hypot(across, up) ** 3, rel=1e-6, abs=1e-7)


def test_the_real_pendulum_loses_energy_and_has_a_largest_force(rng):
    plant = pendulum_on_cart(real=True)
    for _ in range(50):
        x = 2 * rng.standard_normal(4)
        assert gradient(lambda y: energy(y, *DESIGN), x) @ rates(plant, DESIGN, x) < 0
    strong, stronger = (rates(plant, DESIGN, np.zeros(4), [u])[1] for u in (1e3, 1e4))
    assert strong == pytest.approx(stronger)
    assert strong == pytest.approx(rates(pendulum_on_cart(), DESIGN, np.zeros(4), [12.0])[1])
