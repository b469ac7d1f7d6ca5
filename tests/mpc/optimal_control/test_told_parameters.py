"""What an estimate says of its parameters: that it is a minimum, and what the data tell, in whatever units."""

import casadi as ca
import numpy as np
import pytest

from mpc import InputError
from mpc.optimal_control.estimation import EstimationStatus, Experiment, estimate_parameters

TIMES = np.linspace(0, 4, 21)
CONSTANT = {"dynamics": lambda x: 0 * x, "states": 1}


def seen_crudely(seed=0):
    """Log of p and of the response to (p - 1)², whose sensors are best explained by p on either side of 1."""
    noise = 0.5 * np.random.default_rng(seed).normal(size=(2, 21))
    return np.column_stack([1 + noise[0] - noise[0].mean(), 2 - 2 * np.exp(-TIMES) + noise[1]])


@pytest.mark.parametrize("guess", [None, [1.0], [1.1], [0.9]])
def test_a_maximum_between_two_minima_is_left(guess):
    y = seen_crudely()
    found = estimate_parameters(
        Experiment(TIMES, y, start=[0.0]), lambda x, p: -x + (p - 1) ** 2, lambda x, p: ca.vertcat(p, x), states=1,
        p_bounds=([-3], [5]), p_guess=guess, noise=[0.25, 0.25],
    )  # fmt: skip
    assert found.solved
    np.testing.assert_allclose(np.abs(found.p - 1), 1.10947, atol=1e-5)


def test_a_product_that_begins_at_zero_is_left_where_its_factors_have_no_bounds():
    """Its slopes vanish there, so that no solver moves: p1 (1 - exp(-p2 t))."""
    t, y = np.array([0, 1, 2, 3, 4, 5, 7]), np.array([np.nan, 8.3, 10.3, 19, 16, 15.6, 19.8])
    found = estimate_parameters(
        Experiment(t, y, start=[0.0]), output=lambda p, t: p[0] * (1 - ca.exp(-p[1] * t)),
        p_bounds=([None] * 2, [None] * 2), **CONSTANT,
    )  # fmt: skip
    assert found.solved
    np.testing.assert_allclose(found.residual_variance * found.degrees, 25.990267, rtol=1e-6)


def test_first_states_of_a_saddle_are_left():
    t = np.linspace(0, 6, 61)
    y = np.cos(0.8 * np.cos(1.3 * t)) + 0.01 * np.random.default_rng(0).normal(size=61)
    found = estimate_parameters(
        Experiment(t, y), lambda x, p: ca.vertcat(x[1], -p * x[0]), lambda x: ca.cos(x[0]), states=2,
        p_bounds=([0], [5]), noise=[1e-4],
    )  # fmt: skip
    assert found.solved
    np.testing.assert_allclose(found.p, 1.69, rtol=0.03)


def test_maxima_of_several_parameters_are_left_at_once():
    t = np.linspace(0, 3, 31)
    y = np.cos(t[:, None] * [1.3, 0.7]) + 0.05 * np.random.default_rng(0).normal(size=(31, 2))
    found = estimate_parameters(
        Experiment(t, y, start=[0.0]), output=lambda p, t: ca.cos(p * t), p_bounds=([-5] * 2, [5] * 2), p_guess=[0, 0], noise=[0.0025] * 2,
        **CONSTANT,
    )  # fmt: skip
    assert found.solved
    np.testing.assert_allclose(np.abs(found.p), [1.3, 0.7], atol=0.05)


def test_a_maximum_that_is_not_left_is_not_solved(monkeypatch):
    monkeypatch.setattr("mpc.optimal_control.estimation.curvature.SHAKEN", 0.0)
    found = estimate_parameters(
        Experiment(TIMES, seen_crudely(), start=[0.0]), lambda x, p: -x + (p - 1) ** 2, lambda x, p: ca.vertcat(p, x),
        states=1, p_bounds=([-3], [5]), p_guess=[1.0], noise=[0.25, 0.25],
    )  # fmt: skip
    np.testing.assert_allclose(found.p, 1.0, atol=1e-6)
    assert found.status is EstimationStatus.UNSOLVED
    assert np.isnan(found.intervals()).all()


@pytest.mark.parametrize("guess", [None, [1, 1e-6], [1, 100.0], [1, 1e6]])
@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_an_offset_beside_a_steep_course_is_told_in_whatever_units(unit, guess):
    """It was called not told, its deviation infinite, without a guess of about its size."""
    t = np.linspace(0, 6, 60)
    y = np.exp(2 * t) + 1 + np.random.default_rng(0).normal(size=60)
    slopes = np.column_stack([t * np.exp(2 * t), np.ones(60), np.exp(2 * t)])
    found = estimate_parameters(
        Experiment(t, y), lambda x, p: p[0] * x, lambda x, p: x + unit * p[1], states=1,
        p_bounds=([None] * 2, [None] * 2), noise=[1.0], p_guess=None if guess is None else [guess[0], guess[1] / unit],
    )  # fmt: skip
    deviations = np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))[:2]
    np.testing.assert_allclose(found.deviations * [1, unit], deviations, rtol=1e-4)


def test_a_parameter_that_nothing_depends_on_takes_no_degree_of_freedom():
    y = 1 + 0.1 * np.random.default_rng(3).normal(size=6)
    for count in (1, 3, 5):
        found = estimate_parameters(
            Experiment(np.arange(6.0), y, start=[0.0]), output=lambda p: p[0], p_bounds=([0] * count, [5] * count),
            **CONSTANT,
        )  # fmt: skip
        assert found.degrees == 5
        np.testing.assert_allclose(found.deviations[0], y.std(ddof=1) / np.sqrt(6), rtol=1e-5)


def test_an_input_may_be_a_function_that_returns_one_number_a_time():
    given = {"dynamics": lambda x, u, p: -p * x + u, "output": lambda x: x, "states": 1, "p_bounds": ([0], [5])}
    y = np.exp(-TIMES)
    flat, column = (
        estimate_parameters(Experiment(TIMES, y, inputs=one), **given)
        for one in (np.sin, lambda times: np.sin(times)[:, None])
    )
    np.testing.assert_array_equal(flat.p, column.p)


@pytest.mark.parametrize(
    "inputs",
    [
        lambda times: np.zeros((2, len(times))), lambda times: 1.0, lambda times: np.full((len(times), 1), np.nan),
        lambda times: times[100],
    ],
)  # fmt: skip
def test_functions_that_return_no_inputs_are_named(inputs):
    with pytest.raises(InputError, match=r"^inputs: "):
        estimate_parameters(
            Experiment(TIMES, np.exp(-TIMES), inputs=inputs), lambda x, u, p: -p * x + u[0], lambda x: x, states=1,
            p_bounds=([0], [5]),
        )  # fmt: skip


def test_experiments_whose_functions_return_other_numbers_of_inputs_are_named():
    logs = [Experiment(TIMES, np.exp(-TIMES), inputs=lambda times, nu=nu: np.zeros((len(times), nu))) for nu in (1, 2)]
    with pytest.raises(InputError, match=r"^experiments: got \[1, 2\] inputs"):
        estimate_parameters(logs, lambda x, u, p: -p * x + u[0], lambda x: x, states=1, p_bounds=([0], [5]))


def test_a_guess_at_which_a_function_is_not_finite_is_called_p_guess():
    with pytest.raises(InputError, match=r"^p_guess: .*Give a `p_guess`"):
        estimate_parameters(
            Experiment(TIMES, np.exp(-TIMES)), lambda x, p: -x / p, lambda x: x, states=1, p_bounds=([None], [None])
        )
