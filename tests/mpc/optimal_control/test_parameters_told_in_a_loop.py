"""Parameters that are told anew from sample to sample."""

import casadi as ca
import numpy as np
import pytest

from mpc import Status
from mpc.optimal_control import NonlinearMPC, Phase


def test_other_parameters_go_on_from_the_last_plans_where_asked():
    """As where an estimator tells them anew at each sample: all of these were first samples."""
    step = lambda x, u, p: ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * (p * ca.sin(x[0]) + u))  # noqa: E731
    cost = lambda x, u: ca.sumsqr(x) + u**2  # noqa: E731
    phase = Phase(step, 2, 1, discrete=True, duration=20, u_bounds=(-3, 3), stage_cost=cost)
    law, x = NonlinearMPC(phase, p=[1.0]), np.array([1.0, 0.0])
    law(x)
    assert law.with_parameters([1.05]).last_plans == ()
    other = law.with_parameters([1.05], follow=True)
    other(x)
    assert other.last_plans[0].solver != law.last_plans[0].solver == "Ipopt"
    assert other.last_plans[0].cost == pytest.approx(other.solve(x).cost, rel=1e-6)


def test_other_parameters_build_nothing_anew(monkeypatch):
    """Models were built in every sample, outside its time limit: 170 ms for 11."""
    step = lambda x, u, p: ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * (p * ca.sin(x[0]) + u))  # noqa: E731
    phase = Phase(step, 2, 1, discrete=True, duration=20, u_bounds=(-3, 3), stage_cost=lambda x, u: ca.sumsqr(x) + u**2)
    law, x, made = NonlinearMPC(phase, p=[1.0]), np.array([1.0, 0.0]), []
    law(x)
    law(x)

    class Counted(ca.Function):
        def __init__(self, *arguments):
            made.append(arguments[0])
            super().__init__(*arguments)

    monkeypatch.setattr(ca, "Function", Counted)
    for p in (1.1, 1.2):
        law = law.with_parameters([p], follow=True)
        law(x)
        assert law.last_plans[0].status is Status.SOLVED
    assert made == []
