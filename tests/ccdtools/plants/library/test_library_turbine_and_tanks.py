"""The wind turbine and the two tanks: reference values of their sources, balances, slopes."""

import numpy as np
import pytest
from library_oracles import frequencies, matrices, motion, rates

from ccdtools.plants.library import Tanks, two_tanks, wind_turbine

REFERENCE = [867.637e6, 97.0]  # shaft and gear of the reference turbine
ROTOR, GENERATOR = 38_759_236.0, 534.116
TORRICELLI = np.sqrt(2 * 981.0)


def slopes(plant, p):
    """∂f/∂(x, u, w) at zero by central differences, each in a step that suits its size."""
    h = 1e-5
    n = plant.nx + plant.nu + plant.nw
    parts = [plant.nx, plant.nx + plant.nu]
    return np.stack(
        [(rates(plant, p, *np.split(h * e, parts)) - rates(plant, p, *np.split(-h * e, parts))) / (2 * h)
         for e in np.eye(n)], axis=1,
    )  # fmt: skip


# ── wind turbine ──


def drivetrain():
    """Eigenvalues of the drivetrain at the reference design."""
    return np.linalg.eigvals(matrices(wind_turbine(), REFERENCE)[0])


def test_the_drivetrain_has_the_frequency_of_two_inertias_on_a_shaft():
    M = np.diag([ROTOR, 97.0**2 * GENERATOR])
    K = 867.637e6 * np.array([[1, -1], [-1, 1]])
    free = frequencies(M, K + 1e-6 * np.eye(2))[-1]
    assert np.abs(drivetrain()).max() == pytest.approx(free, rel=1e-3)  # the wind's share is small
    assert free / (2 * np.pi) == pytest.approx(2.22, abs=0.01)


def test_the_shaft_has_the_damping_that_its_source_states():
    """NREL/TP-500-38060: 5 % of critical."""
    mode = drivetrain()[np.abs(drivetrain()).argmax()]
    assert -mode.real / np.abs(mode) == pytest.approx(0.05, abs=5e-4)


def test_wind_drives_both_inertias_and_the_generator_brakes_them():
    plant = wind_turbine()
    A, B, E = matrices(plant, REFERENCE)
    inertias = np.array([ROTOR, 97.0**2 * GENERATOR])
    np.testing.assert_allclose(inertias @ B[1:, 0], -97e3, rtol=1e-12)
    assert inertias @ E[1:, 0] > 0 > inertias @ B[1:, 1]
    np.testing.assert_allclose(inertias @ A[1:, 0], 0.0, atol=1e-6)  # the shaft's own torque is internal
    assert drivetrain().real.max() < 0


def test_the_nominal_turbine_has_the_slopes_of_the_real_one():
    model, real = wind_turbine(), wind_turbine(real=True)
    for p in model.design.spread()[:8]:
        np.testing.assert_allclose(np.hstack(matrices(model, p)), slopes(real, p), rtol=1e-5, atol=1e-8)


def test_the_real_turbine_has_limits_and_curved_aerodynamics():
    real = wind_turbine(real=True)
    x = np.zeros(3)
    np.testing.assert_allclose(rates(real, REFERENCE, x, [50.0, 90.0]), rates(real, REFERENCE, x, [500.0, 900.0]))
    gust, lull = (rates(real, REFERENCE, x, w=[wind])[1] for wind in (3.0, -3.0))
    assert abs(gust + lull) > 0.05 * gust


# ── two tanks ──


def test_a_tank_has_the_time_constant_of_its_source():
    """Johansson 2000: 62 s for the first tank, at 12.4 cm."""
    A, _, _ = matrices(two_tanks(linear=True, tanks=Tanks(level=12.4)), [28.0, 28.0, 0.071])
    assert -1 / A[1, 1] == pytest.approx(62.0, abs=0.8)
    assert -1 / A[0, 0] == pytest.approx(62.0, abs=0.8)


def test_no_water_is_lost_between_the_tanks(rng):
    p = np.array([30.0, 25.0, 0.08])
    for _ in range(10):
        levels, voltage, inflow = rng.uniform(1, 20, 2), rng.uniform(0, 6, 1), rng.standard_normal(2)
        gained = p[:2] @ rates(two_tanks(absolute=True), p, levels, voltage, inflow)
        lost = 0.071 * TORRICELLI * np.sqrt(levels[1])
        assert gained == pytest.approx(3.33 * voltage[0] + inflow.sum() - lost, rel=1e-2)


def test_a_tank_empties_in_the_time_of_torricelli():
    """√h falls at a constant rate: t = A/a √(2/g) (√h₀ − √h₁)."""
    expected = 28.0 / 0.08 * np.sqrt(2 / 981.0) * (np.sqrt(16.0) - np.sqrt(4.0))
    levels = motion(two_tanks(absolute=True), [28.0, 28.0, 0.08], [16.0, 5.0], [0.0, expected])
    assert levels[0, -1] == pytest.approx(4.0, abs=2e-3)


def test_the_outflow_is_smooth_where_a_tank_is_empty_and_nothing_flows_from_it():
    plant = two_tanks(absolute=True)
    p = [28.0, 28.0, 0.071]
    np.testing.assert_array_equal(rates(plant, p, [0.0, 0.0]), 0.0)
    slope = matrices(plant, p)[0]
    np.testing.assert_allclose(slope[0, 0], -0.071 * TORRICELLI / np.sqrt(0.1) / 28.0, rtol=1e-12)
    empty = motion(plant, p, [3.0, 2.0], np.linspace(0, 600, 30))
    assert empty.min() > -1e-9
    assert empty[:, -1].max() < 1e-3


def test_the_linear_tanks_have_the_slopes_of_the_nonlinear_ones():
    whole, linear = two_tanks(), two_tanks(linear=True)
    for p in whole.design.spread():
        np.testing.assert_allclose(np.hstack(matrices(linear, p)), slopes(whole, p), rtol=1e-7, atol=1e-10)


def test_the_real_tanks_leak_are_clogged_and_have_a_pump_that_neither_draws_nor_exceeds_its_voltage():
    p = [28.0, 28.0, 0.071]
    whole, real = two_tanks(absolute=True), two_tanks(absolute=True, real=True)
    full = np.array([10.0, 10.0])
    spilled = 0.005 * TORRICELLI * np.sqrt(10.0) / 28.0
    clogged = 0.9 * rates(whole, p, full)
    np.testing.assert_allclose(
        rates(real, p, full), clogged - [spilled, 0.0], rtol=0, atol=1.3e-3
    )  # the rounding: 0.01 V
    assert 28.0 * rates(real, p, [0.0, 0.0], [25.0])[0] == pytest.approx(33.3, rel=1e-3)
    assert abs(28.0 * rates(real, p, [0.0, 0.0], [-25.0])[0]) < 1e-2
    assert 28.0 * rates(real, p, [0.0, 0.0], [5.0])[0] == pytest.approx(16.65, rel=1e-6)
