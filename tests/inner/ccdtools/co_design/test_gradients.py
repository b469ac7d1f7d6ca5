"""Design gradients beside finite differences."""

import copy
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch
from small_plants import clone_of, mass

from ccdtools import CoDesignConfig, InputError, QuadraticObjective
from ccdtools.co_design.design_gradients import Differences, check_gradients, pathwise_by_run
from ccdtools.co_design.differentiable_model import episode_at, scenario_tensors, to_design
from ccdtools.co_design.environment import EpisodeEnv, loss_gradient, network_input_gradient
from ccdtools.co_design.learned_result import GradientCheck
from ccdtools.twin.discrepancy import Discrepancy
from learning import PPOConfig, collect
from learning.ppo import ppo_losses, prepare
from learning.quantile import QuantileNetwork

INTERIOR = {"illustrative": [1.8], "suspension": [27692.0, 1906.5]}


def finite_differences(problem, agent, v, x0, w, step):
    gradient = []
    with torch.no_grad():
        for i in range(len(v)):
            h = torch.zeros_like(v)
            h[i] = step
            ends = [episode_at(problem, agent, v + s * h, (x0, w)).total.mean().item() for s in (1, -1)]
            gradient.append((ends[0] - ends[1]) / (2 * step))
    return np.array(gradient)


def gradient_of_mean(problem, agent, v, scenarios):
    """∂/∂v of the mean return at one design, by one pass over all runs."""
    v = v.detach().clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(episode_at(problem, agent, v, scenarios).total.mean(), v)
    return gradient


def test_the_pathwise_gradient_equals_finite_differences_in_double_precision(study, clone):
    problem, agent = study.problem(), copy.deepcopy(clone(study)).double()
    v = torch.tensor(problem.design.to_unit(INTERIOR[study.name]))
    x0, w = (t.double() for t in scenario_tensors(problem, 32, np.random.default_rng(0)))
    own = pathwise_by_run(problem, agent, v, (x0, w)).mean(0)
    np.testing.assert_allclose(own, finite_differences(problem, agent, v, x0, w, 1e-5), rtol=1e-3)


def test_the_check_shows_the_pathwise_gradient_to_be_right(study, clone):
    check = check_gradients(study.problem(), clone(study), INTERIOR[study.name], rng=np.random.default_rng(1), runs=256)
    np.testing.assert_allclose(check.pathwise, check.finite_difference, rtol=1e-2)
    assert check.cosine("pathwise") > 0.9999
    assert check.names == study.plant.design.names
    lines = str(check).splitlines()
    assert check.trusted
    assert [line.split("  ")[0] for line in lines[1:]] == ["finite differences", "pathwise", "network input (paper)"]
    assert all(name in lines[0] for name in check.names)


def test_the_gradients_of_single_runs_add_up_to_that_of_their_mean(study, clone):
    problem, agent = study.problem(), clone(study)
    v = torch.tensor(problem.design.to_unit(INTERIOR[study.name]), dtype=torch.float32)
    scenarios = scenario_tensors(problem, 24, np.random.default_rng(0))
    by_run = pathwise_by_run(problem, agent, v, scenarios)
    assert by_run.shape == (24, problem.design.dim)
    np.testing.assert_allclose(by_run.mean(0), gradient_of_mean(problem, agent, v, scenarios), rtol=1e-3)
    apart = by_run - Differences(problem, agent, scenarios).about(v, 1e-2)  # a run whose input saturates has a kink
    assert (apart.abs().median(0).values < 0.02 * by_run.abs().mean(0)).all()


def test_at_a_bound_the_gradients_are_compared_inside_the_box(illustrative, clone, monkeypatch):
    problem = illustrative.problem()
    asked = []
    original = type(problem.model).function.func

    class Watched:
        """A CasADi function that keeps the designs that it is asked for."""

        def __init__(self, function):
            self.function = function

        def __getattr__(self, name):
            return getattr(self.function, name)

        def __call__(self, p):
            if not isinstance(p, ca.SX | ca.MX):
                asked.extend(np.ravel(p).astype(float).tolist())
            return self.function(p)

    monkeypatch.setattr(type(problem.model), "function", property(lambda model: Watched(original(model))))
    check = check_gradients(problem, clone(illustrative), [3.0], rng=np.random.default_rng(0), runs=64)
    assert check.trusted
    assert 0.5 <= min(asked) <= max(asked) <= 3.0 + 1e-6


@pytest.mark.check
def test_where_the_return_bends_within_a_hundredth_of_the_box_the_step_is_smaller():
    problem = mass(heaviest=20.0)
    agent = clone_of(problem)
    check = check_gradients(problem, agent, [0.2], rng=np.random.default_rng(0), runs=32)
    coarse = check_gradients(problem, agent, [0.2], rng=np.random.default_rng(0), runs=32, step=1e-2)
    assert not coarse.trusted
    np.testing.assert_allclose(check.pathwise, check.finite_difference, rtol=0.02)
    assert check.trusted


class Detached(QuadraticObjective):
    """Three times the reward, of which the gradient sees a third: as if it had been computed outside of torch."""

    def rewards(self, x_next, u, x=None, p=None):
        hidden = super().rewards(x_next, u)
        return super().rewards(x_next, u) + 2.0 * (hidden.detach() if torch.is_tensor(hidden) else hidden)


def test_a_gradient_that_misses_part_of_the_reward_is_not_trusted(illustrative, clone):
    problem = illustrative.started(x0=np.array([-2.0, -2.0])).problem()
    problem = replace(problem, objective=Detached(problem.objective.Q, problem.objective.R))
    check = check_gradients(problem, clone(illustrative), [1.5], rng=np.random.default_rng(0))
    assert abs(check.finite_difference[0]) > 5 * check.finite_difference_error[0]
    assert not check.trusted
    assert "differs from finite differences by more than chance" in str(check)


@pytest.mark.parametrize(
    ("pathwise", "deviation", "trusted"),
    [(2.6, 0.01, True), (6.0, 0.01, False), (-2.6, 0.01, False), (6.0, 5.0, False), (2.9, 0.2, True),
     (np.inf, 0.01, False), (np.nan, 0.01, False)],
)  # fmt: skip
def test_with_one_parameter_length_and_sign_decide(pathwise, deviation, trusted):
    check = GradientCheck(("m",), [2.6], [pathwise], [0.0], [0.1], [0.1], [deviation], 70.0)
    assert check.trusted == trusted


def test_a_slope_that_does_not_matter_is_trusted_whatever_its_sign():
    assert GradientCheck(("m",), [0.02], [-0.03], [0.0], [1e-4], [1e-4], [1e-4], 70.0).trusted


def test_the_gradient_on_a_learned_model_equals_finite_differences(illustrative, clone):
    network = QuantileNetwork(5, 2, (0.1, 0.5, 0.9), (6,), seed=0)
    network.output_scale.fill_(0.1)
    problem = replace(illustrative.problem(), discrepancy=Discrepancy(network.double(), 0.1 * np.eye(2)), steps=30)
    agent = copy.deepcopy(clone(illustrative)).double()
    v = torch.tensor(problem.design.to_unit([1.8]))
    x0, w = (t.double() for t in scenario_tensors(problem, 8, np.random.default_rng(0)))
    own = pathwise_by_run(problem, agent, v, (x0, w)).mean(0)
    np.testing.assert_allclose(own, finite_differences(problem, agent, v, x0, w, 1e-5), rtol=1e-3)


def blind(agent, nx, *, value):
    """The agent with its policy (and value) deaf to the design inputs."""
    agent = copy.deepcopy(agent)
    for network in [agent.mean_network] + [agent.value_network] * value:
        for layer in (network.body[0], network.skip):
            layer.weight.data[:, nx:] = 0.0
    return agent


def test_a_policy_that_ignores_the_design_has_no_network_input_gradient(study, clone):
    problem, nx = study.problem(), study.model.nx
    v = torch.tensor(problem.design.to_unit(INTERIOR[study.name]), dtype=torch.float32)
    options = {"runs": 16, "config": PPOConfig.warm()}
    deaf = network_input_gradient(
        problem, blind(clone(study), nx, value=True), v, rng=np.random.default_rng(0), **options
    )
    assert not deaf.any()
    through_value = network_input_gradient(
        problem, blind(clone(study), nx, value=False), v, rng=np.random.default_rng(0), **options
    )
    assert through_value.any()


def test_the_network_input_gradient_is_that_of_the_loss_with_states_held(illustrative, clone):
    problem, config = illustrative.problem(), PPOConfig.warm()
    agent = copy.deepcopy(clone(illustrative)).double()
    v = torch.tensor([0.5], dtype=torch.float64)
    env = EpisodeEnv(problem, to_design(problem, v).float(), runs=16, rng=np.random.default_rng(0))
    rollout = collect(env, clone(illustrative), steps=100, generator=torch.Generator().manual_seed(0))
    batch = prepare(clone(illustrative), rollout, config)
    batch = type(batch)(*(getattr(batch, name).double() for name in batch.__dataclass_fields__))
    own = loss_gradient(problem, agent, v, batch, config)

    def loss(at):
        observations = torch.cat(
            [batch.observations[:, :2], to_design(problem, at).expand(len(batch.targets), 1)], dim=-1
        )
        losses = ppo_losses(agent, replace(batch, observations=observations), config)
        return (losses.surrogate + losses.value).item()

    h = 1e-6
    np.testing.assert_allclose(own, [-(loss(v + h) - loss(v - h)) / (2 * h)], rtol=1e-3)


def test_gradients_leave_the_agent_and_the_point_alone(illustrative, clone):
    agent, v = clone(illustrative), torch.tensor([0.4])
    before = copy.deepcopy(agent.state_dict())
    problem = illustrative.problem()
    pathwise_by_run(problem, agent, v, scenario_tensors(problem, 4, np.random.default_rng(0)))
    assert not v.requires_grad
    assert all(parameter.grad is None for parameter in agent.parameters())
    torch.testing.assert_close(agent.state_dict(), before, rtol=0, atol=0)


def test_a_cosine_compares_directions():
    check = GradientCheck(("a", "b"), np.array([1.0, 0.0]), np.array([2.0, 0.0]), np.array([0.0, -3.0]))
    assert check.length("pathwise") == pytest.approx(2.0)
    assert check.cosine("pathwise") == pytest.approx(1.0)
    assert check.cosine("network_input") == pytest.approx(0.0)
    nothing = GradientCheck(("a",), np.zeros(1), np.zeros(1), np.zeros(1))
    assert nothing.cosine("pathwise") == 0.0


def test_designs_outside_the_bounds_and_unknown_methods_are_refused(illustrative, clone):
    with pytest.raises(InputError, match="design: got p = 9"):
        check_gradients(illustrative.problem(), clone(illustrative), [9.0], rng=np.random.default_rng(0))
    with pytest.raises(InputError, match="design_gradient: got 'magic', expected one of pathwise, network_input"):
        CoDesignConfig(design_gradient="magic")
