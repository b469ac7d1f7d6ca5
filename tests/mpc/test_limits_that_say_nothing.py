"""Bounds that stand for no limit at all say nothing of the size of a state, and hide no violation of another row."""

import numpy as np
import pytest

from mpc import LinearMPC, Status


def integrator(X, **options):
    return LinearMPC(np.array([[1.0]]), np.array([[0.1]]), Q=1.0, R=1.0, horizon=2, U=(-1.0, 1.0), X=X, **options)


@pytest.mark.parametrize("unlimited", [3.0, 1e4, 1e6, 1e8, 1e12])
@pytest.mark.parametrize(("x", "over"), [(0.85, 0.0), (0.92, 0.02), (1.03, 0.13), (1.5, 0.6), (2.9, 2.0)])
def test_a_terminal_set_that_cannot_be_met_is_said_beside_any_limit_of_the_states(unlimited, x, over):
    plan = integrator((-unlimited, unlimited), terminal_set=(-0.7, 0.7)).solve([x])
    assert plan.violation == pytest.approx(over, abs=2e-8)
    assert plan.status is (Status.SOFTENED if over else Status.SOLVED)


@pytest.mark.parametrize("unlimited", [3.0, 1e4, 1e6, 1e8, 1e12])
def test_a_state_that_must_not_be_negative_is_kept_so_beside_any_upper_limit(unlimited):
    mpc = integrator(([0.0], [unlimited]))
    below = mpc.solve([-0.5])
    assert below.status is Status.SOFTENED
    assert below.violation == pytest.approx(0.4)
    above = mpc.solve([0.05])
    assert above.status is Status.SOLVED
    assert above.states.min() >= -1e-7


def test_the_unit_of_the_states_does_not_matter_beside_no_limit():
    for unit in (1e-6, 1.0, 1e6):
        mpc = LinearMPC(
            np.array([[1.0]]), np.array([[0.1 / unit]]), Q=unit**2, R=1.0, horizon=2, U=(-1.0, 1.0),
            X=(-1e9 / unit, 1e9 / unit), terminal_set=(-0.7 / unit, 0.7 / unit),
        )  # fmt: skip
        assert mpc.solve([0.85 / unit]).status is Status.SOLVED
        plan = mpc.solve([1.5 / unit])
        assert plan.status is Status.SOFTENED
        assert plan.violation * unit == pytest.approx(0.6)
