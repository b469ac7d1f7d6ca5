"""Whole episodes: exact gradients in bounded memory, lost runs frozen, and the depth outside X."""

import copy
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from nonlinear_plants import swing

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    Gaussian,
    InputError,
    LearnedPolicy,
    QuadraticObjective,
    RandomStarts,
    simulate,
)  # fmt: skip
from ccdtools.co_design import differentiable_model
from ccdtools.co_design.differentiable_model import (
    Stepper,
    episode,
    episode_at,
    fewer_runs,
    mean_law,
    scenario_tensors,
    simulated,
)
from ccdtools.plants import BlackBox, SampledModel


def test_the_folded_law_is_the_policy(study, clone):
    agent = clone(study)
    x = torch.randn(50, study.model.nx) * torch.tensor(study.problem().state_scale, dtype=torch.float32)
    p = torch.tensor(study.p0, dtype=torch.float32)
    with torch.no_grad():
        direct = agent.action(agent.latent(torch.cat([x, p.expand(50, -1)], dim=-1)))
        torch.testing.assert_close(
            mean_law(agent, p)(x), direct, rtol=1e-4, atol=1e-4 * study.problem().input_bounds[1][0]
        )


def test_one_design_for_each_run_gives_what_they_give_alone(study, clone):
    problem, agent = study.problem(), copy.deepcopy(clone(study)).double()
    x0, w = (t.double() for t in scenario_tensors(problem, 3, np.random.default_rng(0)))
    v = torch.rand(3, problem.design.dim, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        together = episode_at(problem, agent, v, (x0, w)).total
        alone = [episode_at(problem, agent, v[i], (x0[i : i + 1], w[i : i + 1])).total.item() for i in range(3)]
    np.testing.assert_allclose(together, alone, rtol=1e-9)


def test_a_run_without_a_number_is_lost_at_the_limit_and_has_no_slope_there():
    def advance(x, u, w, p):
        after = x + 0.1 * u + w
        after[x[:, 0] > 1.0] = np.nan
        return after

    box = BlackBox(advance, nx=1, nu=1, nw=1, dt=0.1, design=DesignSpace(["p"], [0.5], [1.5]), batched=True)
    problem = CoDesignProblem(
        box, X=(-2, 2), U=(-1, 1), objective=QuadraticObjective([[1.0]], [[0.1]]), steps=4, divergence=10.0,
        scenarios=RandomStarts([[1.5], [0.5]], Gaussian([0.1])),
    )  # fmt: skip
    x0, w = torch.tensor([[1.5], [0.5]], dtype=torch.float64), torch.zeros(2, 4, 1, dtype=torch.float64)
    gain = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    seen = simulated(Stepper.at(problem, x0.new_ones(1)), lambda x: -gain * x, (x0, w))
    assert seen.diverged.tolist() == [True, False]
    kept = [0.5 * 0.95**k for k in range(5)]
    expected = [-(20.0**2 + 0.1 * 0.75**2), -sum(after**2 + 0.1 * (0.5 * x) ** 2 for x, after in pairwise(kept))]
    np.testing.assert_allclose(seen.total.detach(), expected, rtol=1e-9)
    (slope,) = torch.autograd.grad(seen.total[0], gain)
    assert slope == pytest.approx(-0.2 * 0.5 * 1.5**2)  # of the input that was paid for


def gradients(problem, agent, scenarios):
    v = torch.tensor([0.4] * problem.design.dim, dtype=torch.float64, requires_grad=True)
    seen = episode_at(problem, agent, v, scenarios)
    return torch.autograd.grad(seen.total.mean(), [v, *agent.mean_network.parameters()])


@pytest.mark.check
def test_a_long_episode_has_the_gradient_of_one_that_is_held_in_memory_at_once(suspension, clone, monkeypatch):
    problem, agent = replace(suspension.problem(), steps=230), copy.deepcopy(clone(suspension)).double()
    scenarios = tuple(t.double() for t in scenario_tensors(problem, 4, np.random.default_rng(0)))
    monkeypatch.setattr(differentiable_model, "HELD_SAMPLES", 4 * 229)
    recomputed = gradients(problem, agent, scenarios)
    monkeypatch.setattr(differentiable_model, "HELD_SAMPLES", 4 * 230)
    at_once = gradients(problem, agent, scenarios)
    for own, expected in zip(recomputed, at_once):
        torch.testing.assert_close(own, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.check
def test_a_long_episode_returns_what_a_simulation_in_double_precision_returns(suspension, clone):
    problem, agent = replace(suspension.problem(), steps=5000), clone(suspension)
    x0, w = problem.scenarios.sample(4, 5000, np.random.default_rng(0))
    p = torch.tensor(suspension.p0, dtype=torch.float32)
    with torch.no_grad():
        seen = episode(problem, agent, p, tuple(torch.tensor(a, dtype=torch.float32) for a in (x0, w)))
    run = simulate(
        problem.model, LearnedPolicy(agent, suspension.p0), x0=x0, steps=5000, disturbance=w, design=suspension.p0
    )
    np.testing.assert_allclose(seen.total, run.returns(problem.objective), rtol=1e-5)


def test_runs_lost_in_a_later_segment_are_frozen_there(illustrative, clone):
    problem, agent = illustrative.problem(), clone(illustrative)
    w = np.zeros((2, 230, 2))
    w[0, 150] = [-40.0, -40.0]
    x0 = np.zeros((2, 2))
    p = torch.tensor([1.0], requires_grad=True)
    seen = episode(problem, agent, p, tuple(torch.tensor(a, dtype=torch.float32) for a in (x0, w)))
    run = simulate(
        problem.model, LearnedPolicy(agent, [1.0]), x0=x0, steps=230, disturbance=w, design=[1.0], limit=problem.limit
    )
    assert seen.diverged.tolist() == run.diverged.tolist() == [True, False]
    np.testing.assert_allclose(seen.total.detach(), run.returns(problem.objective), rtol=1e-3, atol=1e-5)
    (gradient,) = torch.autograd.grad(seen.total[1], p)
    assert torch.isfinite(gradient).all()


def test_depths_are_in_half_widths_and_differentiable(illustrative, clone):
    problem, agent = illustrative.problem(), clone(illustrative)
    x0 = np.array([[-3.5, -2.0], [0.0, 0.0]])
    w = np.zeros((2, 100, 2))
    w[1, 30] = [9.0, 0.0]
    p = torch.tensor([3.0], requires_grad=True)
    scenarios = tuple(torch.tensor(a, dtype=torch.float32) for a in (x0, w))
    seen = episode(problem, agent, p, scenarios, depths=True)
    run = simulate(problem.model, LearnedPolicy(agent, [3.0]), x0=x0, steps=100, disturbance=w, design=[3.0])
    x = run.states[:, 1:]
    lower, upper = np.array([-10, -5]), np.array([5, 2])
    depth = (np.maximum(x - upper, lower - x) / ((upper - lower) / 2)).max(axis=-1).clip(0)
    np.testing.assert_allclose(seen.depth.detach(), depth.mean(axis=1), rtol=1e-3)
    np.testing.assert_allclose(seen.peak.detach(), depth.max(axis=1), rtol=1e-3)
    np.testing.assert_allclose(seen.outside, (depth > 0).mean(axis=1))
    assert seen.peak[1] > 0.5
    (gradient,) = torch.autograd.grad(seen.depth.sum(), p)
    assert gradient.abs().item() > 0


@pytest.mark.parametrize(("runs", "steps", "expected"), [(128, 100, 128), (128, 20, 128), (128, 200, 64),
                                                         (128, 5000, 16), (4, 5000, 4)])  # fmt: skip
def test_longer_episodes_are_fewer(runs, steps, expected):
    assert fewer_runs(runs, steps) == expected


def test_episodes_of_samples_of_many_parts_are_fewer():
    models = [SampledModel(swing(), 0.1, *method) for method in (("rk4", 32), ("rk4", 256), ("collocation", 4))]
    assert [fewer_runs(1000, 100, model) for model in models] == [1000, 125, 134]


def test_a_warm_up_earns_nothing_and_is_where_the_rest_begins(illustrative, clone):
    problem, agent = replace(illustrative.problem(), steps=50), clone(illustrative)
    scenarios = scenario_tensors(problem, 8, np.random.default_rng(0))
    v = torch.tensor([0.4])
    with torch.no_grad():
        whole = episode_at(problem, agent, v, scenarios, depths=True)
        first = episode_at(problem, agent, v, (scenarios[0], scenarios[1][:, :20]), depths=True)
        rest = episode_at(replace(problem, warm_up=20), agent, v, scenarios, depths=True)
    torch.testing.assert_close(rest.total, whole.total - first.total)
    torch.testing.assert_close(rest.outside * 30, whole.outside * 50 - first.outside * 20)
    with pytest.raises(InputError, match="warm_up: got 50, expected less than 50"):
        replace(problem, warm_up=50)


def test_a_run_lost_in_the_warm_up_keeps_its_cost(illustrative, clone):
    problem, agent = replace(illustrative.problem(), steps=50), clone(illustrative)
    x0, w = scenario_tensors(problem, 2, np.random.default_rng(0))
    x0[0] *= 1e6
    with torch.no_grad():
        seen = episode_at(replace(problem, warm_up=20), agent, torch.tensor([0.4]), (x0, w))
    assert seen.diverged.tolist() == [True, False]
    assert seen.total[0] < 1e6 * seen.total[1] < 0
