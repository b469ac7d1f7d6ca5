"""What test_uncertain_parameters.py claims, seen from inside."""

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    CoDesignConfig,
    CoDesignProblem,
    DesignSpace,
    DigitalTwin,
    FixedStart,
    Gaussian,
    Plant,
    QuadraticObjective,
    Recorded,
    Scenario,
    codesign,
    compare,
    deploy,
    discretise,
    saturated_lqr,
    simulate,
)
from ccdtools.co_design import expert_dataset, feasible_sets
from ccdtools.comparison.pid_tuning import tuned_pid
from ccdtools.disturbances import Constant, Mixture, Stacked, Uniform
from ccdtools.studies.plant_checks import extent_of
from ccdtools.studies.trust_region import attribute_errors
from ccdtools.twin import replay_problem, updated_problem
from ccdtools.twin.transport import check_disturbance_enters
from learning import CloningConfig, NetworkConfig, fit_actor_critic
from mpc import lqr

X, U = ([-1.0, -3.0], [1.0, 3.0]), (-5.0, 5.0)
P = [4.0, 0.5]
DISTURBANCE = Stacked((Gaussian([0.3]), Constant(Uniform([-0.4], [0.4]))))


def spring(mass=None):
    """A mass on a spring: 1 kg, or 1 + θ with θ the second disturbance."""
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p", 2)
    w = ca.SX.sym("w", 2 if mass is None else 1)
    own = 1 + w[1] if mass is None else mass
    dynamics = ca.vertcat(x[1], (-p[0] * x[0] - p[1] * x[1] + u + w[0]) / own)
    return Plant(x, u, w, p, dynamics, DesignSpace(["k", "c"], [1.0, 0.1], [10.0, 2.0]), dt=0.1)


@pytest.fixture(scope="module")
def model():
    """As accurate for every mass."""
    return discretise(spring(), X=X, U=U, W=([-1.5, -0.4], [1.5, 0.4]))


@pytest.fixture(scope="module")
def problem(model):
    """On the uncertain mass."""
    return CoDesignProblem(
        model, X=X, U=U, objective=QuadraticObjective(np.diag([10.0, 1.0]), [[0.1]]),
        scenarios=FixedStart([0.5, 0.0], DISTURBANCE), steps=40, limit_tolerance="off",
    )  # fmt: skip


def test_lqr_and_sets_are_those_of_the_nominal_mass(model, problem):
    exact = discretise(spring(1.0))
    A, B, E = model.matrices(P)
    for M, wanted in zip((A, B, E[:, :1]), exact.matrices(P)):
        np.testing.assert_allclose(M, wanted, atol=1e-6)
    np.testing.assert_allclose(E[:, 1], 0, atol=1e-12)  # a mass has no effect at rest
    check_disturbance_enters(model)
    K, _ = lqr(*exact.matrices(P)[:2], Q=problem.objective.Q, R=problem.objective.R)
    np.testing.assert_allclose(saturated_lqr(problem, P).K, K, rtol=1e-5)
    own = feasible_sets(problem).result(P).set
    exact_problem = CoDesignProblem(
        exact, X=X, U=U, objective=problem.objective, scenarios=FixedStart([0.5, 0.0], Gaussian([0.3])), steps=40
    )
    other = feasible_sets(exact_problem).result(P).set
    directions = np.random.default_rng(0).standard_normal((50, 2))
    np.testing.assert_allclose(own.support(directions), other.support(directions), rtol=1e-4)


@pytest.mark.slow
def test_the_whole_loop_takes_it(problem, rng):
    data = expert_dataset(problem, samples=60, sets="lqr", rng=rng)
    agent = fit_actor_critic(
        data.inputs, data.actions, data.values, action_bounds=problem.input_bounds,
        input_bounds=problem.observation_bounds, rng=rng, network=NetworkConfig((16, 16)),
        config=CloningConfig(steps=300, batch=128),
    )  # fmt: skip
    config = CoDesignConfig(iterations=5, block=5, starts=1, pathwise_runs=16, evaluation_runs=30, evaluate_every=5)
    result = codesign(problem, agent=agent, design=P, rng=rng, config=config)
    x0, w = problem.scenarios.sample(20, 40, rng)
    laws = {"LQR": saturated_lqr(problem, result.design), "learned": result.policy}
    scenario = Scenario(problem.model, x0, w)
    table = compare(laws, scenario, design=result.design, objective=problem.objective, X=problem.X)
    assert np.isfinite(table["learned"].summary.mean)
    log = deploy(spring(), result.policy, result.design, DISTURBANCE.sample(10, 60, rng), x0=[0.5, 0.0])
    twin = DigitalTwin(problem.model).update(log, weight=0.1 * problem.objective.Q, rng=rng)
    assert 0 <= attribute_errors(twin, problem.state_scale).rest <= 1
    for redesign in (updated_problem(problem, twin), replay_problem(problem, twin.logs, 20)):
        again = codesign(redesign, agent=result.agent, design=result.design, rng=rng, config=config)
        assert np.isfinite(again.history.model_return).all()


def test_tuning_a_pid_leaves_the_mass_where_it_is(model, monkeypatch, rng):
    """An offset of a mass that may be half as heavy could make it negative."""
    from ccdtools.comparison import pid_tuning

    seen = []
    monkeypatch.setattr(pid_tuning, "simulate", lambda *a, **k: seen.append(k["disturbance"]) or simulate(*a, **k))
    heavy = Stacked((Gaussian([0.3]), Constant(Uniform([-0.9], [0.9]))))
    problem = CoDesignProblem(
        model, X=X, U=U, objective=QuadraticObjective(np.diag([10.0, 1.0]), [[0.1]]),
        scenarios=FixedStart([0.5, 0.0], heavy), steps=20,
    )  # fmt: skip
    tuned_pid(problem, P, rng=rng, runs=64, screened=3, starts=1, refinements=3)
    assert np.abs(seen[0][..., 1]).max() <= 0.9
    assert np.abs(seen[0][..., 0].mean(axis=1)).max() > 0.3  # the noise has its offsets


def test_the_extent_of_a_mass_is_looked_up_over_runs_and_on_its_own_side():
    lower, upper = extent_of(Stacked((Gaussian([0.3]), Constant(Uniform([-0.2], [3.0])))))
    assert -0.2 <= lower[1] < -0.15
    assert 2.9 < upper[1] <= 3.0
    assert upper[0] == -lower[0] > 0.8
    lower, upper = extent_of(Mixture((Gaussian([0.1]), Gaussian([10.0])), weights=(9, 1)))
    assert upper[0] > 10
    np.testing.assert_array_equal(extent_of(Recorded([0.0, 2.0, -1.0])), [[-2.0], [2.0]])
