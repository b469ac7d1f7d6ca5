"""Free-running bands: draws of the updated model over many steps cover what the plant did."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import betabinom

from ccdtools import DigitalTwin, InputError, LinearFeedback, deploy
from ccdtools.exceptions import LimitWarning
from ccdtools.twin import free_running_bands
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
def test_bands_cover_eighty_per_cent_of_a_log_that_was_never_seen(bands):
    # Of 600 windows, 20 samples apart, of a signal with a memory of about four, some 300 are independent. Twenty of 60
    # steps calibrate, at rank 16.8 of 21: what they hold is about a beta variable.
    low, high = (betabinom.ppf(level, 300, 17, 4) / 300 for level in (0.001, 0.999))
    assert ((bands.coverage > low) & (bands.coverage < high)).all()


@pytest.mark.long
def test_a_tube_holds_all_states_at_all_steps_jointly(illustrative, twin):
    fresh = log_of(illustrative, 4, 3000, 2)
    bands = free_running_bands(
        twin, fresh, law(illustrative), rng=np.random.default_rng(3), steps=(1, 10), windows=400, draws=30
    )
    starts = np.linspace(0, 4 * 2991 - 1, 400).round().astype(int)  # of windows of ten steps
    run, first = starts // 2991, starts % 2991
    for i, k in enumerate((1, 10)):
        lower, upper = bands.tube(k)
        actual = np.stack([fresh.states[run, first + h] for h in range(1, k + 1)])
        held = ((actual >= lower) & (actual <= upper)).all(axis=(0, 2))
        assert held.mean() == bands.joint[i]
        assert 0.7 < held.mean() < 0.9  # 120 windows that do not overlap calibrate, 400 are judged
        assert (lower <= upper).all()
    with pytest.raises(InputError, match="steps: got 7, expected one of 1, 10"):
        bands.tube(7)


def test_too_few_windows_to_calibrate_are_refused_with_the_number_needed(twin, log):
    message = "twin: got 0 windows of 100 steps, held out .* level of 0.8, expected at least 4"
    with pytest.raises(InputError, match=message):
        free_running_bands(twin, log, LAW, rng=np.random.default_rng(0), steps=[100])
    bands = free_running_bands(twin, log, LAW, rng=np.random.default_rng(0), steps=[10, 100], windows=20, draws=5)
    assert bands.steps.tolist() == [10]
    with pytest.raises(InputError, match="windows: got 3"):
        free_running_bands(twin, log, LAW, rng=np.random.default_rng(0), steps=[10], windows=3)


@pytest.mark.check
def test_the_draws_spread_as_far_as_the_plant(bands):
    np.testing.assert_allclose(bands.spread, 1.0, atol=0.12)


def test_the_same_generator_draws_the_same_bands(illustrative, twin, log):
    a, b = (
        free_running_bands(twin, log, law(illustrative), rng=np.random.default_rng(5), steps=[10], windows=20, draws=20)
        for _ in range(2)
    )
    np.testing.assert_array_equal(a.lower, b.lower)
    assert repr(a).startswith("FreeRunningBands(20 windows, coverage of 80 %: 10 steps ")


def test_the_actual_states_are_those_of_the_log(illustrative, twin, log):
    rng = np.random.default_rng(0)
    bands = free_running_bands(twin, log, law(illustrative), rng=rng, steps=[7], windows=10**6, draws=2)
    np.testing.assert_allclose(bands.actual[0], log.states[0, 7:], atol=1e-12)


def test_held_out_windows_stay_within_what_was_held_out(illustrative, twin, log):
    # 20 blocks of 300 samples, of which the last 60 are held out: 51 windows of ten steps in each.
    rng = np.random.default_rng(0)
    bands = free_running_bands(twin, log, LAW, rng=rng, steps=(10, 61), windows=10**6, draws=2, held_out=0.2)
    assert bands.steps.tolist() == [10]
    assert bands.actual.shape == (1, 20 * 51, 2)
    np.testing.assert_allclose(bands.actual[0, 0], log.states[0, 240 + 10], atol=1e-12)


def test_samples_of_a_former_policy_are_left_out(illustrative, twin, log):
    rng = np.random.default_rng(0)
    bands = free_running_bands(twin, log, LAW, rng=rng, steps=[10], windows=10**6, draws=2, since=5000)
    np.testing.assert_allclose(bands.actual[0, 0], log.states[0, 5010], atol=1e-12)
    several = log_of(illustrative, 3, 40, 6)
    lost = replace(several, diverged_at=np.array([3, -1, -1]))
    bands = free_running_bands(twin, lost, LAW, rng=rng, steps=[10], windows=10**6, draws=2, since=40 + 15)
    np.testing.assert_allclose(bands.actual[0, 0], several.states[1, 25], atol=1e-12)


def test_runs_that_run_away_are_bounded(illustrative, twin, log):
    away = LinearFeedback([[-5.0, -5.0]], [-1e3], [1e3])
    with pytest.warns(LimitWarning, match="drove the log"):
        bands = free_running_bands(twin, log, away, rng=np.random.default_rng(0), steps=[60], windows=5, draws=5)
    assert np.isfinite(bands.lower).all()
    assert (np.abs(bands.upper) <= 1e3 * np.abs(log.states).max(axis=(0, 1))).all()


class WithMemory:
    """A law that cannot be asked out of its loop."""

    def reset(self, n):
        self.sign = np.ones((n, 1))

    def __call__(self, x):
        self.sign *= -1.0
        return self.sign[: len(x)] * LAW(x)


def test_a_controller_that_did_not_drive_the_log_is_told_and_one_that_explored_is_not(illustrative, twin):
    def asked(driving, given):
        fresh = deploy(illustrative.plant, driving, DESIGN, coloured(2, 400, 4), x0=np.zeros(2))
        return free_running_bands(twin, fresh, given, rng=np.random.default_rng(0), steps=[10], windows=50, draws=2)

    own, draws = law(illustrative), np.random.default_rng(5)
    for other in (LinearFeedback(-0.2 * own.K), LinearFeedback(0 * own.K)):
        with pytest.warns(LimitWarning, match="controller: its answers .* Pass the controller that drove the log"):
            asked(own, other)
    for size in (0.0, 0.1, 1.0):
        assert asked(
            lambda x, size=size: own(x) + size * draws.standard_normal((len(x), 1)), own
        )  # warnings are errors
    assert asked(own, WithMemory())


# ── the updated model that draws ──


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": []}, r"steps: got \[\], expected at least one"),
        ({"steps": [0]}, "steps: got 0, expected a whole number"),
        ({"steps": [7000]}, r"steps: got .7000,., expected at most 6000, the longest stretch that the log offers"),
        ({"since": -1}, "since: got -1"),
        ({"since": 10**6}, "steps: got .* expected at most 0"),
        ({"held_out": 2.0}, "held_out: got 2.0"),
        ({"draws": 1}, "draws: got 1"),
        ({"rng": 0}, "rng: got 0"),
    ],
)
def test_bands_that_no_log_can_give_are_refused(twin, log, change, message):
    with pytest.raises(InputError, match=message):
        free_running_bands(twin, log, LAW, **({"rng": np.random.default_rng(0)} | change))


def test_a_twin_that_has_learned_nothing_has_no_bands(illustrative, log):
    with pytest.raises(InputError, match="twin: got one without a discrepancy, expected one after `update`"):
        free_running_bands(DigitalTwin(illustrative.model), log, LAW, rng=np.random.default_rng(0))
