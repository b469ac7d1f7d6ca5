"""Step 0: feasible samples, inputs that keep them feasible, and values that are those of the same controller."""

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    Plant,
    QuadraticObjective,
    discretise,
)
from ccdtools.co_design import expert_dataset, feasible_sets
from invariant_sets import Polytope
from mpc import lqr


def first_visits(study, data):
    """(x, p, u) of the accepted samples themselves: what was visited at step 0."""
    n = round(data.acceptance * 150)
    nx = study.model.nx
    return data.inputs[:n, :nx], data.inputs[:n, nx:], data.actions[:n], data.values[:n]


@pytest.mark.check
def test_every_accepted_sample_lies_in_the_feasible_set_of_its_own_design(study, expert_data):
    x, p, _, _ = first_visits(study, expert_data(study))
    sets = feasible_sets(study.problem())
    assert len(x) > 50
    assert all(sets.at(pi).contains(xi, tol=1e-9) for xi, pi in zip(x, p))
    assert len(np.unique(p, axis=0)) == len(p)


@pytest.mark.quick(1)
def test_the_next_nominal_state_stays_in_the_feasible_set(study, expert_data):
    x, p, u, _ = first_visits(study, expert_data(study))
    sets, (A, B, _) = feasible_sets(study.problem()), study.model.matrices(p)
    following = np.einsum("nij,nj->ni", A, x) + np.einsum("nij,nj->ni", B, u)
    assert all(sets.at(pi).contains(xi, tol=1e-6) for xi, pi in zip(following, p))


@pytest.mark.long
def test_inputs_lie_within_their_bounds(study, expert_data):
    lower, upper = study.problem().input_bounds
    u = expert_data(study).actions
    assert (u >= lower - 1e-9).all()
    assert (u <= upper + 1e-9).all()


@pytest.mark.check
def test_where_lqr_keeps_the_next_state_feasible_the_expert_is_lqr(study, expert_data):
    problem = study.problem()
    x, p, u, _ = first_visits(study, expert_data(study))
    sets, Q, R = feasible_sets(problem), problem.objective.Q, problem.objective.R
    same = 0
    for xi, pi, ui in zip(x, p, u):
        A, B, _ = study.model.matrices(pi)
        wanted = np.clip(-lqr(A, B, Q=Q, R=R)[0] @ xi, *problem.input_bounds)
        feasible = sets.at(pi)
        if (feasible.A @ (A @ xi + B @ wanted) < feasible.b - 1e-6 * np.abs(feasible.b)).all():
            np.testing.assert_allclose(ui, wanted, rtol=1e-6, atol=1e-9)
            same += 1
    assert same > 10


def test_designs_cover_the_whole_box(study, expert_data):
    _, p, _, _ = first_visits(study, expert_data(study))
    v = study.problem().design.to_unit(p)
    assert (v.min(axis=0) < 0.1).all()
    assert (v.max(axis=0) > 0.9).all()


def test_every_sample_is_finite_and_costs_are_negative(study, expert_data):
    data = expert_data(study)
    assert np.isfinite(data.inputs).all()
    assert np.isfinite(data.actions).all()
    known = np.isfinite(data.values)
    assert known.mean() > 0.9
    assert (data.values[known] < 0).all()
    assert 0 < data.acceptance <= 1
    assert 0 <= data.diverged < 0.1


def discounted_returns(study, x, p, runs, gamma, rng):
    """Monte Carlo of clipped LQR from one state at one design, by plain loops over 900 steps."""
    problem = study.problem()
    A, B, E = problem.model.matrices(p)
    K = lqr(A, B, Q=problem.objective.Q, R=problem.objective.R)[0]
    w = study.disturbance.sample(runs, 900, rng)
    state, total = np.tile(x, (runs, 1)), np.zeros(runs)
    for k in range(900):
        u = np.clip(-state @ K.T, *problem.input_bounds)
        state = state @ A.T + u @ B.T + w[:, k] @ E.T
        total += gamma**k * problem.objective.rewards(state, u)
    return total


@pytest.mark.check
def test_values_agree_with_a_long_monte_carlo_of_the_same_controller(suspension, expert_data):
    # Late visits: near the origin of the suspension the projection is idle, so the controller is clipped LQR.
    rng = np.random.default_rng(5)
    data, nx = expert_data(suspension), 4
    n = round(data.acceptance * 150)
    last = slice(len(data.inputs) - n, None)
    z = []
    for row, value in list(zip(data.inputs[last], data.values[last]))[:60]:
        sampled = discounted_returns(suspension, row[:nx], row[nx:], 40, 0.99, rng)
        z.append((value - sampled.mean()) / (sampled.std() * np.sqrt(1 + 1 / 40)))
    z = np.array(z)
    assert abs(z.mean()) < 4 / np.sqrt(len(z))
    assert 0.5 < z.std() < 1.6


@pytest.mark.quick(1)
@pytest.mark.parametrize("expert", ["lqr", "mpc"])
def test_both_experts_give_data_of_one_shape(illustrative, expert):
    data = expert_dataset(illustrative.problem(), samples=8, rng=np.random.default_rng(0), expert=expert)
    assert data.inputs.shape[1] == 3
    assert len(data.inputs) == len(data.actions) == len(data.values)
    assert (np.abs(data.actions) <= 1 + 1e-6).all()


def test_a_law_of_ones_own_is_an_expert_whose_inputs_are_imitated_at_every_design(illustrative):
    def law(problem, design):
        return lambda x: np.atleast_1d(-0.4 * np.tanh(x[..., 1]) / design[0])

    data = expert_dataset(illustrative.problem(), samples=30, rng=np.random.default_rng(0), expert=law, sets="none")
    np.testing.assert_allclose(data.actions[:, 0], -0.4 * np.tanh(data.inputs[:, 1]) / data.inputs[:, 2], rtol=1e-12)


@pytest.mark.parametrize("controller", [
    None, lambda x: None, lambda x: -x[:, :1], lambda x: np.zeros(3), lambda x: [np.nan], lambda x: [1j],
    lambda x: "push",
])  # fmt: skip
def test_a_law_that_returns_no_input_is_named_and_not_said_to_diverge(illustrative, controller):
    with pytest.raises(InputError, match="expert: got"):
        expert_dataset(illustrative.problem(), samples=8, rng=np.random.default_rng(0), sets="none",
                       expert=lambda problem, design: controller)  # fmt: skip


def test_the_generator_decides(illustrative):
    a, b = (expert_dataset(illustrative.problem(), samples=10, rng=np.random.default_rng(4)) for _ in range(2))
    np.testing.assert_array_equal(a.inputs, b.inputs)
    np.testing.assert_array_equal(a.values, b.values)


def test_bad_arguments_are_refused(illustrative):
    problem = illustrative.problem()
    with pytest.raises(InputError, match="expert: got 'pid', expected"):
        expert_dataset(problem, samples=5, rng=np.random.default_rng(0), expert="pid")
    with pytest.raises(InputError, match="samples: got 0, expected a whole number, at least 1"):
        expert_dataset(problem, samples=0, rng=np.random.default_rng(0))


def test_a_design_box_without_any_feasible_state_is_an_error_with_advice():
    x, u, w, p = (ca.SX.sym(name) for name in "xuwp")
    model = discretise(Plant(x, u, w, p, (1.2 + p) * x + w, DesignSpace(["p"], [0.0], [1.0]), dt=1.0, continuous=False))
    limits = Polytope.from_bounds([-1.0], [1.0])
    objective = QuadraticObjective([[1.0]], [[1.0]])
    hopeless = CoDesignProblem(model, limits, limits, objective, FixedStart([0.0], Gaussian([0.1])))
    with pytest.raises(InputError, match="samples: got 5 candidates of which none lies in X at a design with an LQR"):
        expert_dataset(hopeless, samples=5, rng=np.random.default_rng(0))
