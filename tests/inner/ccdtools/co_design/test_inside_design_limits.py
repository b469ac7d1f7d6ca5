"""What test_design_limits.py claims, seen from inside."""

import copy

import numpy as np
import pytest
import torch
from actuated_plants import X0, in_parts, native, range_of, room, room_of

from ccdtools import InputError, LearnedPolicy, Scenario, codesign, compare, simulate
from ccdtools.co_design import expert_dataset
from ccdtools.co_design.design_gradients import Differences
from ccdtools.co_design.differentiable_model import episode, episode_at, scenario_tensors, to_design
from ccdtools.co_design.landscape import Landscape
from ccdtools.design_limits import DesignLimits
from learning import ActorCritic, CloningConfig, NetworkConfig, fit_actor_critic

DESIGNS = np.array([[0.5], [1.3], [3.0]])


def untrained(problem, seed=0, gain=3.0):
    """An agent whose inputs saturate now and then."""
    lower, upper = problem.input_bounds
    limits = problem.U if isinstance(problem.U, DesignLimits) else None
    agent = ActorCritic(*problem.observation_bounds, lower, upper, config=NetworkConfig((8,)), imitates=True,
                        seed=seed, action_limits=limits)  # fmt: skip
    with torch.no_grad():
        agent.mean_network.head.weight.mul_(gain)
    return agent


def cloned(problem):
    """An agent that imitates LQR, roughly."""
    data = expert_dataset(problem, samples=150, sets="lqr", rng=np.random.default_rng(0))
    return fit_actor_critic(
        data.inputs, data.actions, data.values, action_bounds=problem.action_bounds,
        input_bounds=problem.observation_bounds, rng=np.random.default_rng(0), network=NetworkConfig((16,)),
        config=CloningConfig(steps=300, batch=256),
    )  # fmt: skip


@pytest.fixture(scope="module")
def pair():
    """Both statements of the problem, with an agent each."""
    return [(problem, cloned(problem)) for problem in (native(), in_parts())]


# --- the plant in parts of its actuator as the oracle -------------------------------------------------------


def test_episodes_and_their_slope_in_the_design_are_those_of_the_plant_in_parts():
    returns, slopes = [], []
    for problem in (native(), in_parts()):
        agent = untrained(problem).double()
        v = torch.tensor([0.35], dtype=torch.float64, requires_grad=True)
        scenarios = tuple(part.double() for part in scenario_tensors(problem, 30, np.random.default_rng(1)))
        total = episode_at(problem, agent, v, scenarios).total
        returns.append(total.detach().numpy())
        slopes.append(torch.autograd.grad(total.mean(), v)[0].numpy())
    np.testing.assert_allclose(returns[0], returns[1], rtol=1e-6)  # the ranges of observations are in single precision
    np.testing.assert_allclose(slopes[0], slopes[1], rtol=1e-5)


def test_the_slope_through_a_saturated_policy_is_that_of_differences():
    problem = native()
    agent = untrained(problem, gain=30.0)
    scenarios = scenario_tensors(problem, 20, np.random.default_rng(2))
    v = torch.tensor([0.4], dtype=torch.float64, requires_grad=True)
    double = copy.deepcopy(agent).double()
    total = episode_at(problem, double, v, tuple(part.double() for part in scenarios)).total
    (slope,) = torch.autograd.grad(total.mean(), v)
    by_differences = Differences(problem, agent, scenarios).about(v, 1e-4).mean(0)
    np.testing.assert_allclose(slope.numpy(), by_differences.numpy(), rtol=1e-3)
    at_bound = LearnedPolicy(agent, to_design(problem, v.detach()).numpy())
    inputs = simulate(problem.model, at_bound, x0=X0, steps=40, design=at_bound.design).inputs
    assert np.isclose(inputs, np.array(range_of(at_bound.design))).any(axis=-1).mean() > 0.2


def test_the_landscape_of_saturated_lqr_is_the_same():
    V = np.linspace(0, 1, 7)[:, None]
    own, other = (Landscape(problem, np.random.default_rng(0)).returns(V) for problem in (native(), in_parts()))
    np.testing.assert_allclose(own, other, rtol=1e-4)


@pytest.mark.parametrize("p", DESIGNS)
def test_depths_outside_are_in_half_widths_of_the_room_at_the_design(p):
    problem = native(X=room, warm_up=0)
    agent = untrained(problem, gain=0.5)
    scenarios = scenario_tensors(problem, 25, np.random.default_rng(3))
    design = torch.tensor(p, dtype=torch.float32)
    seen = episode(problem, agent, design, scenarios, depths=True)
    policy = LearnedPolicy(agent, p)
    run = simulate(problem.model, policy, x0=scenarios[0].numpy(), steps=problem.steps, design=p,
                   disturbance=scenarios[1].numpy(), limit=problem.limit)  # fmt: skip
    lower, upper = room_of(p)
    after = run.states[:, 1:]
    half = (upper - lower) / 2
    depth = np.maximum((after - upper) / half, (lower - after) / half).max(axis=2).clip(min=0)
    kept = ~run.diverged
    np.testing.assert_allclose(seen.peak.detach()[kept], depth.max(axis=1)[kept], rtol=2e-3, atol=1e-4)
    assert depth.max() > 0
    scenario = Scenario(problem.model, scenarios[0].numpy(), scenarios[1].numpy())
    scores = compare({"LQR": policy}, scenario, design=p, objective=problem.objective, X=problem.X, limit=problem.limit)
    assert scores["LQR"].violations == pytest.approx((depth[kept] > 0).mean(), abs=2e-3)


def test_the_depth_falls_with_the_room_as_differences_say():
    problem = native(X=room)
    agent = untrained(problem, gain=0.5).double()
    scenarios = tuple(part.double() for part in scenario_tensors(problem, 25, np.random.default_rng(3)))

    def peak(v):
        return episode_at(problem, agent, v, scenarios, depths=True).peak.mean()

    v = torch.tensor([0.7], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(peak(v), v)
    h = 1e-5
    with torch.no_grad():
        differences = (peak(v + h) - peak(v - h)) / (2 * h)
    assert slope.item() == pytest.approx(differences.item(), rel=1e-3)
    assert abs(slope.item()) > 1e-3


@pytest.mark.long
def test_an_agent_with_other_limits_is_refused(pair):
    problem, agent = pair[0]
    for other in (native(U=lambda p: (-p[0], 2 * p[0] ** 0.5)), in_parts()):
        with pytest.raises(InputError) as caught:
            codesign(other, agent=agent, design=[1.0], rng=np.random.default_rng(0))
        assert caught.value.argument == "agent"
    fixed = untrained(native(U=problem.input_bounds))
    with pytest.raises(InputError, match="action_bounds"):
        codesign(problem, agent=fixed, design=[1.0], rng=np.random.default_rng(0))
