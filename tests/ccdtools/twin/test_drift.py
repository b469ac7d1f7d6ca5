"""Drift of a plant from its twin."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from trial_plants import X0, plant, wide_problem

from ccdtools import DigitalTwin, Gaussian, InputError, LinearFeedback, simulate
from ccdtools.twin import detect_drift, drift_of_log, outside_data
from learning import QuantileConfig


@pytest.fixture(scope="module")
def problem():
    return wide_problem()


def correlated(share, n, rng):
    noise = rng.standard_normal((n + 100, 2))
    for k in range(1, len(noise)):
        noise[k] = share * noise[k - 1] + np.sqrt(1 - share**2) * noise[k]
    return noise[100:]


@pytest.mark.long
@pytest.mark.parametrize("share", [0.0, 0.6])
def test_a_change_is_seen_and_none_is_invented(share):
    rng = np.random.default_rng(6)
    alarms, seen = 0, []
    for _ in range(60):
        e = correlated(share, 2400, rng) * [1.0, 1e-3]
        alarms += detect_drift(e[:1200], e[1200:]).found is not None
        changed = e[1200:] + np.where(np.arange(1200) < 400, 0.0, 1.0)[:, None] * [1.5, 0]
        seen.append(detect_drift(e[:1200], changed))
    assert alarms <= 3 + 2 * 3**0.5
    found = [one for one in seen if one.found is not None]
    assert len(found) >= 54
    assert np.median([one.began for one in found]) == pytest.approx(400, abs=60)


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e6])
def test_residuals_where_there_were_none_are_a_change(size):
    assert detect_drift(np.zeros(900), np.full(900, size)).status.value == "drift"
    assert detect_drift(np.zeros(900), np.zeros(900)).status.value == "no drift"


def test_a_long_log_takes_memory_of_its_length():
    e = np.random.default_rng(0).standard_normal(10_300)
    tracemalloc.start()
    detect_drift(e[:300], e[300:])
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 1000 * e.nbytes


def test_a_twin_does_not_call_its_own_plant_drifted(illustrative):
    study, rng = illustrative, np.random.default_rng(7)
    law, w = LinearFeedback([[0.5, 0.8]]), study.real.disturbance

    def log(plant, runs=20):
        return simulate(plant, law, x0=np.tile(study.x0, (runs, 1)), steps=100, disturbance=w, design=[2.0], rng=rng)

    twin = DigitalTwin(study.model)
    with pytest.raises(InputError, match="after `update`"):
        drift_of_log(twin, log(study.real.plant))
    quantiles = QuantileConfig(hidden=(16,), steps=300, batch=256)
    twin = twin.update(log(study.real.plant, 60), weight=study.weight, rng=rng, config=quantiles)
    assert drift_of_log(twin, log(study.real.plant)).status.value == "no drift"
    other = log(study.real.plant)
    few = drift_of_log(twin, other, block=30)
    assert few.status.value == "not known"
    assert "log longer" in str(few)
    assert outside_data(twin, other)[0] < 0.01
    share, excess = outside_data(twin, replace(other, states=3 * other.states))
    x = np.concatenate([twin.logs[0].x.reshape(-1, 2), 3 * other.states[:, :-1].reshape(-1, 2)])
    own, new = x[: 60 * 100], x[60 * 100 :]
    out = ((new < own.min(axis=0)) | (new > own.max(axis=0))).any(axis=1)
    assert share == pytest.approx(out.mean())
    beyond = np.maximum(new.max(axis=0) - own.max(axis=0), own.min(axis=0) - new.min(axis=0)) / np.ptp(own, axis=0)
    np.testing.assert_allclose(excess, [*np.maximum(beyond, 0), 0.0])
    with pytest.raises(InputError, match="one without a log"):
        outside_data(DigitalTwin(study.model), other)
    pushed = replace(other, states=other.states + np.linspace(0, 2, 101)[None, :, None] ** 2)
    assert drift_of_log(twin, pushed).status.value == "drift"


def test_another_law_on_the_same_plant_is_no_drift(problem):
    def log(gain, seed):
        w = Gaussian([0.1, 0.1]).sample(1, 3000, np.random.default_rng(seed))
        law = LinearFeedback(gain * np.array([[0.15, 0.45]]))
        return simulate(plant(1.1), law, x0=X0[None], steps=3000, disturbance=w, design=[1.0])

    twin = DigitalTwin(problem.model, scale=problem.state_scale)
    twin = twin.update(log(1.0, 1), weight=1e-2 * np.eye(2), rng=np.random.default_rng(0))
    for gain in (1.0, 2.0, 0.0):
        assert drift_of_log(twin, log(gain, 5)).status.value == "no drift"


@pytest.mark.parametrize(("calibration", "residuals", "said"), [
    (np.zeros((100, 2)), np.zeros((50, 2)), "100 samples"),
    (np.zeros((400, 2)), np.zeros((50, 3)), "3 columns"),
    (np.full((400, 2), np.inf), np.zeros((50, 2)), "calibration"),
])  # fmt: skip
def test_wrong_residuals_are_named(calibration, residuals, said):
    with pytest.raises(InputError, match=said):
        detect_drift(calibration, residuals)
