"""The batched torch model: the same numbers as the NumPy simulation, and gradients in the design."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ccdtools import LearnedPolicy, QuadraticObjective, simulate
from ccdtools.co_design.differentiable_model import (
    Stepper,
    episode,
    matrices,
    mean_law,
    observe,
    scenario_tensors,
    to_design,
)
from ccdtools.twin.discrepancy import Discrepancy
from learning.quantile import QuantileNetwork


def floats(values):
    return torch.tensor(np.asarray(values), dtype=torch.float32)


def double(values):
    return torch.tensor(np.asarray(values), dtype=torch.float64)


def test_the_matrices_are_those_of_the_model(study):
    for own, exact in zip(matrices(study.model, double(study.p0)), study.model.matrices(study.p0)):
        np.testing.assert_allclose(own.numpy(), exact, rtol=1e-14, atol=1e-16)


def test_the_gradient_of_the_matrices_is_the_analytic_derivative(study, rng):
    weights = [double(rng.standard_normal(M.shape)) for M in study.model.matrices(study.p0)]
    p = double(study.p0).requires_grad_(True)
    (sum((W * M).sum() for W, M in zip(weights, matrices(study.model, p)))).backward()
    derivatives = study.model.derivatives(study.p0)
    expected = sum(np.einsum("ij,ijk->k", W.numpy(), D) for W, D in zip(weights, derivatives))
    np.testing.assert_allclose(p.grad.numpy(), expected, rtol=1e-10)


def test_the_unit_box_becomes_designs(suspension):
    problem = suspension.problem()
    np.testing.assert_allclose(to_design(problem, double([0.0, 1.0])).numpy(), [1e4, 3000])


def test_observations_are_states_beside_the_design():
    out = observe(torch.zeros(3, 2), torch.tensor([7.0, 8.0]))
    assert out.tolist() == [[0, 0, 7, 8]] * 3


@pytest.mark.long
def test_returns_in_torch_equal_a_simulation_of_the_same_policy(study, clone):
    problem, agent = study.problem(), clone(study)
    x0, w = problem.scenarios.sample(20, 30, np.random.default_rng(2))
    with torch.no_grad():
        seen = episode(problem, agent, floats(study.p0), (floats(x0), floats(w)))
    run = simulate(study.model, LearnedPolicy(agent, study.p0), x0=x0, steps=30, disturbance=w, design=study.p0)
    np.testing.assert_allclose(seen.total, run.returns(study.objective), rtol=2e-4)
    assert not seen.diverged.any()


class Scaled(QuadraticObjective):
    """Three times the reward."""

    def rewards(self, x_next, u, x=None, p=None):
        return 3.0 * super().rewards(x_next, u)


@pytest.mark.check
def test_an_objective_of_ones_own_is_what_the_design_is_trained_on(illustrative, clone):
    problem, agent = illustrative.problem(), clone(illustrative)
    own = replace(problem, objective=Scaled(problem.objective.Q, problem.objective.R))
    scenarios = scenario_tensors(problem, 20, np.random.default_rng(0))
    with torch.no_grad():
        plain, scaled = (episode(one, agent, torch.tensor([2.0]), scenarios).total for one in (problem, own))
    torch.testing.assert_close(scaled, 3.0 * plain)


@pytest.mark.long
def test_a_run_that_diverges_is_frozen_and_counted_as_in_a_simulation(illustrative, clone):
    problem, agent = illustrative.problem(), clone(illustrative)
    x0 = np.array([[-10.0, -5.0], [0.0, 0.0]])
    w = np.zeros((2, 80, 2))
    with torch.no_grad():
        seen = episode(problem, agent, floats([1.0]), (floats(x0), floats(w)))
    run = simulate(
        problem.model, LearnedPolicy(agent, [1.0]), x0=x0, steps=80, disturbance=w, design=[1.0], limit=problem.limit
    )
    assert seen.diverged.tolist() == run.diverged.tolist() == [True, False]
    np.testing.assert_allclose(seen.total, run.returns(problem.objective), rtol=1e-3)


def test_gradients_flow_through_a_whole_episode(study, clone):
    problem, agent = study.problem(), clone(study)
    p = torch.tensor(study.p0, dtype=torch.float32, requires_grad=True)
    seen = episode(problem, agent, p, scenario_tensors(problem, 4, np.random.default_rng(0)))
    seen.total.mean().backward()
    assert torch.isfinite(p.grad).all()
    assert p.grad.abs().min() > 0
    for parameter in agent.parameters():
        parameter.grad = None


def learned(nx, nu, level_gap=1.0):
    network = QuantileNetwork(2 * nx + nu, nx, (0.1, 0.5, 0.9), (4,), seed=1)
    network.output_scale.fill_(0.01)
    network.calibration.fill_(level_gap)
    return network


def test_a_discrepancy_replaces_the_disturbance_and_is_penalised_for_its_width(illustrative):
    network = learned(2, 1)
    problem = replace(illustrative.problem(), discrepancy=Discrepancy(network, 3.0 * np.eye(2)))
    step = Stepper.at(problem, torch.tensor([2.0]))
    x, e, u, w = torch.randn(5, 2), 0.01 * torch.randn(5, 2), torch.randn(5, 1), 100 * torch.ones(5, 2)
    with torch.no_grad():
        x_next, e_next, reward = step(x, e, u, w)
        quantiles = network(torch.cat([e, x, u], dim=-1))
    A, B, _ = (torch.tensor(M, dtype=torch.float32) for M in illustrative.model.matrices([2.0]))
    torch.testing.assert_close(e_next, quantiles[:, 1])
    torch.testing.assert_close(x_next, x @ A.T + u @ B.T + e_next)
    width = quantiles[:, 2] - quantiles[:, 0]
    expected = -x_next.square().sum(-1) - 0.1 * u[:, 0] ** 2 - 3.0 * width.square().sum(-1)
    torch.testing.assert_close(reward, expected)


@pytest.mark.parametrize("noise", ["none", "quantiles", "replayed"])
def test_scenarios_carry_what_the_noise_asks_for(illustrative, noise):
    problem = replace(illustrative.problem(), discrepancy=Discrepancy(learned(2, 1), np.eye(2), noise=noise))
    x0, w = scenario_tensors(problem, 6, np.random.default_rng(0))
    assert x0.dtype == w.dtype == torch.float32
    assert w.shape == (6, 100, 2)
    if noise == "quantiles":
        assert 0 <= w.min() < 0.01
        assert 0.99 < w.max() <= 1


@pytest.mark.parametrize("held", [1, 20, 1000])
def test_penalties_of_an_episode_are_those_of_its_steps(illustrative, clone, monkeypatch, held):
    """Found for many steps at once, or for few, where there are many runs."""
    monkeypatch.setattr("ccdtools.co_design.differentiable_model.HELD_SAMPLES", held)
    problem = replace(illustrative.problem(), discrepancy=Discrepancy(learned(2, 1), 3.0 * np.eye(2)), steps=7)
    agent, p = clone(illustrative), torch.tensor([2.0])
    x0, w = scenario_tensors(problem, 5, np.random.default_rng(0))
    step, law = Stepper.at(problem, p), mean_law(agent, p)
    with torch.no_grad():
        x, e, total = x0, torch.zeros_like(x0), torch.zeros(5)
        for k in range(7):
            x, e, reward = step(x, e, law(x), w[:, k])
            total = total + reward
        torch.testing.assert_close(episode(problem, agent, p, (x0, w)).total.float(), total)
