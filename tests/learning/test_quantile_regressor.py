"""QuantileRegressor keeps scikit-learn's conventions, without scikit-learn, and holds its level with few samples."""

import copy
import pickle
import sys
import types

import numpy as np
import pytest

from learning import InputError, QuantileConfig, QuantileRegressor, fit_quantiles


def samples(n, seed):
    """y = sin(2 x₁) + (0.2 + 0.4 x₂²) ε."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1, 1, (n, 2))
    return x, np.sin(2 * x[:, 0]) + (0.2 + 0.4 * x[:, 1] ** 2) * rng.standard_normal(n)


def cloned(estimator):
    """What scikit-learn's `clone` makes and checks."""
    params = {name: copy.deepcopy(value) for name, value in estimator.get_params(deep=False).items()}
    made = type(estimator)(**params)
    assert all(made.get_params(deep=False)[name] is value for name, value in params.items())
    return made


def test_an_estimator_is_cloned_set_fitted_and_asked():
    x, y = samples(200, 0)
    estimator = QuantileRegressor(steps=20).set_params(hidden=(8,))
    assert estimator.fit(x, y) is estimator
    assert estimator.n_features_in_ == 2
    assert estimator.predict(x).shape == (200, 3)
    again = cloned(estimator)
    assert again.get_params() == estimator.get_params()
    with pytest.raises(InputError, match="without a fit"):
        again.predict(x)
    np.testing.assert_array_equal(again.fit(x, y).predict(x), estimator.predict(x))
    for wrong in (np.nan, np.inf):
        with pytest.raises(InputError, match="X: got NaN or infinity"):
            estimator.predict(np.where(x == x[0, 0], wrong, x))


def test_it_fits_what_fit_quantiles_fits():
    x, y = samples(200, 1)
    network = fit_quantiles(x, y, rng=np.random.default_rng(7), config=QuantileConfig(steps=20))
    one = QuantileRegressor(steps=20, random_state=7).fit(x, y[:, None])
    np.testing.assert_array_equal(one.predict(x), network.predict(x))


@pytest.mark.parametrize("offset", [101325.0, 5.4e6, 5e7])
def test_an_offset_of_targets_and_inputs_moves_what_it_tells_and_no_more(offset):
    x, y = samples(300, 0)
    plain, moved = (
        QuantileRegressor(steps=60).fit(x + away, y + away).predict(x[:50] + away) - away for away in (0.0, offset)
    )
    np.testing.assert_allclose(moved, plain, atol=1e-3)
    assert (np.diff(moved, axis=1) > 0).all()


def test_its_score_is_minus_the_pinball_loss():
    x, y = samples(200, 2)
    one = QuantileRegressor(levels=(0.1, 0.5, 0.9), steps=20).fit(x, y)
    error = y[:, None] - one.predict(x)
    by_hand = np.mean([np.where(e > 0, q * e, (q - 1) * e) for q, e in zip((0.1, 0.5, 0.9), error.T)])
    assert one.score(x, y) == pytest.approx(-by_hand)


def test_a_fold_of_few_samples_has_a_score():
    x, y = samples(60, 2)
    one = QuantileRegressor(steps=20).fit(x[:48], y[:48])
    alone = [one.score(x[i : i + 1], y[i : i + 1]) for i in range(48, 60)]
    assert one.score(x[48:], y[48:]) == pytest.approx(np.mean(alone))
    with pytest.raises(InputError, match="y: got 2 targets, expected 1"):
        one.score(x, np.column_stack([y, y]))


@pytest.mark.parametrize("state", [-1, 1.5, "seed"])
def test_a_seed_that_is_none_is_named(state):
    with pytest.raises(InputError, match="random_state: got"):
        QuantileRegressor(random_state=state).fit(*samples(50, 0))


def test_samples_without_inputs_or_targets_are_refused():
    x, y = samples(50, 0)
    for given, words in (
        ((x[:, :0], y), r"X: got shape \(50, 0\).* 0 feature"),
        ((x, y[:, None][:, :0]), "got shapes"),
    ):
        with pytest.raises(InputError, match=words):
            QuantileRegressor().fit(*given)


class Sparse:
    """What scipy and scikit-learn know a sparse array by."""

    def toarray(self):
        return np.zeros((50, 2))


def test_what_is_no_array_of_real_numbers_is_refused_in_the_words_that_scikit_learn_looks_for():
    x, y = samples(50, 0)
    cases = [
        ((Sparse(), y), "X: got a sparse array.*Sparse data is not supported"),
        ((x + 1j, y), "X: .*Complex data not supported"), ((x, None), "requires y to be passed"),
        ((np.full((50, 2), {}), y), "X: got objects"),
        ((x[:, 0], y), r"X: got shape \(50,\).*Reshape your data"), ((x[:1], y[:1]), r"1 sample\(s\) of \d feature"),
    ]  # fmt: skip
    for given, words in cases:
        with pytest.raises(InputError, match=words):
            QuantileRegressor(steps=2, hidden=(4,)).fit(*given)
    numbers = QuantileRegressor(steps=2, hidden=(4,)).fit(x.astype(object), y)
    with pytest.raises(InputError, match="Reshape your data"):
        numbers.predict(x[0])


def test_before_a_fit_the_error_is_one_that_scikit_learn_knows_where_it_is_installed(monkeypatch):
    exceptions = types.ModuleType("sklearn.exceptions")
    exceptions.NotFittedError = type("NotFittedError", (ValueError, AttributeError), {})
    monkeypatch.setitem(sys.modules, "sklearn", types.ModuleType("sklearn"))
    monkeypatch.setitem(sys.modules, "sklearn.exceptions", exceptions)
    with pytest.raises(exceptions.NotFittedError, match="after `fit`") as raised:
        QuantileRegressor().predict(np.zeros((3, 2)))
    assert isinstance(pickle.loads(pickle.dumps(raised.value)), exceptions.NotFittedError)
    monkeypatch.setitem(sys.modules, "sklearn.exceptions", None)
    with pytest.raises(InputError, match="after `fit`"):
        QuantileRegressor().predict(np.zeros((3, 2)))


def test_arguments_are_checked_by_fit_and_unknown_ones_refused():
    with pytest.raises(InputError, match="steps: got 0"):
        QuantileRegressor(steps=0).fit(*samples(50, 0))
    with pytest.raises(InputError, match="depth: got no argument of QuantileRegressor"):
        QuantileRegressor().set_params(depth=3)


@pytest.mark.check
def test_sixty_fits_to_fifty_samples_hold_what_they_promise():
    covered = []
    for seed in range(60):
        fresh, after = samples(1000, 1000 + seed)
        q = QuantileRegressor(hidden=(8,), steps=40).fit(*samples(50, seed)).predict(fresh)
        assert (np.diff(q, axis=1) >= 0).all()
        covered.append(np.mean((after >= q[:, 0]) & (after <= q[:, 2])))
    assert np.mean(covered) > 0.77


def test_too_few_samples_are_refused_with_the_number_needed():
    with pytest.raises(InputError, match=r"30 samples, of which 6 calibrate .* expected at least 9: some 45 samples"):
        QuantileRegressor().fit(*samples(30, 0))
    assert np.isfinite(QuantileRegressor(steps=5).fit(*samples(45, 0)).predict(samples(5, 1)[0])).all()
