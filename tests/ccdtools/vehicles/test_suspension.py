"""The metrics of a suspension: by hand on small signals, by the balance of energy, and on a car on roads of classes."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
from study_plants import quarter_car

import ccdtools as cc
from ccdtools.exceptions import InputError
from ccdtools.vehicles import suspension_metrics

K_S, C_S = 2e4, 1500.0  # N/m, N s/m
SPRUNG, UNSPRUNG, TYRE = 325.0, 65.0, 232.5e3  # kg, kg, N/m: of the paper's quarter car
SIGNALS = {
    "acceleration": np.zeros((2, 3)), "travel": np.zeros((2, 4)), "tyre_force": np.zeros((2, 4)),
    "force": np.zeros((2, 3)), "dt": 0.1, "stop": 0.08, "static_load": 3000.0,
}  # fmt: skip


# ── one by one ──


# ── a car ──


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


def test_a_passive_linear_car_rides_twice_as_roughly_on_the_next_class():
    smooth, rough = metrics_of(drive("B")), metrics_of(drive("C"))
    for name in ("comfort", "travel_rms", "travel_peak", "travel_share", "load_rms"):
        np.testing.assert_allclose(getattr(rough, name), 2 * getattr(smooth, name), rtol=1e-9)
        assert getattr(rough, name).shape == (3,)
    np.testing.assert_array_equal(rough.energy, 0.0)
    assert (rough.lift_off == 0.0).all()
    assert 0.3 < rough.comfort.mean() < 2.0  # an average road at 72 km/h: fairly to very uncomfortable without a seat


def test_wheels_of_a_car_have_their_own_metrics():
    wheels = {"travel": np.ones((2, 4, 11)), "tyre_force": np.ones((2, 4, 11)), "force": np.ones((2, 4, 10))}
    metrics = suspension_metrics(**{**SIGNALS, "acceleration": np.zeros((2, 10)), **wheels})
    assert metrics.comfort.shape == (2,)
    assert metrics.travel_rms.shape == metrics.load_rms.shape == metrics.energy.shape == (2, 4)


def test_metrics_print_their_units_copy_and_stay_as_they_are():
    metrics = suspension_metrics(**SIGNALS)
    assert repr(metrics) == (
        "SuspensionMetrics(comfort 0 m/s², travel 0 m rms, 0 m peak, 0 of the stop, tyre load 0 of the static one rms, "
        "off the road 0 of the time, energy 0 J)"
    )
    for other in (copy.deepcopy(metrics), pickle.loads(pickle.dumps(metrics))):
        with pytest.raises(ValueError, match="read-only"):
            other.comfort[0] = 1.0


def test_no_runs_have_no_metrics():
    none = {name: value[:0] if isinstance(value, np.ndarray) else value for name, value in SIGNALS.items()}
    assert repr(suspension_metrics(**none)) == "SuspensionMetrics(no runs)"


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"acceleration": np.zeros((2, 0))}, r"acceleration: got shape \(2, 0\), expected samples"),
        ({"travel": np.zeros((2, 3))}, r"force, travel: got shapes \(2, 3\) and \(2, 3\), expected \(..., T\) and"),
        ({"travel": "far"}, "travel: got 'far', expected an array of real numbers"),
        ({"tyre_force": [np.inf]}, "tyre_force: got (nan|-?inf) at index"),
        ({"force": 3.0}, r"force: got shape \(\), expected samples"),
        ({"dt": 0}, "dt: got 0, expected a positive number"),
        ({"stop": -0.1}, "stop: got -0.1, expected a positive number"),
        ({"static_load": 0.0}, "static_load: got 0.0, expected a positive number"),
        ({"recovered": 1.5}, "recovered: got 1.5, expected a fraction from 0 to 1"),
    ],
)
def test_wrong_calls_name_the_argument(wrong, message):
    with pytest.raises(InputError, match=f"^{message}"):
        suspension_metrics(**{**SIGNALS, **wrong})
