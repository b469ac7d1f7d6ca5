"""Verdicts of estimates where a maximum is not left, or the time is up."""

import casadi as ca
import numpy as np
import pytest

from mpc.optimal_control.estimation import (
    EstimationStatus,
    Experiment,
    curvature,
    estimate_parameters,
    most_likely,
    parameter_estimation,
)

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


@pytest.mark.parametrize("disturbance", [None, [1e-4]])
def test_when_the_time_is_up_what_was_reached_is_returned_without_another_solve(monkeypatch, disturbance):
    solves = []
    over = type("Over", (parameter_estimation.Clock,), {"late": True})
    monkeypatch.setattr(parameter_estimation, "Clock", over)
    refine = most_likely.refine
    monkeypatch.setattr(most_likely, "refine", lambda *given, **options: solves.append(1) or refine(*given, **options))
    y = 3 + 0.1 * np.random.default_rng(0).normal(size=21)
    found = estimate_parameters(
        Experiment(TIMES, y, start=[3.0]), lambda x, w, p: p[0] + w if disturbance else 0 * x,
        lambda x, p: x if disturbance else (p - 1) ** 2, states=1, p_bounds=([-3], [5]),
        p_guess=[1.0], noise=[0.1], disturbance=disturbance, time_limit=100,
    )  # fmt: skip
    assert len(solves) == 1
    assert found.solution.solved_on_mesh
    assert found.status is EstimationStatus.UNSOLVED
