"""What test_free_running.py claims, seen from inside."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from ccdtools import DigitalTwin, InputError, LinearFeedback, deploy, simulate
from ccdtools.co_design.differentiable_model import Stepper
from ccdtools.exceptions import LimitWarning
from ccdtools.twin import free_running_bands
from ccdtools.twin.discrepancy import TwinPlant
from ccdtools.twin.free_running import held_out_bands
from ccdtools.twin.residuals import residuals
from ccdtools.twin.windows import Drawing, Windows, apart
from learning import QuantileConfig
from mpc import lqr

DESIGN = [2.0]
SHORT = QuantileConfig(hidden=(16,), steps=400, batch=256)
LAW = LinearFeedback([[0.5, 0.5]], [-1.0], [1.0])


def coloured(runs, steps, seed):
    """Skewed noise that one signal drives in both states, with a memory of two steps; (runs, steps, 2)."""
    rng = np.random.default_rng(seed)
    signal = np.zeros((runs, steps + 50))
    for k in range(2, steps + 50):
        signal[:, k] = 0.9 * signal[:, k - 1] - 0.5 * signal[:, k - 2] + rng.exponential(size=runs) - 1
    return signal[:, 50:, None] * [0.05, -0.1]


def log_of(study, runs, steps, seed):
    """A log of the nominal plant under coloured noise and LQR, from zero."""
    return deploy(study.plant, law(study), DESIGN, coloured(runs, steps, seed), x0=np.zeros(2))


def law(study):
    """LQR, saturated."""
    A, B, _ = study.model.matrices(DESIGN)
    return LinearFeedback(lqr(A, B, Q=study.objective.Q, R=study.objective.R)[0], *study.problem().input_bounds)


@pytest.fixture(scope="module")
def log(illustrative):
    return log_of(illustrative, 1, 6000, 0)


@pytest.fixture(scope="module")
def twin(illustrative, log):
    rng = np.random.default_rng(1)
    return DigitalTwin(illustrative.model).update(log, weight=illustrative.weight, rng=rng, config=SHORT)


@pytest.fixture(scope="module")
def bands(illustrative, twin):
    fresh = log_of(illustrative, 4, 3000, 2)
    rng = np.random.default_rng(3)
    return free_running_bands(twin, fresh, law(illustrative), rng=rng, steps=(1, 10, 20, 60), windows=600, draws=60)


@pytest.mark.check
def test_one_signal_is_drawn_as_one(illustrative, twin):
    drawing = replace(twin.discrepancy, noise="quantiles")
    w = np.random.default_rng(0).random((200, 30, 2))
    plant = TwinPlant(illustrative.model, drawing)
    run = simulate(plant, law(illustrative), x0=np.zeros((200, 2)), steps=30, disturbance=w, design=DESIGN)
    e = residuals(illustrative.model, run).e_next.reshape(-1, 2)
    assert np.corrcoef(e.T)[0, 1] < -0.99
    apart = copy.deepcopy(drawing)
    apart.network.positions[:, 1] = apart.network.positions[torch.randperm(len(apart.network.positions)), 1]
    alone = simulate(TwinPlant(illustrative.model, apart), law(illustrative), x0=np.zeros((200, 2)), steps=30,
                     disturbance=w, design=DESIGN)  # fmt: skip
    assert np.corrcoef(residuals(illustrative.model, alone).e_next.reshape(-1, 2).T)[0, 1] > -0.9


@pytest.mark.check
def test_a_generation_measures_its_own_held_out_stretches_or_says_that_they_are_too_short(illustrative, twin, log):
    bands = held_out_bands(twin, log, law(illustrative), rng=np.random.default_rng(0))
    assert bands.steps.tolist() == [10, 50]
    assert bands.summary()["windows"] == 150
    assert held_out_bands(twin, log, LAW, rng=np.random.default_rng(0), since=6000) is None


@pytest.mark.long
def test_a_run_may_start_from_a_known_error(illustrative, twin, log):
    errors = residuals(illustrative.model, log)
    drawing = replace(twin.discrepancy, noise="quantiles")
    plant = TwinPlant(illustrative.model, drawing, errors.e[0, [100, 200]])
    w = np.random.default_rng(0).random((2, 3, 2))
    given, none = (
        simulate(one, LAW, x0=errors.x[0, [100, 200]], steps=3, disturbance=w, design=DESIGN).states
        for one in (plant, TwinPlant(illustrative.model, drawing))
    )
    assert np.abs(given - none)[:, 1].max() > 1e-3
    with pytest.raises(InputError, match="error: got those of 2 runs, expected one for each of the 3 runs"):
        simulate(plant, LAW, x0=np.zeros((3, 2)), steps=3, design=DESIGN)
    with pytest.raises(InputError, match="error: got shape"):
        TwinPlant(illustrative.model, drawing, np.zeros(7))


def test_the_model_that_learning_runs_on_draws_the_same(illustrative, twin):
    drawing = replace(twin.discrepancy, noise="quantiles")
    step = Stepper.at(replace(illustrative.problem(), discrepancy=drawing), torch.tensor(DESIGN))
    w = np.random.default_rng(0).random((3, 6, 2))
    x0 = np.random.default_rng(1).standard_normal((3, 2))
    run = simulate(TwinPlant(illustrative.model, drawing), LAW, x0=x0, steps=6, disturbance=w, design=DESIGN)
    x = torch.tensor(x0, dtype=torch.float32)
    e = torch.zeros_like(x)
    for k in range(6):
        x, e, _ = step(x, e, torch.tensor(run.inputs[:, k], dtype=torch.float32), torch.tensor(w[:, k]).float())
        np.testing.assert_allclose(x.detach(), run.states[:, k + 1], atol=1e-4)


def test_a_median_alone_gives_no_bands(illustrative, log):
    alone = DigitalTwin(illustrative.model).update(
        log, weight=illustrative.weight, rng=np.random.default_rng(0), config=replace(SHORT, levels=(0.5,), steps=2)
    )
    with pytest.raises(InputError, match="noise: got 'quantiles' of 1 level, expected a network of at least three"):
        replace(alone.discrepancy, noise="quantiles")
    with pytest.raises(InputError, match="twin: got one that has learned 1 quantile, from which nothing can be drawn"):
        free_running_bands(alone, log, LAW, rng=np.random.default_rng(0))
    assert held_out_bands(alone, log, LAW, rng=np.random.default_rng(0)) is None


def test_draws_that_run_away_are_stopped_at_a_thousand_times_what_was_logged(twin, log):
    loose = LinearFeedback([[-9.0, -9.0]])
    with pytest.warns(LimitWarning, match="drove the log"):
        bands = free_running_bands(twin, log, loose, rng=np.random.default_rng(0), steps=(60,), windows=4, draws=4)
    assert 300 < np.abs(bands.upper).max() / np.abs(log.states).max() < 3000


def test_the_scale_of_a_window_is_the_mean_of_twenty_recent_errors(illustrative, twin, log):
    errors = residuals(illustrative.model, log)
    drawing = Drawing(twin, LAW, 1, 2, 5, 0.8)
    windows = drawing.on(errors, [(0, 0, 5), (0, 1000, 1001)], np.random.default_rng(0))
    size = np.abs(errors.e_next[0]) / np.abs(errors.e_next[0]).mean(axis=0)
    assert windows.scale[0] == 1.0  # nothing is known before a run
    assert windows.scale[-1] == pytest.approx(size[980:1000].mean())


def test_a_window_after_no_error_at_all_has_a_positive_scale(twin, log):
    errors = residuals(twin.model, log)
    exact = replace(errors, e=np.zeros_like(errors.e))
    windows = Drawing(twin, LAW, 1, 2, 2, 0.8).on(exact, [(0, 1000, 1002)], np.random.default_rng(0))
    assert (windows.scale > 0).all()
    assert (windows.scale < 1e-12).all()


def test_windows_that_lie_apart_are_counted_among_those_drawn():
    spans = [(0, 0, 150), (0, 750, 900), (1, 0, 99)]  # those of 100 steps start within 51 samples, the last has none
    assert [apart(spans, 100, step) for step in (1, 10, 50, 100)] == [102, 12, 4, 2]
    assert apart(spans, 33, 33) == 4 + 4 + 3


def test_scores_that_grow_with_the_scale_have_its_exponent():
    scale = np.geomspace(0.1, 10.0, 50)
    ones = np.ones((3, 50, 1))
    off = ones * scale[:, None] ** 0.5 * [[[1.0]], [[-2.0]], [[1.0]]]
    windows = Windows(0 * ones, ones, ones, off, np.ones((3, 1)), scale, np.zeros(50, int), np.ones(1))
    np.testing.assert_allclose(windows.scores_at(2), [2 * scale**0.5, 2 * scale**0.5])
    np.testing.assert_allclose(windows.scores_at(3), [scale**0.5, 2 * scale**0.5])
    np.testing.assert_allclose(windows.exponents(3, 0.8), 0.5, atol=1e-4)
