"""The digital twin: residuals by definition, an update that helps, and a model that plays it back."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ccdtools import (
    DigitalTwin,
    InputError,
    LinearFeedback,
    Nested,
    Search,
    closed_loop_returns,
    codesign,
    saturated_lqr,
    simulate,
)
from ccdtools.twin import updated_problem
from learning import QuantileConfig
from mpc import lqr

DESIGN = [2.0]
SHORT = QuantileConfig(hidden=(16, 16), steps=500, batch=256)


def driven(study, design, runs, steps, seed, real=True):
    """A log of saturated LQR on the real plant."""
    A, B, _ = study.model.matrices(design)
    law = LinearFeedback(lqr(A, B, Q=study.objective.Q, R=study.objective.R)[0], *study.problem().input_bounds)
    rng = np.random.default_rng(seed)
    return simulate(
        study.real.plant if real else study.model, law, x0=np.tile([-2.0, -2.0], (runs, 1)), steps=steps,
        disturbance=study.real.disturbance, design=design, limit=study.problem().limit, rng=rng,
    )  # fmt: skip


@pytest.fixture(scope="module")
def log(illustrative):
    return driven(illustrative, DESIGN, 60, 100, 0)


@pytest.fixture(scope="module")
def twin(illustrative, log):
    return DigitalTwin(illustrative.model).update(
        log, weight=illustrative.weight, rng=np.random.default_rng(1), config=SHORT
    )


# ── residuals ──


# ── the split in time ──


# ── the update ──


@pytest.mark.check
def test_an_update_is_a_new_twin_and_the_old_one_is_unchanged(illustrative, log):
    old = DigitalTwin(illustrative.model)
    quick = replace(SHORT, steps=5)
    new = old.update(log, weight=illustrative.weight, rng=np.random.default_rng(0), config=quick)
    assert (old.logs, old.discrepancy, old.scores) == ((), None, None)
    newer = new.update(log, weight=illustrative.weight, rng=np.random.default_rng(0), config=quick)
    assert len(new.logs) == 1
    assert len(newer.logs) == 2
    assert newer.discrepancy is not new.discrepancy


@pytest.mark.check
def test_the_one_step_error_falls_on_a_held_out_stretch(twin):
    scores = twin.scores
    assert (np.array(scores.rmse) < 0.8 * np.array(scores.nominal_rmse)).all()
    floor = np.sqrt(np.array([0.1, 0.2]) ** 2 + 0.1**2 / 3)  # the noise of the real plant, which nothing predicts
    np.testing.assert_allclose(scores.rmse, floor, rtol=0.08)


@pytest.mark.long
def test_the_pinball_loss_is_below_that_of_constant_quantiles(twin):
    assert (np.array(twin.scores.pinball) < 0.97 * np.array(twin.scores.constant_pinball)).all()


def test_the_held_out_coverage_is_nominal(twin):
    assert twin.scores.nominal_coverage == pytest.approx(0.8)
    assert twin.scores.samples == 12 * 100
    np.testing.assert_allclose(twin.scores.coverage, 0.8, atol=0.05)


def test_the_scores_are_those_of_the_held_out_runs(twin, illustrative, log):
    r = twin.logs[0].part(slice(48, None), slice(None))
    error = r.e_next - twin.discrepancy.median(r)
    np.testing.assert_allclose(np.sqrt(np.mean(error**2, axis=(0, 1))), twin.scores.rmse, rtol=1e-4)
    np.testing.assert_allclose(np.sqrt(np.mean(r.e_next**2, axis=(0, 1))), twin.scores.nominal_rmse, rtol=1e-12)


def test_the_median_finds_the_bias_of_the_real_plant(twin, illustrative):
    # At the origin of the state with u = 0 the real plant adds (0.1, −0.2) (its own equations).
    zero = {"e": torch.zeros(1, 2), "x": torch.zeros(1, 2), "u": torch.zeros(1, 1), "p": torch.tensor([2.0])}
    median = twin.discrepancy.network(twin.discrepancy.features(**zero))[0, 1].detach()
    np.testing.assert_allclose(median, [0.1, -0.2], atol=0.12)


def test_the_design_may_be_a_feature(illustrative, log):
    twin = DigitalTwin(illustrative.model).update(
        log, weight=illustrative.weight, rng=np.random.default_rng(0), config=replace(SHORT, steps=3),
        design_as_feature=True,
    )  # fmt: skip
    assert len(twin.discrepancy.network.input_offset) == 6
    assert twin.discrepancy.median(twin.logs[0]).shape == (60, 100, 2)


def test_innovations_are_what_the_median_left_unexplained(twin):
    (rest,) = twin.innovations()
    np.testing.assert_allclose(rest.e_next + twin.discrepancy.median(twin.logs[0]), twin.logs[0].e_next, atol=1e-12)
    np.testing.assert_array_equal(rest.e, twin.logs[0].e)


def test_a_twin_that_has_learned_nothing_has_no_innovations(illustrative):
    with pytest.raises(InputError, match="twin: got one without a discrepancy, expected one after `update`"):
        DigitalTwin(illustrative.model).innovations()


def test_a_log_too_short_to_hold_anything_out_is_refused(illustrative):
    log = driven(illustrative, DESIGN, 1, 20, 0)
    with pytest.raises(InputError, match=r"held_out: got 0.2 of 10 blocks of a log of 20 samples, which leaves none"):
        DigitalTwin(illustrative.model).update(log, weight=illustrative.weight, rng=np.random.default_rng(0), blocks=10)


@pytest.mark.parametrize(
    ("runs", "steps", "options", "message"),
    [
        (1, 800, {"held_out": 0.999}, "held_out: got 0.999 of 20 blocks .* leaves 0 samples to train on"),
        (1, 30, {"blocks": 60, "held_out": 0.6}, "held_out: got 0.6 of 60 blocks .* leaves 0 samples to train on"),
        (3, 30, {"held_out": 0.9}, "held_out: got 0.9 of 3 runs, which leaves 0 samples to train on, expected at"),
        (1, 12, {}, "log: got 0.2 of 20 blocks of a log of 12 samples, which leaves 12 samples"),
    ],
)
def test_a_split_that_leaves_nothing_to_train_on_is_refused_by_what_was_passed(
    illustrative, runs, steps, options, message
):  # fmt: skip
    log = driven(illustrative, DESIGN, runs, steps, 0)
    with pytest.raises(InputError, match=message):
        DigitalTwin(illustrative.model).update(
            log, weight=illustrative.weight, rng=np.random.default_rng(0), **options
        )  # fmt: skip


@pytest.mark.parametrize("gap", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["states", "inputs"])
def test_a_log_with_gaps_is_named(illustrative, gap, name):
    log = driven(illustrative, DESIGN, 1, 100, 0)
    values = np.array(getattr(log, name))
    values[0, 50] = gap
    with pytest.raises(InputError, match=f"log.{name}: got (nan|-?inf) at index"):
        DigitalTwin(illustrative.model).update(
            replace(log, **{name: values}), weight=illustrative.weight, rng=np.random.default_rng(0)
        )


def test_more_blocks_than_samples_are_as_many_as_there_are(illustrative):
    log = driven(illustrative, DESIGN, 1, 60, 0)
    twin = DigitalTwin(illustrative.model).update(
        log, weight=illustrative.weight, rng=np.random.default_rng(0), blocks=35, held_out=0.45,
        config=replace(SHORT, steps=2, calibration=0.3),
    )  # fmt: skip
    assert twin.scores.samples + 35 == 60  # one to train on in each, of one sample or two


# ── the learned model ──


@pytest.mark.long
@pytest.mark.quick(1)
@pytest.mark.parametrize("method", [Nested("lqr", evaluations=5), Search("cma", evaluations=8)])
def test_methods_of_the_model_redesign_on_an_updated_problem_whose_limits_act(illustrative, twin, method):
    problem = updated_problem(illustrative.problem(), twin)  # whose tolerance MPC says, in double precision
    narrow = replace(problem, X=([-4, -2.2], [4, 1.0]), steps=20)
    result = codesign(narrow, method=method, design=DESIGN, rng=np.random.default_rng(0))
    law = saturated_lqr(narrow, result.design)
    own = closed_loop_returns(narrow, law, result.design, np.random.default_rng(1), runs=500)
    assert result.closed_loop.summary.mean == pytest.approx(own.summary.mean, abs=0.8)  # five standard errors
