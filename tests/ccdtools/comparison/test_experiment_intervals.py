"""Intervals of values, gains and shares over seeds and runs."""

import numpy as np
import pytest
from scalar_experiment import GAIN, LAWS, OBJECTIVE, PLANT, WEAK, always, drawn, found
from scipy.stats import binomtest

from ccdtools import LinearFeedback, Measurement, Scenario, compare


def test_the_table_has_the_interval_of_the_share_of_runs_that_are_better():
    result = found()
    cell = result["learned"]
    low, high = cell.better.ci95
    assert 0.0 <= low <= cell.better.mean <= high <= 1.0
    assert f" {100 * cell.better.mean:.0f} % [{100 * low:.0f}, {100 * high:.0f}] " in repr(result)


def test_one_seed_on_one_scenario_says_what_compare_says():
    scenario = drawn(np.random.default_rng(5))
    laws = {"LQR": LinearFeedback([[GAIN]]), "weak": LinearFeedback([[0.3]])}
    cell = found(always(laws), scenario, seeds=1)["weak"]
    score = compare(laws, scenario, objective=OBJECTIVE, X=([-50.0], [50.0]))["weak"]
    assert cell.evidence.gain.ci95 == pytest.approx(score.paired_to_lqr.ci95)
    assert cell.value.ci95 == pytest.approx(score.summary.ci95)


def test_the_interval_holds_chance_of_training_and_of_runs():
    """With the same runs for all seeds a deterministic controller has the interval of its runs."""
    scenario = drawn(np.random.default_rng(5))
    cell = found(WEAK, scenario, seeds=6)["weak"]
    alone = found(WEAK, scenario, seeds=1)["weak"]
    assert cell.evidence.gain.ci95 == pytest.approx(alone.evidence.gain.ci95)
    varied = {"LQR": LAWS["LQR"], "weak": lambda design, rng: LinearFeedback([[0.2 + 0.2 * rng.random()]])}
    result = found(varied, scenario, seeds=6)
    low, high = result["weak"].evidence.gain.ci95
    rows = result.rows()
    weak = [[row["return"] for row in rows if (row["controller"], row["seed"]) == ("weak", k)] for k in range(6)]
    means = np.mean(weak, axis=1)
    assert (high - low) / 2 > 2 * np.std(means, ddof=1) / np.sqrt(6)


def test_few_seeds_are_said_to_be_too_few_for_their_intervals():
    assert "9 seeds are too few for 95 % where returns are skewed: take 10 or more." in repr(found(seeds=9))
    assert "too few" not in repr(found(seeds=10))


def test_the_interquartile_mean_does_not_follow_one_bad_seed():
    def unlucky(design, rng):
        return LinearFeedback([[GAIN if made.append(0) or len(made) != 3 else -0.09]])

    made = []
    cell = found({"LQR": LAWS["LQR"], "unlucky": unlucky}, drawn(np.random.default_rng(5)), seeds=8)["unlucky"]
    base = found(seeds=8, scenarios=drawn(np.random.default_rng(5)))["LQR"]
    assert cell.middle.mean == pytest.approx(base.value.mean)
    assert cell.value.mean < base.value.mean - 1


def test_a_drive_that_is_lost_with_one_seed_leaves_the_others_their_interval():
    drive = Scenario(PLANT, [[1.0]], np.random.default_rng(3).standard_normal((400, 1)))
    made = []

    def base(design, rng):
        made.append(0)
        return LinearFeedback([[GAIN if len(made) != 2 else -2.0]])

    same = {"LQR": base, "B": LAWS["LQR"]}
    cell = found(same, drive, seeds=4, limit=[1e4])["B"]
    assert cell.evidence.lost == (0, 1)
    assert cell.evidence.gain.ci95 == (0.0, 0.0)
    clean = found({"LQR": LAWS["LQR"]}, drive, seeds=4)["LQR"]
    assert cell.value.ci95 == pytest.approx(clean.value.ci95)


def test_one_drawn_run_has_no_interval():
    def start(rng):
        return Scenario(PLANT, rng.standard_normal((1, 1)), np.zeros((15, 1)))

    cell = found(WEAK, start, seeds=1)["weak"]
    assert np.isnan(cell.evidence.gain.ci95).all()
    assert cell.word == "open"


def test_one_run_whose_measurement_is_noisy_has_the_interval_that_compare_gives_it():
    class FromOutput:
        needs = frozenset({"output"})

        def __init__(self, gain):
            self.gain = gain

        def __call__(self, x, y):
            return -self.gain * y

    noise = 0.3 * np.random.default_rng(0).standard_normal((1, 200, 1))
    run = Scenario(PLANT, [[0.0]], np.zeros((1, 200, 1)), output=Measurement([[1.0]], noise=noise))
    cell = found({"LQR": lambda p, rng: FromOutput(0.5), "weak": lambda p, rng: FromOutput(0.4)}, run, seeds=3)["weak"]
    both = compare({"LQR": FromOutput(0.5), "weak": FromOutput(0.4)}, run, objective=OBJECTIVE, X=(-50, 50))
    low, high = cell.evidence.gain.ci95
    assert low < cell.evidence.gain.mean < high
    assert (low, high) == pytest.approx(both["weak"].paired_to_lqr.ci95)


def test_a_function_that_always_returns_the_same_runs_is_taken_as_these_runs():
    scenario = drawn(np.random.default_rng(5))
    one, other = (found(WEAK, given, seeds=5)["weak"].evidence.gain for given in (scenario, lambda rng: scenario))
    assert one.ci95 == pytest.approx(other.ci95)


@pytest.mark.parametrize("seeds", [1, 3, 12])
@pytest.mark.parametrize("fresh", [True, False])
def test_a_share_of_all_runs_or_of_none_has_an_interval(seeds, fresh):
    """There it is that of Clopper and Pearson: of the runs of one seed, of fresh seeds, or of the fewer of both."""
    laws = {"LQR": LAWS["LQR"], "wild": lambda p, rng: lambda x: -9.0 * np.ones((len(x), 1))}
    for (one, other), at in ((laws, 0), (reversed(laws), 1)):
        start = drawn if fresh else drawn(np.random.default_rng(5))
        better = found(laws, start, seeds=seeds, baseline=one)[other].better
        n = 7 if seeds == 1 else seeds if fresh else min(seeds, 7)
        assert better.mean == at
        expected = binomtest(at * n, n).proportion_ci()
        assert better.ci95 == pytest.approx((expected.low, expected.high), abs=1e-9)


def test_a_share_of_the_runs_of_one_seed_has_the_exact_interval():
    better = found(WEAK, seeds=1)["weak"].better
    won = round(7 * better.mean)
    expected = binomtest(won, 7).proportion_ci()
    assert 0 < won < 7
    assert better.ci95 == pytest.approx((expected.low, expected.high), abs=1e-9)
