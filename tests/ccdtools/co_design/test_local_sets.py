"""Sets of a linearisation are held against the model itself."""

import casadi as ca
import numpy as np
import pytest

from ccdtools import CoDesignProblem, DesignSpace, FixedStart, Gaussian, Plant, QuadraticObjective, discretise
from ccdtools.co_design import expert_dataset


def sets_of(cubic):
    x, u, w, p = (ca.SX.sym(name) for name in "xuwp")
    plant = Plant(x, u, w, p, p * x + cubic * x**3 + u + w, DesignSpace(["a"], [0.5], [1.0]), dt=0.1)
    model = discretise(plant, X=(-1, 1), U=(-1, 1), W=(-0.1, 0.1))
    problem = CoDesignProblem(
        model, (-1, 1), (-1, 1), QuadraticObjective([[1.0]], [[0.1]]), FixedStart([0.1], Gaussian([0.01])), 20
    )
    return expert_dataset(problem, samples=400, rng=np.random.default_rng(0)).sets


@pytest.mark.check
def test_states_that_the_model_carries_out_of_a_set_of_its_linearisation_are_counted():
    """Where a x + 3 x³ > 1 the largest input does not hold the model; its linearisation is held up to |x| = 1."""
    sets = sets_of(3.0)
    assert sets.feasible > 0
    designs = np.linspace(0.5, 1.0, 101)[:, None]
    states = np.linspace(0, 1, 2001)
    rises = designs * states + 3.0 * states**3 > 1.0  # from here the largest input does not hold the state
    carried = _stepped(states, designs) > 1.0
    assert sets.leaving == pytest.approx((rises & carried).mean(), abs=0.05)
    assert "leave it in a step of the model itself" in str(sets)


@pytest.mark.check
def test_a_nearly_linear_model_leaves_no_set_of_its_linearisation():
    assert sets_of(1e-6).leaving == 0.0


def _stepped(x, a):
    """x after 0.1 s under u = −1, by many Euler steps."""
    x = np.broadcast_to(x, np.broadcast_shapes(x.shape, a.shape)).copy()
    for _ in range(2000):
        x += 0.1 / 2000 * (a * x + 3.0 * x**3 - 1)
    return x
