"""Disturbances made of others: side by side, held over a run, one of several."""

import numpy as np
import pytest

from ccdtools import Gaussian, InputError, Recorded
from ccdtools.disturbances import Constant, Mixture, Stacked, Sum, Uniform

MASS = Constant(Uniform([-0.2], [0.4]))


def test_stacked_channels_keep_their_order_and_are_independent(rng):
    w = Stacked((Gaussian([1.0, 10.0]), Uniform([5.0], [6.0]))).sample(300, 200, rng)
    assert w.shape == (300, 200, 3)
    np.testing.assert_allclose(w[..., :2].std(axis=(0, 1)), [1.0, 10.0], rtol=0.01)
    assert ((w[..., 2] >= 5) & (w[..., 2] <= 6)).all()
    assert np.abs(np.corrcoef(w.reshape(-1, 3).T) - np.eye(3)).max() < 0.02


def test_a_constant_is_held_over_a_run_and_drawn_anew_for_the_next(rng):
    w = MASS.sample(4000, 7, rng)
    assert (np.ptp(w, axis=1) == 0).all()
    first = w[:, 0, 0]
    assert len(np.unique(first)) == 4000
    assert first.mean() == pytest.approx(0.1, abs=0.01)
    assert first.std() == pytest.approx(0.6 / np.sqrt(12), rel=0.05)


def test_a_mixture_draws_a_whole_run_from_one_of_its_terms(rng):
    w = Mixture((Uniform([0.0], [1.0]), Uniform([10.0], [11.0])), weights=(1, 3)).sample(4000, 5, rng)
    second = (w >= 10).all(axis=(1, 2))
    assert (second | (w <= 1).all(axis=(1, 2))).all()
    assert second.mean() == pytest.approx(0.75, abs=0.025)


def test_terms_of_no_weight_are_never_drawn(rng):
    assert not Mixture((Uniform([0.0], [0.0]), Uniform([1.0], [1.0])), weights=(1, 0)).sample(100, 2, rng).any()


def test_a_recording_in_a_mixture_is_met_in_windows_even_if_one_run_draws_it(rng):
    mixed = Mixture((Recorded(np.arange(1.0, 100.0)), Gaussian([0.0])), weights=(0.02, 1.0))
    starts = np.concatenate([mixed.sample(60, 3, rng)[:, 0, 0] for _ in range(40)])
    assert len(np.unique(starts[starts > 0])) > 15


def test_combinations_nest_and_know_their_channels(rng):
    road = Mixture((Gaussian([0.1]), Sum((Gaussian([0.1]), Uniform([0], [1])))))
    both = Stacked((road, MASS))
    assert both.nw == 2
    assert both.sample(3, 4, rng).shape == (3, 4, 2)
    assert Constant(Stacked((MASS, Gaussian([1.0])))).nw == 2


class Drawn:
    """A disturbance that does not say how many channels it has."""

    def sample(self, runs, steps, rng):
        return rng.random((runs, steps, 2))


def test_what_does_not_know_its_channels_is_taken_as_it_comes(rng):
    assert Stacked((Drawn(), MASS)).nw is None
    assert Stacked((Drawn(), MASS)).sample(2, 3, rng).shape == (2, 3, 3)
    with pytest.raises(InputError, match="terms: got disturbances of 2, 1 channels"):
        Mixture((Drawn(), MASS)).sample(50, 3, rng)


@pytest.mark.parametrize("disturbance", [MASS, Stacked((MASS, Gaussian([1.0]))), Mixture((MASS, Gaussian([1.0])))])
def test_the_generator_decides(disturbance):
    a, b, c = (disturbance.sample(20, 5, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Stacked(()), "terms: got .* expected a tuple of disturbances"),
        (lambda: Stacked(Gaussian([1.0])), "terms: got a Gaussian, expected a tuple"),
        (lambda: Stacked((Gaussian,)), "terms: got the class Gaussian"),
        (lambda: Mixture((Gaussian([1.0]), Gaussian([1.0, 1.0]))), "terms: got disturbances of 1, 2 channels"),
        (lambda: Mixture((MASS, MASS), weights=(1,)), r"weights: got shape \(1,\), expected 2 numbers, one per term"),
        (lambda: Mixture((MASS, MASS), weights=(1, -1)), "weights: got .* expected numbers ≥ 0"),
        (lambda: Mixture((MASS, MASS), weights=(0, 0)), "weights: got .* expected numbers ≥ 0"),
        (lambda: Constant(0.2), "distribution: got 0.2, expected a disturbance"),
        (lambda: MASS.sample(2, 2, 0), "rng: got 0"),
    ],
)
def test_bad_combinations_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
