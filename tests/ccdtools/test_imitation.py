"""Policies that imitate an expert, from states or from what was measured."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch

import mpc
from ccdtools import (
    DesignSpace,
    InputError,
    KalmanFilter,
    LinearFeedback,
    Measurement,
    QuadraticObjective,
    Scenario,
    imitate,
    plant_from_matrices,
    saturated_lqr,
    simulate,
)
from ccdtools.co_design import EpisodeEnv
from ccdtools.controllers import History, Observed
from ccdtools.plants import BlackBox
from learning import CloningConfig, NetworkConfig, train

A, B, C = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]]), np.array([[1.0, 0.0]])
W, V = np.diag([1e-5, 1e-3]), np.array([[4e-3]])
OBJECTIVE = QuadraticObjective(np.eye(2), [[0.1]])
PLANT = plant_from_matrices(A, B, np.sqrt(W), dt=0.1, continuous=False)
K = mpc.lqr(A, B, Q=np.eye(2), R=[[0.1]])[0]
LQR = LinearFeedback(K, -3, 3)
LQG = Observed(LQR, KalmanFilter(A, B, C, W, V))
QUICK = CloningConfig(steps=400)


def drawn(rng, runs=32, steps=60):
    return Scenario(
        PLANT, 0.5 * rng.standard_normal((runs, 2)), rng.standard_normal((runs, steps, 2)),
        output=Measurement(C, noise=[0.063]), seed=int(rng.integers(2**31)),
    )  # fmt: skip


def imitated(expert=LQG, scenario=drawn, **options):
    given = {"objective": OBJECTIVE, "limits": (-3, 3), "rng": np.random.default_rng(0), "rounds": 2, "config": QUICK}
    return imitate(expert, scenario, **given | options)


@pytest.mark.long
def test_a_policy_of_the_state_does_what_its_expert_does():
    found = imitated(LQR)
    x = np.random.default_rng(1).normal(0, 0.3, (50, 2))
    assert found.controller(x) == pytest.approx(LQR(x), abs=0.15)
    assert max(found.returns) > 1.02 * found.expert  # negative: at most 2 % below


def test_an_imitation_says_how_many_lost_runs_it_was_not_fitted_to():
    def far(rng):
        scenario = drawn(rng)
        return replace(scenario, x0=np.vstack([[[50.0, 0.0]] * 5, scenario.x0[5:]]))

    short = CloningConfig(steps=5)
    found = imitated(LQR, far, limit=[10.0, 10.0], config=short)
    assert found.left_out[0] >= 10
    assert found.left_out[1] == 64
    assert f"{found.left_out[0]} of 64 runs lost and left out" in repr(found)
    assert "left out" not in repr(imitated(LQR, config=short))


@pytest.mark.check
@pytest.mark.parametrize("length", [8, 16])
def test_a_policy_of_measured_outputs_returns_what_lqg_does(length):
    found = imitated(history=length, rounds=3, config=None)
    fresh = drawn(np.random.default_rng(9), runs=500)
    lqg, policy = (fresh.run(law).returns(OBJECTIVE).mean() for law in (LQG, found.controller))
    assert policy > 1.01 * lqg


def test_histories_hold_what_a_loop_shows_the_latest_first():
    seen = []

    def spy(z):
        seen.append(z.copy())
        return -z[:, :1]

    run = simulate(
        PLANT, History(spy, 3), x0=[[0.4, 0.1], [0.2, 0.0]], steps=5, disturbance=np.zeros((5, 2)),
        output=Measurement(C),
    )  # fmt: skip
    y, u = run.states[:, :-1, 0], run.inputs[:, :, 0]
    zero = np.zeros(2)
    np.testing.assert_array_equal(seen[0], np.column_stack([y[:, 0], zero, zero, zero, zero, zero]))
    np.testing.assert_array_equal(seen[4], np.column_stack([y[:, 4], y[:, 3], y[:, 2], u[:, 3], u[:, 2], u[:, 1]]))


@pytest.mark.check
def test_what_a_policy_is_fitted_to_is_what_it_sees_in_the_loop():
    """An expert that is linear in the history is met where loop and data see the same."""
    finite = History(lambda z: np.clip(-z[:, :1] + 0.5 * z[:, 1:2] - 0.1 * z[:, 2:3], -3, 3), 2)
    found = imitated(finite, history=2, rounds=1, config=CloningConfig(steps=1500), network=NetworkConfig(hidden=(4,)))
    assert found.returns[0] == pytest.approx(found.expert, rel=0.02)


@pytest.mark.check
def test_an_expert_may_see_the_state_where_the_policy_sees_outputs():
    found = imitated(LQR, history=4, rounds=3)
    assert isinstance(found.controller, History)
    assert found.expert > max(found.returns) > 6 * found.expert
    assert found.samples == (32 * 60, 2 * 32 * 60, 3 * 32 * 60)


def test_runs_that_the_policy_loses_are_not_blamed_on_the_expert():
    plant = BlackBox(lambda x, u, w, p: 1.3 * x + u, nx=1, nu=1, dt=0.1)
    found = imitated(
        LinearFeedback([[1.0]], -1, 1), lambda rng: Scenario(plant, rng.uniform(-1, 1, (20, 1)), np.zeros((20, 60, 0))),
        objective=QuadraticObjective([[1.0]], [[0.1]]), limits=(-1, 1), rounds=2, rng=np.random.default_rng(1),
        network=NetworkConfig((4,), skip=False), config=CloningConfig(steps=5),
    )  # fmt: skip
    assert found.expert > -1.0
    assert found.returns == (-np.inf, -np.inf)
    assert found.samples[0] == 20 * 60


@pytest.mark.check
def test_the_best_round_is_kept_and_seeds_repeat():
    found = imitated(LQR, rounds=3)
    again = imitated(LQR, rounds=3)
    assert found.returns == again.returns
    x = np.array([[0.2, -0.1]])
    np.testing.assert_array_equal(found.controller(x), again.controller(x))


@pytest.mark.long
def test_ppo_goes_on_from_its_agent_and_another_design_is_refused(illustrative):
    problem = illustrative.problem()
    design = [2.0]

    def starts(rng):
        x0, w = problem.scenarios.sample(16, 20, rng)
        return Scenario(problem.model, x0, np.array(w))

    found = imitate(
        saturated_lqr(problem, design), starts, objective=problem.objective, limits=problem.input_bounds, design=design,
        rng=np.random.default_rng(0), rounds=1, config=QUICK, limit=problem.limit,
    )  # fmt: skip
    env = EpisodeEnv(problem, design, runs=4, rng=np.random.default_rng(0))
    trained = train(env, found.agent, iterations=1, steps=problem.steps, generator=torch.Generator().manual_seed(0))
    assert len(trained.rows) == 1
    assert simulate(problem.model, found.controller, x0=[[0.1, 0.1]], steps=3, design=design).inputs.shape == (1, 3, 1)
    with pytest.raises(InputError, match="design of the policy"):
        simulate(problem.model, found.controller, x0=[[0.1, 0.1]], steps=3, design=[1.5])


@pytest.mark.parametrize(("change", "match"), [
    ({"expert": 3}, "controller: got 3"),
    ({"scenario": drawn(np.random.default_rng(0))}, "scenario: got a Scenario"),
    ({"scenario": lambda rng: 3}, "scenario: got 3"),
    ({"scenario": lambda rng: Scenario(PLANT, [0, 0], np.zeros((3, 2))), "history": 2},
     "scenario: got one without output"),
    ({"history": -1}, "history: got -1"),
    ({"rounds": 0}, "rounds: got 0"),
    ({"objective": 3}, "objective: got 3"),
    ({"limits": (3, -3)}, "limits: got"),
    ({"limits": 1.0}, "limits: got 1"),
    ({"limits": ([-1, -1], [1, 1])}, "limits: got"),
    ({"gamma": 2.0}, "gamma: got 2"),
    ({"expert": LinearFeedback([[-99.0, -99.0]]), "scenario": lambda rng: Scenario(PLANT, [1, 1], np.zeros((60, 2)))},
     "expert: got one that loses every run"),
])  # fmt: skip
def test_wrong_arguments_are_named(change, match):
    with pytest.raises(InputError, match=match):
        imitated(**change)


def test_a_history_needs_outputs_and_a_policy_without_needs():
    with pytest.raises(InputError, match="y, u_prev: got nothing"):
        History(LQR, 3)([0.0, 0.0])
    with pytest.raises(InputError, match="controller: got one that needs"):
        History(LQG, 3)
    with pytest.raises(InputError, match="length: got 0"):
        History(LQR, 0)


@pytest.mark.check
def test_every_round_draws_runs_of_its_own():
    starts = []

    def noted(rng):
        starts.append(drawn(rng).x0.tobytes())
        return drawn(rng)

    imitated(LQR, noted, rounds=2)
    assert len(set(starts)) == 3


@pytest.mark.long
def test_a_design_of_any_size_is_the_policys_own():
    space = DesignSpace(["k"], [1e8], [1e9], ["N/m"])
    k = ca.SX.sym("k")
    plant = plant_from_matrices(A, B * k / 8.67637e8, np.sqrt(W), dt=0.1, p=k, design=space, continuous=False)

    def starts(rng):
        return Scenario(plant, rng.standard_normal((8, 2)), np.zeros((20, 2)))

    found = imitated(LQR, starts, design=[8.67637e8], rounds=1)
    assert found.controller.design == pytest.approx([8.67637e8])


def test_a_history_of_other_sizes_is_refused():
    law = History(LQR, 1)
    with pytest.raises(InputError, match=r"u_prev: got shape \(1, 1\), expected \(2, 1\)"):
        law(y=[[1.0], [2.0]], u_prev=[[0.0]])
