"""Moving-horizon estimates after outputs and inputs that lead to where a model is not finite."""

import casadi as ca
import numpy as np
import pytest

from mpc import InputError
from mpc.optimal_control.estimation import MovingHorizonEstimator

NO_INPUT = np.zeros((1, 0))
FILLING = lambda x, w: 0.95 * x + 0.05 + w  # noqa: E731


def met(estimator, outputs):
    """Beliefs after outputs (n, ny), without inputs."""
    belief, found = estimator.start(1), []
    for k, y in enumerate(outputs):
        belief = estimator.predict(belief, NO_INPUT) if k else belief
        belief = estimator.update(belief, [y], NO_INPUT)
        found.append(belief)
    return found


def settled(step, output, level, outlier, window, unit=1.0):
    """Beliefs of a level that rests, with one outlier."""
    estimator = MovingHorizonEstimator(
        lambda x, w: unit * step(x / unit, w / unit), lambda x: output(x / unit), 1, 0, window=window,
        W=[1e-4 * unit**2], V=[1e-4], P0=[unit**2], x0=[0.7 * unit * level],
    )  # fmt: skip
    outputs = np.full(25, float(output(ca.DM(level))))
    outputs[10] = outlier
    return met(estimator, outputs[:, None])


@pytest.mark.parametrize("window", [1, 2, 5])
@pytest.mark.parametrize(
    ("step", "output", "outlier"),
    [
        (FILLING, ca.sqrt, -50.0), (FILLING, ca.sqrt, -1e6), (FILLING, ca.log, -50.0),
    ],
)  # fmt: skip
@pytest.mark.parametrize("unit", [1.0, 1e6])
def test_an_output_that_leads_to_where_the_model_is_not_finite_is_left_out(step, output, outlier, window, unit):
    """Every later estimate was NaN."""
    beliefs = settled(step, output, 1.0, outlier, window, unit)
    without = settled(step, output, 1.0, np.nan, window, unit)
    assert [belief.status[0].name for belief in beliefs] == ["SOLVED"] * 10 + ["HELD"] + ["SOLVED"] * 14
    assert "x_bounds" in beliefs[10].status[0].advice
    for one, other in zip(beliefs, without):
        np.testing.assert_allclose(one.mean, other.mean, atol=1e-4 * unit)
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=0.02)


@pytest.mark.parametrize("window", [1, 2, 5])
def test_outputs_that_lead_to_where_the_step_has_no_value_are_left_out_of_its_prediction(window):
    emptying = lambda x, w: x - 0.1 * ca.sqrt(x) + 0.1 + w  # noqa: E731
    beliefs = settled(emptying, lambda x: x, 1.0, -50.0, window)
    without = settled(emptying, lambda x: x, 1.0, np.nan, window)
    assert beliefs[10].mean < 0  # as any output that a model can explain
    assert [belief.status[0].name for belief in beliefs[10:]] == ["SOLVED", "HELD"] + ["SOLVED"] * 13
    for one, other in zip(beliefs[11:], without[11:]):
        np.testing.assert_allclose(one.mean, other.mean, atol=1e-4)


def test_inputs_that_lead_to_where_the_model_is_not_finite_leave_the_estimate():
    estimator = MovingHorizonEstimator(
        lambda x, u, w: x - 0.1 * ca.sqrt(x) + u + w, lambda x: ca.sqrt(x), 1, 1, window=3, W=[1e-4], V=[1e-4],
        P0=[1.0], x0=[1.0],
    )  # fmt: skip
    before = estimator.update(estimator.start(1), [[1.0]], [[0.0]])
    held = estimator.predict(before, [[-5.0]])
    assert held.status[0].name == "HELD"
    np.testing.assert_array_equal(held.mean, before.mean)
    assert held.covariance > before.covariance
    belief = estimator.update(held, [[np.sqrt(0.9)]], [[-5.0]])
    for _ in range(6):
        belief = estimator.update(estimator.predict(belief, [[0.0]]), [[0.5]], [[0.0]])
    assert belief.status[0].name == "SOLVED"
    np.testing.assert_allclose(belief.mean, 0.25, atol=0.05)


def test_a_first_estimate_at_which_the_model_is_not_finite_is_held_and_said():
    estimator = MovingHorizonEstimator(
        lambda x, w: ca.sqrt(x) + w, lambda x: ca.sqrt(x), 1, 0, window=2, W=[1e-4], V=[1e-4], P0=[1.0], x0=[-1.0]
    )
    belief = estimator.start(1)
    for _ in range(4):
        belief = estimator.predict(estimator.update(belief, [[1.0]], NO_INPUT), NO_INPUT)
        assert (belief.status[0].name, belief.mean.item(), belief.covariance.item()) == ("HELD", -1.0, 1.0)
    assert "x0" in belief.status[0].advice


def test_a_state_at_which_the_model_has_a_value_with_its_own_input_alone_is_told():
    """The estimate was held in every other sample, as the model has none with the input before."""
    rng = np.random.default_rng(0)
    estimator = MovingHorizonEstimator(
        lambda x, u, w: x - ca.sqrt(x - u) + w, lambda x: x, 1, 1, window=3, W=[1e-4], V=[1e-4], P0=[1.0], x0=[4.0]
    )
    x, belief = 4.0, estimator.update(estimator.start(1), [[4.0]], [[3.0]])
    for k in range(20):
        u = x - 1 - 0.5 * (-1) ** k
        x = x - np.sqrt(x - u)
        belief = estimator.predict(belief, [[u]])
        belief = estimator.update(belief, [[x + 0.01 * rng.normal()]], [[u]])
        assert belief.status[0].name == "SOLVED"
        assert belief.mean.item() == pytest.approx(x, abs=0.05)


def test_an_output_that_has_no_value_is_no_trouble_where_it_is_not_measured():
    estimator = MovingHorizonEstimator(
        lambda x, w: 0.9 * x + w, lambda x: ca.vertcat(x, ca.log(x - 5)), 1, 0, window=2, W=[1e-2], V=[1e-2, 1e-2],
        P0=[1.0], x0=[1.0],
    )  # fmt: skip
    belief = estimator.start(1)
    for k in range(10):
        belief = estimator.update(estimator.predict(belief, NO_INPUT) if k else belief, [[2.0, np.nan]], NO_INPUT)
        assert belief.status[0].name != "HELD"
    assert belief.mean.item() == pytest.approx(1.9, abs=0.1)


def test_covariances_that_are_kept_are_whole_ones():
    """Part of one and part of another had negative eigenvalues."""
    estimator = MovingHorizonEstimator(
        lambda x, w: ca.vertcat(0.1 * x[0], ca.if_else(x[0] > 0.5, ca.sqrt(x[1] - 9), x[1])) + w, lambda x: x[0], 2, 0,
        window=1, W=np.diag([1e-6, 1e-6]), V=[1.0], P0=[[1, 0.99], [0.99, 1]], x0=[1.0, 1.0],
    )  # fmt: skip
    held = estimator.predict(estimator.update(estimator.start(1), [[1.0]], NO_INPUT), NO_INPUT)
    assert held.status[0].name == "HELD"
    assert np.linalg.eigvalsh(held.covariance[0]).min() >= 0


def test_a_first_estimate_at_its_bound_but_for_rounding_is_taken():
    stated = {"W": [1.0], "V": [1.0], "P0": [1.0], "window": 1}
    MovingHorizonEstimator(FILLING, lambda x: x, 1, 0, x0=[3 * 0.1], x_bounds=([0], [0.3]), **stated)


DRAINING = lambda x, u, w: x + 0.3 * (u - 0.5 * ca.sqrt(x)) + w  # noqa: E731


@pytest.mark.parametrize("window", [1, pytest.param(5, marks=pytest.mark.long)])
def test_a_tank_that_ran_nearly_empty_is_met_again_when_it_fills(window):
    """It was held for ever."""
    rng, x, said = np.random.default_rng(0), 1.0, []
    estimator = MovingHorizonEstimator(
        DRAINING, lambda x: x, 1, 1, window=window, W=[1e-4], V=[1e-4], P0=[0.01], x0=[1.0]
    )
    belief = estimator.start(1)
    for k in range(60):
        u = 0.5 if k < 5 or k > 35 else 0.0
        if k:
            x = max(x + 0.3 * (u - 0.5 * np.sqrt(x)), 0.0)
            belief = estimator.predict(belief, [[u]])
        belief = estimator.update(belief, [[x + 0.01 * rng.standard_normal()]], [[u]])
        said.append(belief.status[0].name)
        assert belief.mean.item() == pytest.approx(x, abs=0.05)
    assert "HELD" in said[10:40]
    assert set(said[40:]) == {"SOLVED"}


@pytest.mark.parametrize("window", [1, 2, 5])
@pytest.mark.parametrize("outlier", [-5.0, -50.0, pytest.param(-1e4, marks=pytest.mark.check)])
def test_an_outlier_whose_step_has_none_is_gone_once_outputs_are_met(outlier, window):
    """The estimate stayed at (-0.52, 0.45) for ever."""
    estimator = MovingHorizonEstimator(
        lambda x, w: ca.vertcat(x[0] + 0.3 * (x[1] - 0.5 * ca.sqrt(x[0])), x[1]) + w, lambda x: x, 2, 0,
        window=window, W=[1e-4, 1e-2], V=[1e-2, 1e-4], P0=[0.1, 0.1], x0=[1.0, 0.5],
    )  # fmt: skip
    beliefs = met(estimator, [[1.0, outlier if k == 10 else 0.5] for k in range(60)])
    said = [belief.status[0].name for belief in beliefs]
    assert "HELD" in said[10:13]
    assert "HELD" not in said[13:]
    np.testing.assert_allclose(beliefs[-1].mean, [[1.0, 0.5]], atol=0.1)


@pytest.mark.parametrize("window", [1, 3])
def test_wrong_inputs_in_a_gap_are_left_where_outputs_were_met_last(window):
    estimator = MovingHorizonEstimator(
        lambda x, u, w: x + u + w, lambda x: ca.sqrt(x), 1, 1, window=window, W=[1e-2], V=[1e-4], P0=[1.0], x0=[1.0]
    )
    belief = estimator.start(1)
    for k in range(20):
        u = [[-2.0 if k in (5, 6) else 0.0]]
        belief = estimator.predict(belief, u) if k else belief
        belief = estimator.update(belief, [[np.nan if k in (4, 5, 6) else 1.0]], u)
        assert (belief.status[0].name == "HELD") == (k == 7)
    assert belief.mean.item() == pytest.approx(1.0, abs=0.01)


def test_outputs_that_tell_the_same_of_a_state_that_is_known_badly_are_taken():
    """It ended in an error of linear algebra."""
    estimator = MovingHorizonEstimator(
        lambda x, w: x + w, lambda x: ca.vertcat(x, x), 1, 0, window=1, W=[1.0], V=[1e-6, 1e-6], P0=[1e14], x0=[0.0]
    )
    belief = estimator.update(estimator.start(1), [[3.0, 3.0]], NO_INPUT)
    assert belief.mean.item() == pytest.approx(3.0, rel=1e-6)


@pytest.mark.parametrize("window", [1, 4])
@pytest.mark.parametrize("outlier", [50.0, 1e12])
def test_an_outlier_after_which_outputs_have_no_value_is_left_out_and_no_good_one_after_it(outlier, window):
    """Predator and prey, told by logarithms: the window began anew at the outlier, and was held for ever."""
    grown = lambda x: ca.vertcat(x[0] - x[0] * x[1], x[0] * x[1] - x[1])  # noqa: E731
    estimator = MovingHorizonEstimator(
        lambda x, w: x + 0.1 * grown(x) + w, lambda x: ca.log(x), 2, 0, window=window, W=[1e-4, 1e-4], V=[1e-4, 1e-4],
        P0=[0.01, 0.01], x0=[1.0, 1.0],
    )  # fmt: skip
    beliefs = met(estimator, [[0.0, outlier if k == 10 else 0.0] for k in range(40)])
    assert [belief.status[0].name for belief in beliefs].count("HELD") <= 2
    np.testing.assert_allclose(beliefs[-1].mean, 1.0, atol=1e-3)


def test_antennas_that_tell_nearly_the_same_are_told_apart_as_by_the_kalman_filter():
    """Position by ± 1e5 and an angle by ± 0.1, both antennas within 0.01."""
    estimator = MovingHorizonEstimator(
        lambda x, w: x + w, lambda x: ca.vertcat(x[0], x[0] + x[1]), 2, 0, window=1, W=[1e-12, 1e-12], V=[1e-4, 1e-4],
        P0=[1e10, 1e-2], x0=[0.0, 0.0],
    )  # fmt: skip
    belief = estimator.update(estimator.start(1), [[20.0, 20.13]], NO_INPUT)
    assert belief.mean[0, 1] == pytest.approx(0.13 * 1e-2 / (1e-2 + 2e-4), rel=1e-3)
    assert belief.covariance[0, 1, 1] == pytest.approx(1e-2 * 2e-4 / (1e-2 + 2e-4), rel=1e-3)


@pytest.mark.parametrize("third", [ca.log, ca.sqrt])
def test_beside_outputs_that_tell_the_same_one_without_a_slope_is_held(third):
    """It ended in an error of linear algebra."""
    estimator = MovingHorizonEstimator(
        lambda x, w: x + w, lambda x: ca.vertcat(x[0], x[0], third(x[1])), 2, 0, window=1, W=[1.0, 1.0],
        V=[1e-6, 1e-6, 1e-6], P0=[1e20, 1.0], x0=[0.0, 0.0],
    )  # fmt: skip
    belief = estimator.update(estimator.start(1), [[3.0, 3.0, 1.0]], NO_INPUT)
    assert belief.status[0].name == "HELD"
    assert np.isfinite(belief.mean).all()


@pytest.mark.parametrize("wrong", [150.0, -100.0, 20.0])
def test_one_wrong_input_is_left_behind_where_bounds_keep_the_model_finite(wrong):
    rng, W = np.random.default_rng(0), np.array([1e-4, 1e-4])
    step = lambda x, u, w: ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * (u - 2 * x[0] - 0.3 * x[1])) + w  # noqa: E731
    estimator = MovingHorizonEstimator(
        step, lambda x: ca.asin(x[0]), 2, 1, window=5, W=W, V=[1e-3], P0=[0.1, 0.1], x0=[0.1, 0],
        x_bounds=([-0.999, -9], [0.999, 9]),
    )  # fmt: skip
    x, belief = np.array([0.1, 0.0]), estimator.start(1)
    for k in range(120):
        u = np.array([0.4 * np.cos((k - 1) / 4)])
        told = u + wrong * (k == 20)
        if k:
            x = np.asarray(ca.DM(step(x, u, 0.5 * np.sqrt(W) * rng.normal(size=2)))).ravel()
            belief = estimator.predict(belief, [told])
        belief = estimator.update(belief, [[np.arcsin(x[0]) + 0.02 * rng.normal()]], [told])
        assert belief.status[0].name == "SOLVED"
    assert (np.abs(belief.mean[0] - x) < 4 * np.sqrt(np.diag(belief.covariance[0]))).all()


@pytest.mark.parametrize("call", ["predict", "update"])
def test_a_belief_is_one_of_the_estimator(call):
    estimator = MovingHorizonEstimator(FILLING, lambda x: x, 1, 0, window=2, W=[1e-4], V=[1e-4], P0=[1.0], x0=[0.7])
    given = {"predict": (NO_INPUT,), "update": ([[0.7]], NO_INPUT)}[call]
    with pytest.raises(InputError, match="belief: got None, expected one of `start`"):
        getattr(estimator, call)(None, *given)


@pytest.mark.parametrize("step", [lambda x, u, w: 0.9 * x + 0.05 / u + w, lambda x, u, w: 0.9 * x - ca.log(u) + w])
def test_an_infinite_prediction_is_at_no_bound(step):
    estimator = MovingHorizonEstimator(
        step, lambda x: x, 1, 1, window=4, W=[1e-4], V=[1e-3], P0=[0.1], x0=[0.5], x_bounds=([0], [1])
    )
    belief = estimator.update(estimator.start(1), [[0.5]], [[1.0]])
    ahead = estimator.predict(belief, [[0.0]])
    assert ahead.status[0].name == "HELD"
    assert ahead.mean[0, 0] == pytest.approx(0.5, abs=0.1)
