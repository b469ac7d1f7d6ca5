"""What test_custom_objective.py claims, seen from inside."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch

from ccdtools import (
    CoDesignProblem,
    CustomObjective,
    DesignSpace,
    FixedStart,
    Gaussian,
    LinearFeedback,
    Plant,
    QuadraticObjective,
    Trajectory,
    discretise,
    simulate,
)
from ccdtools.co_design import expert_dataset
from ccdtools.co_design.differentiable_model import Stepper, scenario_tensors, simulated, to_design
from ccdtools.co_design.environment import EpisodeEnv, loss_gradient
from learning import CloningConfig, PPOConfig, collect, fit_actor_critic
from learning.ppo import prepare

x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
ACCELERATION = -p[0] * x[0] - p[1] * x[1] + u
SPACE = DesignSpace(["k", "c"], [1.0, 0.1], [5.0, 1.0])
PLANT = Plant(x, u, w, p, ca.vertcat(x[1], ACCELERATION + w), SPACE, dt=0.1, outputs=[ACCELERATION, x[0]])
MODEL = discretise(PLANT)
Q, R, S = np.diag([2.0, 0.5]), np.array([[0.3]]), np.array([[0.2], [0.1]])
P0 = np.array([2.0, 0.5])
K = np.array([[1.0, 0.7]])


def problem(objective, steps=30, **changes):
    scenarios = FixedStart([1.0, -0.5], Gaussian([0.2]))
    return CoDesignProblem(MODEL, ([-4, -4], [4, 4]), ([-9], [9]), objective, scenarios, steps, **changes)


def loop(steps=30, runs=4):
    return simulate(
        MODEL, LinearFeedback(K), x0=np.tile([1.0, -0.5], (runs, 1)), steps=steps, disturbance=Gaussian([0.2]),
        design=P0, rng=np.random.default_rng(1),
    )  # fmt: skip


def in_training(own, run, v=None):
    """The returns of the same scenarios on the differentiable model under u = −K x."""
    design = torch.tensor(P0) if v is None else to_design(own, v)
    scenarios = (torch.tensor(run.states[:, 0]), torch.tensor(run.disturbances))
    return simulated(Stepper.at(own, design), lambda z: -z @ torch.tensor(K).T, scenarios).total


def test_a_cross_weight_costs_what_the_sums_say():
    run = loop()
    total = 0.0
    for k in range(30):
        after, now, v = run.states[0, k + 1], run.states[0, k], run.inputs[0, k]
        total -= after @ Q @ after + v @ R @ v + 2 * now @ S @ v
    objective = QuadraticObjective(Q, R, S)
    assert run.returns(objective)[0] == pytest.approx(total)
    np.testing.assert_allclose(in_training(problem(objective), run), run.returns(objective))


def stage(x, u, p):
    return (1 + p[0]) * x[0] ** 2 + ca.sqrt(1 + x[1] ** 2) - 1 + p[1] * u[0] ** 2 + 0.1 * x[0] * u[0]


def test_any_stage_and_terminal_cost_is_summed_over_present_states():
    run = loop()
    objective = CustomObjective(stage, lambda x, p: p[0] * ca.sumsqr(x) ** 2)
    z, v = run.states[2], run.inputs[2, :, 0]
    cost = 3.0 * z[:-1, 0] ** 2 + np.sqrt(1 + z[:-1, 1] ** 2) - 1 + 0.5 * v**2 + 0.1 * z[:-1, 0] * v
    expected = -cost.sum() - 2.0 * (z[-1] @ z[-1]) ** 2
    assert run.returns(objective)[2] == pytest.approx(expected)
    np.testing.assert_allclose(in_training(problem(objective), run), run.returns(objective))


def price(p):
    return 3 * p[0] + p[1] ** 2


def test_a_design_is_paid_for_once_an_episode_in_training_and_in_simulation_alike():
    run = loop()
    plain, priced = (QuadraticObjective(Q, R, design_cost=cost) for cost in (None, price))
    np.testing.assert_allclose(run.returns(plain) - run.returns(priced), 6.25)
    np.testing.assert_allclose(in_training(problem(priced), run), run.returns(priced))


def test_the_design_gradient_is_that_of_cost_and_price():
    own = problem(CustomObjective(stage, lambda x, p: p[1] * x[0] ** 2, design_cost=price))
    v = torch.tensor([0.3, 0.6], dtype=torch.float64, requires_grad=True)
    run = loop()
    (gradient,) = torch.autograd.grad(in_training(own, run, v).sum(), v)
    for i, h in enumerate(1e-6 * torch.eye(2, dtype=torch.float64)):
        ends = [in_training(own, run, (v + side * h).detach()).sum() for side in (1, -1)]
        assert float(gradient[i]) == pytest.approx(float(ends[0] - ends[1]) / 2e-6, rel=1e-6)


def test_one_design_for_every_run_is_one_design_for_all():
    own = problem(CustomObjective(stage, lambda x, p: p[1] * x[0] ** 2, design_cost=price))
    run = loop()
    scenarios = (torch.tensor(run.states[:, 0]), torch.tensor(run.disturbances))
    each = Stepper.at(own, torch.tensor(np.tile(P0, (4, 1))))
    totals = simulated(each, lambda z: -z @ torch.tensor(K).T, scenarios).total
    np.testing.assert_allclose(totals, run.returns(own.objective))


def test_the_environment_of_ppo_earns_the_same_but_for_the_price():
    own = problem(CustomObjective(stage, lambda x, p: p[1] * x[0] ** 2, design_cost=price), steps=5)
    env = EpisodeEnv(own, torch.tensor(P0, dtype=torch.float32), runs=3, rng=np.random.default_rng(4))
    x0, drawn = scenario_tensors(own, 3, np.random.default_rng(4))
    seen = env.reset()
    total = torch.zeros(3)
    for k in range(5):
        seen, _, reward, terminated, truncated = env.step(-seen[:, :2] @ torch.tensor(K, dtype=torch.float32).T)
        total = total + reward
        assert bool(terminated.all()) == (k == 4)  # the terminal cost stands for what comes after: no value does
        assert not truncated.any()
    run = simulate(MODEL, LinearFeedback(K), x0=x0.double(), steps=5, disturbance=drawn.double(), design=P0)
    np.testing.assert_allclose(total, run.returns(own.objective) + 6.25, rtol=1e-5)


class OfMoves(QuadraticObjective):
    def rewards(self, x_next, u, x=None, p=None):
        return -((x_next - x) ** 2).sum(-1) - p[..., 0] * (u**2).sum(-1)


def test_rewards_of_a_subclass_see_the_state_before_the_step_in_training_too():
    run = loop()
    cost = (np.diff(run.states, axis=1) ** 2).sum((1, 2)) + 2.0 * (run.inputs**2).sum((1, 2))
    np.testing.assert_allclose(run.returns(OfMoves(Q, R)), -cost)
    np.testing.assert_allclose(in_training(problem(OfMoves(Q, R)), run), -cost)


def test_a_run_that_is_lost_in_its_last_step_pays_for_no_end():
    objective = CustomObjective(lambda x, u, p: ca.sumsqr(x) + ca.sumsqr(u), lambda x, p: ca.sumsqr(x))
    states, nothing = np.array([[[3.0, 0.0], [0.0, 2.0], [1e9, 0.0]]] * 2), np.zeros((2, 2, 1))
    run = Trajectory(states, nothing, nothing, np.array([1, -1]), P0, 0.1)
    np.testing.assert_array_equal(run.returns(objective), [-13.0, -13.0 - 1e18])
    lost = simulate(MODEL, LinearFeedback(K), x0=[1.0, 0.0], steps=1, disturbance=[[1e6]], design=P0, limit=[4e3, 4e3])
    assert lost.diverged.all()
    np.testing.assert_allclose(in_training(problem(objective, steps=1), lost), lost.returns(objective))


@pytest.mark.check
@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e4])
def test_the_papers_design_gradient_weighs_the_price_as_the_steps_it_is_weighed_against(unit):
    """In any unit of the costs: its surrogate is one step's, in standard deviations of the advantages."""
    own = problem(QuadraticObjective(unit * Q, unit * R))
    priced = replace(own, objective=replace(own.objective, design_cost=lambda p: unit * 0.5 * p[0], episode=30))
    data = expert_dataset(own, samples=60, rng=np.random.default_rng(0), sets="lqr")
    agent = fit_actor_critic(
        data.inputs, data.actions, data.values, rng=np.random.default_rng(0), action_bounds=own.input_bounds,
        input_bounds=own.observation_bounds, config=CloningConfig(steps=300, batch=256),
    )  # fmt: skip
    env = EpisodeEnv(own, torch.tensor(P0, dtype=torch.float32), runs=32, rng=np.random.default_rng(1))
    rollout = collect(env, agent, steps=30, generator=torch.Generator().manual_seed(0))
    batch = prepare(agent, rollout, PPOConfig.warm())
    v = torch.tensor(SPACE.to_unit(P0), dtype=torch.float32)
    plain, paid = (loss_gradient(one, agent, v, batch, PPOConfig.warm()) for one in (own, priced))
    raw = batch.targets - agent.value(batch.observations).detach()
    np.testing.assert_allclose(paid - plain, [-unit * 0.5 * 4.0 / (30 * raw.std()), 0.0], rtol=1e-3, atol=1e-6)
    assert 1e-3 < -float(paid[0] - plain[0]) < 10
