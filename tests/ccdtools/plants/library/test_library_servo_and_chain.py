"""The geared servo and the chain of masses: power balances and frequencies that textbooks give."""

from importlib import import_module

import numpy as np
import pytest
from library_oracles import matrices, motion, oscillations, rates

from ccdtools.plants.library import Servo, dc_servo, illustrative, mass_chain

CONSTANT, RESISTANCE = 0.0274, 4.0  # of the tutorial's motor


# ── servo ──


def test_the_servo_turns_electrical_power_into_motion_heat_and_friction(rng):
    plant = dc_servo()
    for ratio, flywheel in plant.design.spread():
        speed, voltage, torque = rng.standard_normal(3) * [3.0, 10.0, 0.1]
        current = (voltage - CONSTANT * ratio * speed) / RESISTANCE
        inertia = 1e-3 + flywheel + 3.2284e-6 * ratio**2
        stored = inertia * speed * rates(plant, [ratio, flywheel], [0.0, speed], [voltage], [torque])[1]
        friction = (1e-3 + 3.5077e-6 * ratio**2) * speed**2
        assert stored == pytest.approx(voltage * current - RESISTANCE * current**2 + torque * speed - friction)


def test_a_servo_without_friction_settles_where_its_motor_induces_the_voltage():
    plant = dc_servo(servo=Servo(load_friction=0.0, motor_friction=0.0))
    assert rates(plant, [20.0, 1e-3], [0.5, 12.0 / (CONSTANT * 20.0)], [12.0])[1] == pytest.approx(0.0, abs=1e-9)


def test_the_motor_alone_has_the_pole_of_the_tutorial():
    """b R + K² over J R, without inductance."""
    alone = Servo(load=1e-12, load_friction=0.0)
    A, _, _ = matrices(dc_servo(servo=alone), [1.0, 0.0])
    pole = (3.5077e-6 * 4.0 + 0.0274**2) / (3.2284e-6 * 4.0)
    assert -A[1, 1] == pytest.approx(pole, rel=1e-6)
    assert pole == pytest.approx(59.226, abs=1e-2)


def test_the_real_servo_is_heavier_sticks_and_saturates():
    model, real = dc_servo(), dc_servo(real=True)
    p = [20.0, 1e-3]
    assert rates(real, p, [0, 0], [1e3])[1] == pytest.approx(rates(real, p, [0, 0], [1e4])[1])
    assert abs(rates(real, p, [0, 0], [1.0])[1]) < 0.9 * abs(rates(model, p, [0, 0], [1.0])[1])
    heavier = 1.3e-3 + 1e-3 + 3.2284e-6 * 400
    assert heavier * rates(real, p, [0, 0], w=[1.0])[1] == pytest.approx(1.0)
    frictionless = dc_servo(real=True, servo=Servo(dry_friction=0.0))
    gap = rates(frictionless, p, [0, 1.0])[1] - rates(real, p, [0, 1.0])[1]
    assert heavier * gap == pytest.approx(0.02)


# ── chain ──


@pytest.mark.parametrize("n", [1, 2, 5, 10])
def test_a_chain_between_two_walls_has_the_frequencies_of_the_discrete_string(n):
    """ω_j = 2 √(k/m) sin(j π / (2 (n + 1)))."""
    own = oscillations(matrices(mass_chain(n, mass=0.5), [80.0, 0.0])[0], n)
    np.testing.assert_allclose(own, 2 * np.sqrt(160.0) * np.sin(np.arange(1, n + 1) * np.pi / (2 * (n + 1))), rtol=1e-9)


@pytest.mark.parametrize("n", [1, 2, 5, 10])
def test_a_chain_on_one_wall_has_the_frequencies_of_a_string_with_a_free_end(n):
    """ω_j = 2 √(k/m) sin((2 j − 1) π / (2 (2 n + 1)))."""
    own = oscillations(matrices(mass_chain(n, walls=1), [80.0, 0.0])[0], n)
    expected = 2 * np.sqrt(80.0) * np.sin((2 * np.arange(1, n + 1) - 1) * np.pi / (2 * (2 * n + 1)))
    np.testing.assert_allclose(own, expected, rtol=1e-9)


def test_every_mode_of_the_chain_is_damped_in_proportion_to_its_square():
    """Links with stiffness k and damping c: 2 ζ ω = (c / k) ω²."""
    modes = np.linalg.eigvals(matrices(mass_chain(), [100.0, 0.5])[0])
    np.testing.assert_allclose(-2 * modes.real, 0.5 / 100.0 * np.abs(modes) ** 2, rtol=1e-8)


@pytest.mark.check
def test_the_real_chain_without_friction_keeps_its_energy(monkeypatch):
    monkeypatch.setattr(import_module("ccdtools.plants.library.mass_chain"), "DRY_FRICTION", 0.0)

    def energy(x):
        stretch = np.diff(np.vstack([np.zeros(x.shape[1]), x[:4], np.zeros(x.shape[1])]), axis=0)
        return (x[4:] ** 2).sum(axis=0) / 2 + 60.0 * (stretch**2 / 2 + 5.0 * stretch**4 / 4).sum(axis=0)

    x0 = [0.1, 0.4, -0.2, 0.3, 1.0, -1.0, 0.0, 2.0]
    path = motion(mass_chain(4, real=True), [60.0, 0.0], x0, np.linspace(0, 5, 40))
    np.testing.assert_allclose(energy(path), energy(path)[0], rtol=1e-8)


def test_the_real_chain_hardens_and_rubs():
    model, real = mass_chain(1), mass_chain(1, real=True)
    harder = rates(real, [50.0, 1.0], [0.4, 0.0])[1] / rates(model, [50.0, 1.0], [0.4, 0.0])[1]
    assert harder == pytest.approx(1 + 5.0 * 0.4**2)
    rubbing = rates(real, [50.0, 1.0], [0.0, 1.0])[1] - rates(model, [50.0, 1.0], [0.0, 1.0])[1]
    assert rubbing == pytest.approx(-0.2)


def test_forces_push_the_masses_they_are_said_to_push():
    plant = mass_chain(4, driven=(2, 4), disturbed=(1,), mass=2.0)
    _, B, E = matrices(plant, plant.design.centre)
    np.testing.assert_array_equal(B[4:], np.array([[0, 0], [1, 0], [0, 0], [0, 1]]) / 2)
    np.testing.assert_array_equal(E[4:].ravel(), [0.5, 0, 0, 0])
    assert plant.input_names == ("force on mass 2 [N]", "force on mass 4 [N]")


# ── illustrative ──


def test_the_illustrative_example_is_unstable_as_the_paper_says():
    assert np.abs(np.linalg.eigvals(matrices(illustrative(), [1.0])[0])).max() == pytest.approx(1.2099, abs=1e-4)
