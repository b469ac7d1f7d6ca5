"""What test_suspension.py claims, seen from inside."""

from dataclasses import replace

import numpy as np
import pytest
from iso_spectrum import road_spectrum
from scipy.integrate import quad
from scipy.linalg import expm
from study_plants import quarter_car

import ccdtools as cc
from ccdtools.vehicles import suspension_metrics
from ccdtools.vehicles.iso8608 import BAND
from ccdtools.vehicles.ride_comfort import frequency_weighting

K_S, C_S = 2e4, 1500.0  # N/m, N s/m
SPRUNG, UNSPRUNG, TYRE = 325.0, 65.0, 232.5e3  # kg, kg, N/m: of the paper's quarter car


def metrics(travel=(0.0, 0.0), tyre_force=0.0, force=None, static_load=1.0, **others):
    """The metrics of some signals, the others zero."""
    travel = np.asarray(travel)
    force = np.zeros(travel[..., 1:].shape) if force is None else force
    return suspension_metrics(acceleration=[0.0], travel=travel, tyre_force=np.atleast_1d(tyre_force), force=force,
                              dt=0.1, stop=0.08, static_load=static_load, **others)  # fmt: skip


def test_travel_is_measured_from_the_rest_and_against_the_stop():
    found = metrics([[0.03, -0.04], [0.0, 0.1]])
    np.testing.assert_allclose(found.travel_rms, [np.sqrt(0.00125), np.sqrt(0.005)])
    np.testing.assert_allclose(found.travel_peak, [0.04, 0.1])
    np.testing.assert_allclose(found.travel_share, [0.5, 1.25])


def test_a_tyre_that_loses_its_static_load_is_off_the_road():
    found = metrics(tyre_force=[1000.0, -1000.0, -3000.0, -4000.0], static_load=3000.0)
    assert found.load_rms == pytest.approx(np.sqrt(27e6 / 4) / 3000)
    assert found.lift_off == 0.5


def test_braking_work_counts_as_far_as_it_is_recovered():
    force, travel = [100.0, 100.0, -50.0], [0.0, 0.1, 0.0, 0.2]  # works of 10, −10 and −10 J
    for recovered, energy in ((0.0, 10.0), (0.5, 0.0), (1.0, -10.0)):
        assert metrics(travel, force=force, recovered=recovered).energy == pytest.approx(energy)


def test_the_work_of_a_held_force_is_the_energy_that_an_undamped_mass_and_spring_gain():
    mass, stiffness, dt = 2.0, 30.0, 0.3
    step = expm(dt * np.array([[0, 1, 0], [-stiffness / mass, 0, 1 / mass], [0, 0, 0]]))
    force = np.random.default_rng(0).standard_normal(50)
    states = [np.zeros(2)]
    for u in force:
        states.append((step @ [*states[-1], u])[:2])
    z, v = np.array(states).T
    gained = 0.5 * mass * v[-1] ** 2 + 0.5 * stiffness * z[-1] ** 2
    assert metrics(z, force=force, recovered=1.0).energy == pytest.approx(gained, rel=1e-9)


def drive(road_class, *, runs=3, steps=600, dt=0.01):
    """A passive quarter car on fresh roads of a class, at 20 m/s."""
    w = cc.ISORoad(road_class, 20.0, dt).sample(runs, steps, np.random.default_rng(1))
    model = cc.discretise(replace(quarter_car(), dt=dt))
    return cc.simulate(model, cc.Passive(1), x0=np.zeros((runs, 4)), steps=steps, disturbance=w, design=[K_S, C_S])


def metrics_of(run):
    """As the docstring of `suspension_metrics` says."""
    k_t, m_s, m_us = TYRE, SPRUNG, UNSPRUNG
    kept = ~run.diverged
    x, u = run.states[kept], run.inputs[kept]
    return suspension_metrics(
        acceleration=np.diff(x[:, :, 3]) / run.dt, travel=x[:, :, 2], tyre_force=-k_t * x[:, :, 0],
        force=u[:, :, 0], dt=run.dt, stop=0.08, static_load=9.81 * (m_s + m_us),
    )  # fmt: skip


def test_comfort_and_tyre_load_are_those_of_the_spectra_of_road_car_and_weighting():
    def body_and_tyre(f):
        """Acceleration of the body [1/s] and dynamic load [N s/m] per vertical velocity of the road."""
        s = 2j * np.pi * f
        strut = K_S + C_S * s
        matrix = [[SPRUNG * s**2 + strut, -strut], [-strut, UNSPRUNG * s**2 + strut + TYRE]]
        body, wheel = np.linalg.solve(matrix, [0, TYRE / s])
        return s**2 * body, TYRE * (1 / s - wheel)

    def power(f, row):
        road = (2 * np.pi * f) ** 2 * road_spectrum(f / 20.0, "C") / 20.0
        weight = abs(frequency_weighting(f)) if row == 0 else 1.0
        return road * abs(weight * body_and_tyre(f)[row]) ** 2

    low, high = 20.0 * np.array(BAND)
    felt, load = (quad(power, low, high, args=(row,), limit=400)[0] ** 0.5 for row in (0, 1))
    measured = metrics_of(drive("C", runs=16, steps=8000, dt=0.005))
    assert np.sqrt(np.mean(measured.comfort**2)) == pytest.approx(felt, rel=0.03)
    assert np.sqrt(np.mean(measured.load_rms**2)) * 9.81 * (SPRUNG + UNSPRUNG) == pytest.approx(load, rel=0.03)
