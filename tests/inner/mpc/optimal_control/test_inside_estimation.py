"""Verdicts of estimates where a maximum is not left."""

import casadi as ca
import numpy as np

from mpc.optimal_control.estimation import EstimationStatus, Experiment, curvature, estimate_parameters

TIMES = np.linspace(0, 4, 21)


def test_a_maximum_that_is_not_left_is_not_solved(monkeypatch):
    monkeypatch.setattr(curvature, "SHAKEN", 0.0)
    noise = 0.5 * np.random.default_rng(0).normal(size=(2, 21))
    seen = np.column_stack([1 + noise[0] - noise[0].mean(), 2 - 2 * np.exp(-TIMES) + noise[1]])
    found = estimate_parameters(
        Experiment(TIMES, seen, start=[0.0]), lambda x, p: -x + (p - 1) ** 2, lambda x, p: ca.vertcat(p, x),
        states=1, p_bounds=([-3], [5]), p_guess=[1.0], noise=[0.25, 0.25],
    )  # fmt: skip
    np.testing.assert_allclose(found.p, 1.0, atol=1e-6)
    assert found.status is EstimationStatus.UNSOLVED
    assert np.isnan(found.intervals()).all()
