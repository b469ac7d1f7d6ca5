"""What test_nonlinear_models.py claims, seen from inside."""

import casadi as ca
import numpy as np
import pytest
import torch

from ccdtools import (
    CoDesignConfig,
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    Learned,
    LearnedPolicy,
    Plant,
    QuadraticObjective,
    discretise,
    saturated_lqr,
    simulate,
)
from ccdtools.co_design import expert_dataset
from ccdtools.co_design.differentiable_model import Stepper, matrices
from ccdtools.co_design.landscape import Landscape
from ccdtools.co_design.lqr_regions import LQRRegions
from ccdtools.plants import SampledModel
from ccdtools.plants.library import pendulum_on_cart
from ccdtools.statistics import paired_difference
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


def test_matrices_and_their_derivatives_are_those_of_the_exact_model(pair):
    exact, sampled = pair
    designs = exact.design.latin_hypercube(20, np.random.default_rng(0))
    for M, N in zip(exact.matrices(designs), sampled.matrices(designs)):
        np.testing.assert_allclose(N, M, atol=1e-10)
    p = torch.tensor(designs[0], requires_grad=True)
    slopes = [torch.autograd.grad(matrices(model, p)[0].square().sum(), p)[0] for model in pair]
    np.testing.assert_allclose(slopes[1], slopes[0], rtol=1e-8)


def test_steps_and_their_gradient_are_those_of_the_exact_model(pair):
    rng = np.random.default_rng(1)
    x, u, w = (torch.tensor(rng.standard_normal((6, n))) for n in (2, 1, 1))
    found = []
    for model in pair:
        p = torch.tensor([0.9, 0.3], dtype=torch.float64, requires_grad=True)
        state = x.clone().requires_grad_()
        step = Stepper.at(problem_of(model), p)
        after = step.advance(state, torch.zeros_like(state), u, step.drive(w[:, None])[:, 0])[0]
        found.append((after, *torch.autograd.grad(after.square().sum(), (state, p))))
    for own, exact in zip(found[1], found[0]):
        torch.testing.assert_close(own, exact, rtol=1e-8, atol=1e-9)


def test_the_region_of_saturated_lqr_is_that_of_the_exact_model(pair):
    designs = pair[0].design.latin_hypercube(8, np.random.default_rng(0))
    x = np.random.default_rng(1).uniform([-1, -2], [1, 2], (200, 2))
    runs = np.arange(200) % 8
    inside = [LQRRegions.of(problem_of(model), designs).contains(x, runs) for model in pair]
    assert 0.1 < inside[0].mean() < 0.95
    np.testing.assert_array_equal(*inside)


def test_the_landscape_is_that_of_the_exact_model(pair):
    V = np.random.default_rng(2).random((5, 2))
    returns = [Landscape(problem_of(model), np.random.default_rng(0)).returns(V) for model in pair]
    np.testing.assert_allclose(returns[1], returns[0], rtol=1e-4)


def test_the_fast_step_and_its_gradient_are_those_that_torch_records(cart):
    model = cart.model
    rng = np.random.default_rng(0)
    points = [torch.tensor(rng.uniform(-1, 1, (5, n)), requires_grad=True) for n in (4, 1, 1)]
    for p in ([0.6, 0.8], rng.uniform([0.3, 0.3], [1.2, 1.5], (5, 2))):
        design = torch.tensor(p, dtype=torch.float64, requires_grad=True)
        found = []
        for step in (model.pathwise, model.advance):
            after = step(*points, design)
            found.append((after, *torch.autograd.grad(after.square().sum(), (*points, design))))
        for own, recorded in zip(*found):
            torch.testing.assert_close(own, recorded, rtol=1e-10, atol=1e-12)
    assert model.pathwise is not model.advance


@pytest.mark.check
def test_a_co_design_on_a_pole_without_small_angles_is_better_than_lqr_there(cart):
    rng = np.random.default_rng(0)
    data = expert_dataset(cart, samples=150, rng=rng)
    assert "of the linearisation" in str(data.sets) or data.sets.feasible == 0
    agent = fit_actor_critic(
        data.inputs, data.actions, data.values, rng=rng, action_bounds=cart.input_bounds,
        input_bounds=cart.observation_bounds, network=NetworkConfig((32, 32)), config=CloningConfig(steps=800),
    )  # fmt: skip
    few = CoDesignConfig(iterations=40, block=20, starts=1, pathwise_runs=64, evaluation_runs=100)
    result = Learned(agent=agent, config=few).run(cart, np.array([0.5, 0.5]), rng)
    w = NOISE.sample(400, 100, np.random.default_rng(7))
    runs = [
        simulate(cart.model, law, x0=np.tile([0.0, 0.0, 0.5, 0.0], (400, 1)), steps=100, disturbance=w,
                 design=result.design).returns(cart.objective)
        for law in (LearnedPolicy(result.agent, result.design), saturated_lqr(cart, result.design))
    ]  # fmt: skip
    assert paired_difference(*runs).ci95[0] > 0
    assert result.gradients.trusted
