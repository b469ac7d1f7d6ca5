"""Parameters of static models from data without noise, at whose optimum the cost and its slopes vanish."""

import casadi as ca
import numpy as np
import pytest

from mpc.optimal_control.estimation import Experiment, estimate_parameters

TIMES = np.linspace(0, 4, 21)
MODELS = {
    "line": (lambda m, p, t: p[0] + p[1] * t, [1, 2]),
    "decay": (lambda m, p, t: p[0] * m.exp(-p[1] * t) + p[2], [3, 0.7, 1]),
    "sine": (lambda m, p, t: p[0] * m.sin(p[1] * t + p[2]), [2, 1.5, 0.4]),
    "cubic": (lambda m, p, t: p[0] + p[1] * t + p[2] * t**2 + p[3] * t**3, [1, 1, -1, 0.1]),
}


def fitted(model, unit, bounds, *, given, **start):
    """Estimate from outputs that the model itself has at its parameters."""
    output, truth = MODELS[model]
    return estimate_parameters(
        Experiment(TIMES, unit * output(np, truth, TIMES), start=[0.0]), lambda x: 0 * x,
        lambda p, t: unit * output(ca, p, t), states=1, p_bounds=bounds,
        noise=[1e-6 * unit**2] if given else None, **start,
    )  # fmt: skip


@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize("reach", [20, 1e4])
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("model", MODELS)
def test_they_are_solved_in_whatever_bounds_and_units(model, unit, reach, given):
    """Many were UNSOLVED at residuals of 1e-16."""
    truth = np.array(MODELS[model][1])
    found = fitted(model, unit, (-reach + 0 * truth, reach + 0 * truth), given=given, p_guess=1.3 * truth)
    assert found.solved
    np.testing.assert_allclose(found.p, truth, rtol=1e-6)
    np.testing.assert_allclose(found.residuals[0], 0, atol=1e-6 * unit)


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_parameters_at_their_bounds_are_solved(unit):
    truth = np.array(MODELS["cubic"][1])
    found = fitted("cubic", unit, (np.minimum(truth, 4 * truth), np.maximum(truth, 4 * truth)), given=False)
    assert found.solved
    np.testing.assert_allclose(found.residuals[0], 0, atol=1e-3 * unit)


def test_a_product_is_open():
    found = estimate_parameters(
        Experiment(TIMES, 5 + 0 * TIMES, start=[0.0]), lambda x: 0 * x, lambda p: p[0] * p[1], states=1,
        p_bounds=([0.1] * 2, [9] * 2),
    )  # fmt: skip
    assert [set(one) for one in found.open] == [{"p1", "p2"}]
    np.testing.assert_allclose(found.p.prod(), 5, rtol=1e-6)
