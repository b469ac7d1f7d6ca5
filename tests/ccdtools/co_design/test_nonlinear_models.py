"""The loop on models that are not linear: where both apply the same as on linear ones, elsewhere better than LQR."""

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
    InputError,
    LinearFeedback,
    Plant,
    QuadraticObjective,
    baselines,
    codesign,
    discretise,
    simulate,
)
from ccdtools.co_design import expert_dataset
from ccdtools.plants import SampledModel
from ccdtools.plants.library import pendulum_on_cart
from ccdtools.twin import replay_problem
from learning import CloningConfig, NetworkConfig, fit_actor_critic

NOISE = Gaussian([0.2])


def oscillator():
    """A mass on a spring, linear, its mass and damper the design."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    dynamics = ca.vertcat(x[1], (-2 * x[0] - p[1] * x[1] + u + w) / p[0])
    return Plant(x, u, w, p, dynamics, DesignSpace(["m", "d"], [0.5, 0.1], [2.0, 0.6]), dt=0.1)


def problem_of(model, *, x0=(0.5, 0.0), Q=None, X=None, U=(-2.0, 2.0), steps=30):
    X = ([-1.0, -2.0], [1.0, 2.0]) if X is None else X
    Q = np.diag([5.0, 1.0]) if Q is None else Q
    return CoDesignProblem(
        model, X=X, U=U, objective=QuadraticObjective(Q, [[0.1]]), scenarios=FixedStart(x0, NOISE), steps=steps
    )


@pytest.fixture(scope="module")
def pair():
    """The exact model of a linear plant, and the same plant integrated as if it were not linear."""
    plant = oscillator()
    return discretise(plant), SampledModel(plant, plant.dt, "rk4", 32)


@pytest.fixture(scope="module")
def cart():
    """A pole on a cart from 0.5 rad."""
    X = ([-2.0, -4.0, -1.2, -6.0], [2.0, 4.0, 1.2, 6.0])
    model = discretise(pendulum_on_cart(), X=X, U=(-10.0, 10.0), W=(-0.6, 0.6))
    return problem_of(model, x0=(0.0, 0.0, 0.5, 0.0), Q=np.diag([1.0, 0.1, 10.0, 0.1]), X=X, U=(-10.0, 10.0), steps=100)


# ── against the exact model of a linear plant ──


def test_logged_errors_and_their_replay_are_those_of_the_exact_model(pair):
    rng = np.random.default_rng(3)
    log = simulate(
        oscillator(), LinearFeedback([[1.0, 1.0]]), x0=np.tile([0.5, 0.0], (20, 1)), steps=30, disturbance=NOISE,
        design=[0.9, 0.3], rng=rng,
    )  # fmt: skip
    replayed = []
    for model in pair:
        twin = DigitalTwin(model).remembering(log)
        problem = replay_problem(problem_of(model), twin.logs, 30)
        assert problem.notes == problem_of(model).notes
        x0, w = problem.scenarios.sample(5, 30, np.random.default_rng(0))
        run = simulate(problem.model, LinearFeedback([[2.0, 0.5]]), x0=x0, steps=30, disturbance=w, design=[1.4, 0.2])
        replayed.append((twin.logs[0].e_next, run.states))
    for own, exact in zip(replayed[1], replayed[0]):
        np.testing.assert_allclose(own, exact, atol=1e-6)


@pytest.mark.check
def test_the_same_co_design_is_found_on_both_models(pair):
    def designed(model):
        problem = problem_of(model)
        rng = np.random.default_rng(0)
        data = expert_dataset(problem, samples=60, rng=rng, sets="lqr")
        agent = fit_actor_critic(
            data.inputs, data.actions, data.values, rng=rng, action_bounds=problem.input_bounds,
            input_bounds=problem.observation_bounds, network=NetworkConfig((16,)), config=CloningConfig(steps=300),
        )  # fmt: skip
        few = CoDesignConfig(iterations=10, block=10, starts=1, pathwise_runs=64, evaluation_runs=100)
        return codesign(problem, agent=agent, design=[1.0, 0.3], rng=rng, config=few).design

    np.testing.assert_allclose(designed(pair[1]), designed(pair[0]), atol=0.02)


# ── a pole on a cart ──


def test_errors_are_added_to_the_next_state(cart):
    model = cart.model.with_errors()
    rng = np.random.default_rng(0)
    x, u, w, r, p = (rng.uniform(-0.5, 0.5, (3, n)) for n in (4, 1, 1, 4, 2))
    p = np.abs(p) + 0.5
    both = np.hstack([w, r])
    np.testing.assert_allclose(model.advance(x, u, both, p), cart.model.advance(x, u, w, p) + r, rtol=1e-14)
    native = np.asarray(model.step(x.T, u.T, both.T, p.T)).T
    np.testing.assert_allclose(native, model.advance(x, u, both, p), rtol=1e-12)
    assert model.nw == 5


def test_baselines_of_a_pole_keep_it_up(cart):
    for name, controller in baselines(cart, [0.5, 0.5], rng=np.random.default_rng(0)).items():
        run = simulate(
            cart.model, controller, x0=[0.0, 0.0, 0.3, 0.0], steps=100, disturbance=NOISE, design=[0.5, 0.5],
            rng=np.random.default_rng(0),
        )  # fmt: skip
        fallen = np.abs(run.states[0, :, 2]).max() > 1.2
        assert fallen == (name in ("passive", "PID"))


# ── what is refused ──


def test_a_plant_that_does_not_rest_at_zero_is_refused_with_the_state_that_moves():
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    hanging = ca.vertcat(x[1], -9.81 - p * x[0] - x[0] ** 3 + u + w)
    plant = Plant(x, u, w, p, hanging, DesignSpace(["k"], [20.0], [80.0]), dt=0.05, state_names=["s [m]", "v [m/s]"])
    with pytest.raises(InputError, match=r"does not rest at x = 0, u = 0: v \[m/s\] moves by .* k = 20") as error:
        problem_of(discretise(plant))
    assert "deviations(plant, equilibrium(plant, p))" in str(error.value)


def test_what_is_no_model_is_refused():
    with pytest.raises(InputError, match="model: got 3, expected a LinearModel or a SampledModel"):
        DigitalTwin(3)
    with pytest.raises(InputError, match="model: got"):
        problem_of(oscillator())
