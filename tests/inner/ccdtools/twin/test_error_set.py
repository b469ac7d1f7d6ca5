"""The disturbance set of a log: its share of fresh errors, its shape, and a controller from log to guarantee."""

import numpy as np
import pytest

from ccdtools import InputError, deploy, linear_mpc, load_study, saturated_lqr
from ccdtools.twin import disturbance_set
from ccdtools.twin.residuals import Residuals, residuals

UNITS = np.array([1e-6, 1.0, 1e4])


def errors(rng, runs, steps):
    """Residuals of heavy-tailed, skewed errors that are correlated across states of very different size."""
    mixing = np.array([[1.0, 0.0, 0.0], [0.9, 0.3, 0.0], [-0.5, 0.8, 0.1]])
    drawn = (rng.standard_t(5, (runs, steps, 3)) + rng.exponential(size=(runs, steps, 3))) @ mixing.T * UNITS
    still = np.zeros_like(drawn)
    return Residuals(still, still, np.zeros((runs, steps, 1)), np.ones(1), drawn)


@pytest.mark.parametrize("level", [0.8, 0.95, 0.99])
def test_its_share_of_fresh_errors_is_its_level_on_average(level):
    shares = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        W = disturbance_set(errors(rng, 1, 1000), level=level)
        shares.append(W.contains(errors(rng, 1, 4000).e_next[0]).mean())
    spread = np.std(shares) / np.sqrt(len(shares))
    assert level - 3 * spread <= np.mean(shares) <= level + 0.01 + 3 * spread


def test_units_of_the_states_change_nothing_but_units():
    log = errors(np.random.default_rng(0), 1, 800)
    small = Residuals(log.e, log.x, log.u, log.p, log.e_next / UNITS)
    there, here = disturbance_set(log, level=0.9), disturbance_set(small, level=0.9)
    inside = there.contains(log.e_next[0])
    np.testing.assert_array_equal(inside, here.contains(small.e_next[0]))
    assert 0.85 < inside.mean() < 0.95


def test_it_is_flat_where_errors_enter_one_direction():
    rng = np.random.default_rng(1)
    log = errors(rng, 1, 500)
    along = rng.standard_normal((1, 500, 1)) * [1.0, 2.0, 0.0]
    W = disturbance_set(Residuals(log.e, log.x, log.u, log.p, along), level=0.9)
    np.testing.assert_allclose(W.bounding_box()[1][1], 2 * W.bounding_box()[1][0], rtol=1e-6)
    assert W.bounding_box()[1][2] == pytest.approx(0.0, abs=1e-12)


def test_it_is_no_wider_along_the_states_than_independent_errors_are():
    drawn = np.random.default_rng(2).standard_normal((1, 20000, 2)) * [1.0, 100.0]
    still = np.zeros_like(drawn)
    low, high = disturbance_set(Residuals(still, still, still[..., :1], np.ones(1), drawn), level=0.99).bounding_box()
    np.testing.assert_allclose((high - low) / 2, np.array([2.81, 281.0]), rtol=0.06)  # of √0.99 of a normal, each side


def test_errors_of_one_direction_cost_no_more_than_its_own_quantile():
    along = np.random.default_rng(3).standard_normal((1, 20000, 1)) * [1.0, -2.0, 0.5]
    still = np.zeros_like(along)
    low, high = disturbance_set(Residuals(still, still, still[..., :1], np.ones(1), along), level=0.95).bounding_box()
    np.testing.assert_allclose((high - low) / 2, [1.96, 3.92, 0.98], rtol=0.15)


def test_fewer_errors_than_states_are_held_as_well():
    drawn = np.random.default_rng(4).standard_normal((10, 1, 4))
    still = np.zeros_like(drawn)
    log = Residuals(still, still, still[..., :1], np.ones(1), drawn)
    W = disturbance_set(log, level=0.5, held_out=0.8)
    assert W.contains(drawn[2:, 0]).mean() >= 0.5


def test_from_a_log_to_a_controller_that_keeps_its_limits():
    study = load_study("illustrative")
    problem, real, rng = study.problem(), study.real, np.random.default_rng(0)
    law = saturated_lqr(problem, [3.0])
    log, fresh = (deploy(real.plant, law, [3.0], real.disturbance.sample(60, 100, rng), x0=study.x0) for _ in range(2))
    W = disturbance_set(residuals(problem.model, log), level=0.95)
    assert 0.93 < W.contains(residuals(problem.model, fresh).e_next.reshape(-1, 2)).mean() < 0.98
    robust = linear_mpc(problem, [3.0], W=W)
    room = [h - bounds[-1] for (_, h), bounds in ((robust.state_rows, robust.bounds["state"]),)]
    assert (room[0] > 0).all()


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"level": 0.999}, "at least 999"),
        ({"level": 1.5}, "level"),
        ({"held_out": 0.0}, "held_out"),
        ({"logs": []}, "logs"),
        ({"logs": [1.0]}, "Residuals"),
    ],
)
def test_wrong_calls_are_named(given, says):
    with pytest.raises(InputError, match=says):
        disturbance_set(**{"logs": errors(np.random.default_rng(0), 1, 500), **given})


def test_errors_in_a_direction_that_was_flat_before_are_held():
    drawn = np.random.default_rng(5).standard_normal((5, 400, 2))
    drawn[:4, :, 1] = 0.0  # the last run, which calibrates, has errors of this state, too
    still = np.zeros_like(drawn)
    W = disturbance_set(Residuals(still, still, still[..., :1], np.ones(1), drawn), level=0.9)
    assert W.contains(drawn[4]).mean() >= 0.9


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_errors_that_are_no_numbers_are_named(value):
    log = errors(np.random.default_rng(0), 1, 500)
    broken = log.e_next.copy()
    broken[0, 3, 1] = value
    with pytest.raises(InputError, match="e_next"):
        disturbance_set(Residuals(log.e, log.x, log.u, log.p, broken))


def test_logs_of_two_designs_are_refused():
    log = errors(np.random.default_rng(0), 1, 500)
    other = Residuals(log.e, log.x, log.u, 2 * log.p, log.e_next)
    with pytest.raises(InputError, match="one design"):
        disturbance_set([log, other])
    assert disturbance_set([log, log]).dim == 3
