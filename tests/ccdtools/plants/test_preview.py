"""Disturbances known ahead: the shift register, optimal preview control, and laws of both on the plant itself."""

import pickle
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    CoDesignProblem,
    CustomObjective,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    LinearFeedback,
    OutputLimits,
    Plant,
    QuadraticObjective,
    Scenario,
    compare,
    deploy,
    discretise,
    saturated_lqr,
    simulate,
)
from ccdtools.co_design import expert_dataset, previewed_limits, previewed_objective, previewed_problem
from ccdtools.controllers import Previewing
from ccdtools.plants import LinearModel, SampledModel, with_preview
from ccdtools.plants.library import mass_chain, pendulum_on_cart, quarter_car
from mpc import LinearMPC, lqr

P = [100.0, 1.0]
Q = np.diag([10.0, 3.0, 1.0, 2.0])
R = np.array([[0.1]])


def two_masses():
    """Two masses, each pushed by a disturbance of its own."""
    return mass_chain(2, disturbed=(1, 2))


def test_the_gains_on_what_is_ahead_are_those_of_the_literature():
    """K_i = (R + B'PB)⁻¹ B' (A − BK)ᵀ^i P E, i samples ahead (Tomizuka 1975)."""
    model = discretise(quarter_car())
    p = model.design.from_unit([0.3, 0.6])
    weight = np.diag([1e4, 1.0, 1e3, 1.0])
    A, B, E = model.matrices(p)
    K0, P0 = lqr(A, B, Q=weight, R=[[1e-4]])
    weights = previewed_objective(QuadraticObjective(weight, [[1e-4]]), 8)
    K, _ = lqr(*with_preview(model, 8).matrices(p)[:2], Q=weights.Q, R=weights.R)
    adjoint = P0 @ E
    for i in range(8):
        wanted = np.linalg.solve(1e-4 + B.T @ P0 @ B, B.T @ adjoint)
        np.testing.assert_allclose(K[:, 4 + i], wanted[:, 0], rtol=1e-6, atol=1e-9 * np.abs(K).max())
        adjoint = (A - B @ K0).T @ adjoint


def pendulum():
    """Not linear."""
    return pendulum_on_cart()


def test_the_register_stays_differentiable_in_the_design():
    model = discretise(two_masses())
    ahead = with_preview(model, 3)
    for before, after in zip(model.derivatives(P), ahead.derivatives(P)):
        columns = 0 if before.shape[1] == 2 else before.shape[1]
        np.testing.assert_allclose(after[:4, :columns], before[:, :columns])
    E_by_p = model.derivatives(P)[2]
    np.testing.assert_allclose(ahead.derivatives(P)[0][:4, 4:6], E_by_p)
    assert not ahead.derivatives(P)[2].any()
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(ahead)).matrices(P)[0], ahead.matrices(P)[0])


def test_a_sampled_model_keeps_the_error_it_promised():
    model = discretise(pendulum(), X=(-0.5, 0.5), U=(-5.0, 5.0), W=(-1.0, 1.0))
    ahead = with_preview(model, 4)
    assert isinstance(ahead, SampledModel)
    assert ahead.error.relative == model.error.relative
    np.testing.assert_array_equal(ahead.error.bound, np.r_[model.error.bound, np.zeros(4)])


def test_a_constant_term_and_a_model_without_design_pass(rng):
    A, B, E = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.0], [0.1]]), np.array([[0.1], [0.0]])
    model = LinearModel(ca.SX(0, 1), ca.SX(ca.DM(A)), ca.SX(ca.DM(B)), ca.SX(ca.DM(E)), 0.1, None, ca.SX([0.0, 0.3]))
    ahead = with_preview(model, 2)
    assert ahead.affine
    np.testing.assert_allclose(ahead.undisturbed(())(np.r_[1.0, 2, 3, 4], np.zeros(1)), [1.2 + 0.3, 2.3, 4, 0])


def problem_of(steps=25):
    """Two masses, of which the second is shaken."""
    return CoDesignProblem(
        discretise(mass_chain(2)), X=(-5.0, 5.0), U=(-30.0, 30.0), objective=QuadraticObjective(Q, R),
        scenarios=FixedStart([0.1, 0, 0, 0], Gaussian([0.2])), steps=steps,
    )  # fmt: skip


@pytest.mark.long
def test_a_problem_with_preview_asks_for_nothing_new(rng):
    problem = problem_of()
    ahead = previewed_problem(problem, 4)
    assert ahead.X.dim == 8
    x0, w = ahead.scenarios.sample(5, 25, np.random.default_rng(3))
    x0_own, w_own = problem.scenarios.sample(5, 29, np.random.default_rng(3))
    np.testing.assert_array_equal(x0, np.c_[x0_own, w_own[:, :4, 0]])
    np.testing.assert_array_equal(w, w_own[:, 4:])
    data = expert_dataset(ahead, samples=60, sets="lqr", rng=rng)
    assert data.inputs.shape[1] == 10
    A, B, _ = ahead.model.matrices(P)
    mpc = LinearMPC(A, B, Q=ahead.objective.Q, R=R, horizon=20, X=ahead.X, U=ahead.U)
    laws = {"LQR": saturated_lqr(ahead, P), "MPC": mpc}
    x0, w = ahead.scenarios.sample(200, 25, rng)
    table = compare(laws, Scenario(ahead.model, x0, w), design=P, objective=ahead.objective, X=ahead.X)
    assert table["MPC"].paired_to_lqr.mean == pytest.approx(0.0, abs=1e-3 * abs(table["LQR"].summary.mean))
    blind = simulate(problem.model, saturated_lqr(problem, P), x0=x0[:, :4], steps=25,
                     disturbance=np.concatenate([x0[:, 4:, None], w], axis=1), design=P)  # fmt: skip
    assert table["LQR"].summary.mean > blind.returns(problem.objective).mean()


def test_mpc_of_the_register_is_the_mpc_that_is_handed_a_preview(rng):
    problem = problem_of()
    ahead = previewed_problem(problem, 6)
    A, B, E = problem.model.matrices(P)
    own = LinearMPC(A, B, Q=Q, R=R, horizon=6, X=problem.X, U=problem.U, E=E, uses=("preview",))
    register = LinearMPC(*ahead.model.matrices(P)[:2], Q=ahead.objective.Q, R=R, horizon=6, X=ahead.X, U=ahead.U)
    for _ in range(10):
        x, w = 0.5 * rng.standard_normal(4), 0.5 * rng.standard_normal((6, 1))
        np.testing.assert_allclose(Previewing(register, 6)(x, w=w), own(x, w=w), atol=1e-6)


def test_a_law_of_the_register_is_deployed_on_the_plant_itself(rng):
    problem = problem_of()
    law = saturated_lqr(previewed_problem(problem, 4), P)
    real = mass_chain(2, real=True)
    w = rng.normal(0, 0.5, (2, 60, 1))
    log = deploy(real, Previewing(law, 4), P, w, x0=np.zeros(4))
    run = simulate(real, Previewing(law, 4), x0=np.zeros((2, 4)), steps=60, disturbance=w, design=P)
    np.testing.assert_array_equal(log.states, run.states)


class Remembering:
    """A law with memory: the sum of what it saw."""

    design = (100.0, 1.0)

    def __init__(self):
        self.total = None

    def reset(self):
        self.total = 0.0

    def __call__(self, x):
        self.total = self.total + x.sum()
        return np.array([1e-3 * self.total])


def test_memory_and_design_of_a_law_are_those_of_the_loop(rng):
    law = Previewing(Remembering(), 2)
    assert law.design == (100.0, 1.0)
    plant = mass_chain(1)
    runs = [simulate(plant, law, x0=[[0.1, 0], [0.2, 0]], steps=9, disturbance=np.ones((9, 1)), design=P) for _ in "ab"]
    np.testing.assert_array_equal(runs[0].inputs, runs[1].inputs)
    with pytest.raises(InputError, match="the design of the policy"):
        simulate(plant, law, x0=[0.1, 0], steps=3, design=[50.0, 1.0])
    assert not hasattr(Previewing(GAIN, 2), "reset")


class Judged(QuadraticObjective):
    """An objective of one's own."""

    def rewards(self, x_next, u, x=None, p=None):
        return -abs(x_next[..., 0]) - 0 * u[..., 0]


def test_an_objective_of_ones_own_sees_the_states_alone(rng):
    objective = previewed_objective(Judged(Q, R), 3)
    x = rng.standard_normal((7, 7))
    np.testing.assert_array_equal(objective.rewards(x, np.zeros((7, 1))), -abs(x[:, 0]))
    assert objective.weights(np.zeros(0), 7, 1).Q.shape == (7, 7)


def test_costs_of_outputs_and_their_limits_see_the_states_alone(rng):
    own = CustomObjective(lambda x, u, p: p[0] * x[0] ** 2 + x[1] * u[0] + u[0] ** 2 + x[1] ** 2,
                          terminal_cost=lambda x, p: x[1] ** 4, design_cost=lambda p: p[0])  # fmt: skip
    objective = previewed_objective(own, 3)
    x, u, p = rng.standard_normal((5, 5)), rng.standard_normal((5, 1)), np.array([2.0])
    np.testing.assert_array_equal(objective.rewards(x, u, x, p), own.rewards(x[:, :2], u, x[:, :2], p))
    np.testing.assert_array_equal(objective.final_rewards(x, p), own.final_rewards(x[:, :2], p))
    assert objective.cost_of_design(p, 10) == 2.0
    weights = objective.weights(p, 5, 1)
    np.testing.assert_array_equal(weights.Q, np.diag([2.0, 1, 0, 0, 0]))
    np.testing.assert_array_equal(weights.S, [[0], [0.5], [0], [0], [0]])


def stiff():
    """A model whose step is implicit."""
    x, u, w, p = (ca.SX.sym(name) for name in "xuwp")
    plant = Plant(x, u, w, p, -1000 * x**3 + u + w, DesignSpace(["p"], [0], [1]), dt=0.1)
    return discretise(plant, method="collocation", X=(-1, 1), accuracy=1e-2, sampling_guard="ignore")


GAIN = LinearFeedback(np.ones((1, 4)))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: with_preview(np.eye(2), 3), "model: got .* expected a LinearModel, a SampledModel or a Plant"),
        (lambda: with_preview(two_masses(), 0), "steps: got 0"),
        (lambda: with_preview(two_masses(), 2, channels=(2,)), "channels: got .* from 0 to 1"),
        (lambda: with_preview(two_masses(), 2, channels=(0, 0)), "channels: got .* different whole numbers"),
        (lambda: with_preview(two_masses(), 2, channels=()), "channels"),
        (lambda: with_preview(two_masses(), 2, channels="0"), "channels: got '0'"),
        (lambda: with_preview(mass_chain(2, disturbed=()), 2), "model: got no disturbance"),
        (lambda: with_preview(stiff(), 2), "model: got a model by collocation.*method="),
        (lambda: Previewing(np.ones((1, 4)), 2), "controller: got .* expected a callable"),
        (lambda: Previewing(Previewing(GAIN, 2), 2), "controller: got one that needs preview"),
        (lambda: Previewing(GAIN, 2)(np.zeros(2), w=np.zeros((3, 1))), r"w: got shape \(3, 1\)"),
        (lambda: Previewing(GAIN, 2, (1,))(np.zeros(2), w=np.zeros((2, 1))), "w: got 1 channels"),
        (lambda: previewed_problem(3, 2), "problem: got 3"),
        (lambda: previewed_limits((-1.0, 1.0), (-1.0, 1.0), 0), "steps: got 0"),
        (lambda: previewed_objective(3, 2), "objective: got 3"),
    ],
)  # fmt: skip
def test_bad_previews_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_an_objective_and_limits_of_outputs_are_those_of_the_plant_before_the_register(rng):
    own = problem_of()
    limits = OutputLimits(lambda x, u, p: x[2] - x[0] + 0.1 * u[0] + p[0], [-0.2], [0.3])
    objective = CustomObjective(lambda x, u, p: x[0] ** 2 + u[0] ** 2)
    ahead = previewed_problem(replace(own, output_limits=limits, objective=objective), 3)
    x, u, p = (rng.standard_normal(size) for size in (7, 1, own.design.dim))
    values = ahead.output_limits.outputs.function(7, 1, own.design.dim)(x, u, p)
    assert float(values) == pytest.approx(x[2] - x[0] + 0.1 * u[0] + p[0])
    assert ahead.objective.describe() == objective.describe()
    assert "stage cost" in objective.describe()
    assert ahead.objective.looks_back == objective.looks_back
    assert "register of 3" in repr(ahead.objective)


def test_a_model_with_preview_has_the_names_of_its_plant_beside_what_is_known_ahead():
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    names = {"state_names": ["height [m]", "speed [m/s]"], "input_names": ["force [N]"]}
    plant = Plant(x, u, w, p, [x[1], u + p * w], DesignSpace(["p"], [1], [2]), dt=0.1, **names)
    model = with_preview(discretise(plant), 2)
    assert model.state_names == ("height [m]", "speed [m/s]", "w1", "w1 in 1 samples")
    assert model.input_names == ("force [N]",)
