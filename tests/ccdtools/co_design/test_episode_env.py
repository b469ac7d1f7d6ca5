"""Episodes of a problem that step together: PPO learns from scratch in them."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch

from ccdtools import (
    CoDesignProblem,
    CustomObjective,
    DesignSpace,
    Gaussian,
    InputError,
    LearnedPolicy,
    Measurement,
    Plant,
    QuadraticObjective,
    RandomStarts,
    closed_loop_returns,
    discretise,
    simulate,
)  # fmt: skip
from ccdtools.co_design import EpisodeEnv
from ccdtools.controllers import History
from ccdtools.disturbances import Uniform
from ccdtools.plants import from_gymnasium
from learning import CheckpointError, train


@pytest.mark.long
def test_an_agent_from_scratch_learns_a_problem_and_is_its_policy(suspension):
    problem = suspension.problem()
    design = problem.design.centre
    env = EpisodeEnv(problem, design, runs=8, rng=np.random.default_rng(0))
    agent = env.agent(seed=1)
    before = LearnedPolicy(agent, design)
    trained = train(env, agent, iterations=12, steps=problem.steps, generator=torch.Generator().manual_seed(0))
    returns = [
        closed_loop_returns(problem, law, design, rng=np.random.default_rng(1), runs=64).values.mean()
        for law in (before, LearnedPolicy(trained.agent, design))
    ]
    assert returns[1] > returns[0] + 3
    assert LearnedPolicy(trained.agent, problem.design.lower).nx == 4  # the scale of the design is still its box


def test_a_return_is_that_of_the_closed_loop(suspension):
    problem = suspension.problem()
    design = problem.design.centre
    env = EpisodeEnv(problem, design, runs=4, rng=np.random.default_rng(3))
    law = LearnedPolicy(env.agent(seed=2), design)
    observation, total = env.reset(), torch.zeros(4)
    for _ in range(problem.steps):
        u = torch.as_tensor(law(observation[:, : law.nx].double().numpy()), dtype=torch.float32)
        observation, _, reward, *_ = env.step(u)
        total += reward
    expected = closed_loop_returns(problem, law, design, rng=np.random.default_rng(3), runs=4)
    paid = problem.cost_of_design(design)
    np.testing.assert_allclose(total, expected.values + paid, rtol=1e-4)


@pytest.mark.parametrize("noise", [None, "drawn"])
def test_a_policy_of_measured_outputs_returns_what_it_does_in_a_closed_loop(suspension, noise):
    problem = suspension.problem()
    design = problem.design.centre
    x0, w = problem.scenarios.sample(3, problem.steps, np.random.default_rng(4))
    drawn = None if noise is None else 0.01 * np.random.default_rng(5).standard_normal((3, problem.steps, 2))
    sensor = Measurement(np.eye(4)[::2], noise=drawn)
    env = EpisodeEnv(problem, design, runs=3, rng=np.random.default_rng(4), output=sensor, history=5)
    law = LearnedPolicy(env.agent(seed=2), design)
    observation, total = env.reset(), torch.zeros(3)
    assert observation.shape == (3, 5 * (2 + 1) + 2)
    for _ in range(problem.steps):
        u = torch.as_tensor(law(observation[:, : law.nx].double().numpy()), dtype=torch.float32)
        observation, _, reward, *_ = env.step(u)
        total += reward
    run = simulate(
        problem.model, History(law, 5), x0=x0, steps=problem.steps, disturbance=w, design=design, output=sensor
    )
    np.testing.assert_allclose(total, run.returns(problem.objective), rtol=1e-4)


def test_what_was_measured_goes_on_from_a_state_and_is_forgotten_where_a_run_begins_anew():
    x, u, w, p = (ca.SX.sym(name) for name in "xuwp")
    plant = Plant(x, u, w, p, 1.3 * p * x + u + w, DesignSpace(["p"], [0.9], [1.1]), dt=1.0, continuous=False)
    problem = CoDesignProblem(discretise(plant), X=(-4, 4), U=(-1, 1), objective=QuadraticObjective([[1.0]], [[1.0]]),
                              scenarios=RandomStarts(Uniform([-0.3], [3.0]), Gaussian([0.1])), steps=30)  # fmt: skip
    env = EpisodeEnv(problem, [1.0], runs=16, rng=np.random.default_rng(0), output=Measurement([[1.0]], noise=[0.1]),
                     history=3)  # fmt: skip
    env.reset()
    seen, lost = [], 0
    for k in range(40):
        if k == 12:
            kept = env.state()
        action = torch.full((16, 1), 0.1 * k)
        observation, _, _, terminated, _ = env.step(action)
        lost += int(terminated.sum())
        assert (observation[terminated][:, 1:6] == 0).all()  # one output, and nothing before it
        seen.append(observation)
    assert lost
    env.restore(kept)
    for k in range(12, 40):
        torch.testing.assert_close(env.step(torch.full((16, 1), 0.1 * k))[0], seen[k], rtol=0, atol=0)


def test_a_checkpoint_of_other_runs_or_another_design_is_refused(illustrative, tmp_path):
    problem = illustrative.problem()

    def trained(iterations, design=1.0, runs=4, divergence=None):
        env = EpisodeEnv(problem, [design], runs=runs, rng=np.random.default_rng(0), divergence=divergence)
        options = {"steps": 5, "generator": torch.Generator(), "checkpoint": tmp_path / "a.pt"}
        return train(env, env.agent(), iterations=iterations, **options)

    trained(1)
    for change in ({"design": 1.5}, {"runs": 3}, {"divergence": 2.0}):
        with pytest.raises(CheckpointError, match="4 runs at the design"):
            trained(2, **change)
    assert len(trained(2).rows) == 2


def pole(x0, push=0.2):
    """Pole that falls within a second unless it is held."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    design = DesignSpace(["g"], [0.5], [1.5])
    plant = Plant(x, u, w, p, ca.vertcat(x[1], 4 * x[0] + p * (u + w)), design, dt=0.05)
    return CoDesignProblem(
        discretise(plant), X=([-1, -2], [1, 2]), U=(-2, 2), steps=200,
        scenarios=RandomStarts(x0, Gaussian([push])), objective=QuadraticObjective(Q=np.diag([1.0, 0.1]), R=[[0.1]]),
    )  # fmt: skip


def test_an_episode_that_diverges_costs_what_staying_there_would():
    problem = pole([[0.9, 1.9], [0.0, 0.0]], push=0.0)
    env = EpisodeEnv(problem, [1.0], runs=2, rng=np.random.default_rng(0))
    starts = env.reset()
    for _ in range(100):
        observation, successor, reward, terminated, _ = env.step(torch.full((2, 1), 2.0))
        if terminated.any():
            break
    row = int(terminated.nonzero()[0, 0])
    last = successor[row, :2].numpy()
    assert (np.abs(last) > [1.5, 3.0]).any()
    assert (np.abs(last) < [2.0, 4.0]).all()
    assert observation[row].tolist() in starts.tolist()
    cost = last @ problem.objective.Q @ last + 0.1 * 2.0**2
    assert -float(reward[row]) == pytest.approx(100 * cost)


@pytest.mark.long
def test_an_agent_does_not_learn_to_leave_what_costs_little():
    """Leaving takes two samples, while the other state costs as much in each sample, whatever is done."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    plant = Plant(x, u, w, p, [x[0] + p * u + w, x[1]], DesignSpace(["g"], [0.5], [1.5]), dt=1.0, continuous=False)
    problem = CoDesignProblem(
        discretise(plant), X=([-1, -1], [1, 1]), U=(-1, 1), steps=100,
        scenarios=RandomStarts([[0.0, 0.9]], Gaussian([0.01])),
        objective=QuadraticObjective(Q=np.diag([1e-3, 1.0]), R=[[1e-3]]),
    )  # fmt: skip
    env = EpisodeEnv(problem, [1.0], runs=16, rng=np.random.default_rng(0))
    trained = train(env, env.agent(), iterations=15, steps=64, generator=torch.Generator().manual_seed(0))
    assert trained.rows[-1].length > 0.8 * trained.rows[0].length


@pytest.mark.check
@pytest.mark.parametrize("seed", [0, 1])
def test_a_pole_is_held_by_what_was_learned_from_nothing(seed):
    problem = pole(Uniform([-0.1, -0.1], [0.1, 0.1]))
    env = EpisodeEnv(problem, [1.0], runs=16, rng=np.random.default_rng(seed))
    trained = train(env, env.agent(seed=seed), iterations=150, steps=64, generator=torch.Generator().manual_seed(seed))
    returns = closed_loop_returns(problem, LearnedPolicy(trained.best, [1.0]), [1.0], np.random.default_rng(9), runs=64)
    assert not returns.lost.any()
    assert returns.summary.mean > -2  # LQR: −0.35
    assert trained.rows[0].terminated == 1.0
    assert trained.rows[-1].terminated < 0.1
    assert trained.rows[0].length < trained.rows[-1].length


def test_a_training_says_how_many_of_its_episodes_were_lost():
    env = EpisodeEnv(pole([[0.5, 1.0]]), [1.0], runs=16, rng=np.random.default_rng(0))
    trained = train(env, env.agent(), iterations=2, steps=64, generator=torch.Generator().manual_seed(0))
    assert trained.rows[-1].terminated == 1.0
    assert "; 100% of the last were terminated, their mean length is " in trained.describe()


def at_first(x, u, p):
    """A cost that is that of the regulator until a state is large."""
    return x[0] ** 2 + x[1] ** 2 + u[0] ** 2 + ca.fmax(0, x[0] ** 2 - 1e4)


@pytest.mark.parametrize("change", [
    {"steps": 7}, {"objective": QuadraticObjective(np.eye(2), [[7.0]])}, {"U": (-0.5, 0.5)},
    {"X": ([-9.0, -9.0], [9.0, 9.0])}, {"scenarios": RandomStarts([[1.0, 0.0]], Gaussian([0.3, 0.0]))},
    {"objective": CustomObjective(at_first)}, {"model": 0.9},
])  # fmt: skip
def test_a_training_does_not_go_on_in_another_problem(illustrative, change):
    problem = replace(
        illustrative.problem(), objective=CustomObjective(lambda x, u, p: x[0] ** 2 + x[1] ** 2 + u[0] ** 2),
        scenarios=RandomStarts([[1.0, 0.0]], Gaussian([0.1, 0.0])),
    )  # fmt: skip
    if "model" in change:
        x, u, w, p = (ca.SX.sym(name, size) for name, size in zip("xuwp", (2, 1, 2, 1)))
        dynamics = ca.vertcat(x[0] + x[1], x[1] + change["model"] * p * u) + 0.1 * w
        plant = Plant(x, u, w, p, dynamics, problem.design, dt=problem.model.dt, continuous=False)
        change = {"model": discretise(plant)}
    kept, again, other = (
        EpisodeEnv(one, [1.0], runs=4, rng=np.random.default_rng(0))
        for one in (problem, replace(problem), replace(problem, **change))
    )
    kept.reset()
    again.restore(kept.state())
    with pytest.raises(InputError, match="state: got 4 runs at the design"):
        other.restore(kept.state())


def test_a_training_does_not_go_on_with_other_noise(illustrative):
    problem = illustrative.problem()
    envs = [
        EpisodeEnv(problem, [1.0], runs=4, rng=np.random.default_rng(0), output=Measurement(np.eye(2), [std, std]),
                   history=3) for std in (0.1, 0.1, 0.2)
    ]  # fmt: skip
    envs[0].reset()
    envs[1].restore(envs[0].state())
    with pytest.raises(InputError, match="state: got 4 runs at the design"):
        envs[2].restore(envs[0].state())


def test_a_training_goes_on_in_a_simulator_that_was_used_and_not_in_a_changed_one():
    gymnasium = pytest.importorskip("gymnasium")
    inner = gymnasium.make("Pendulum-v1").unwrapped
    problem = CoDesignProblem(
        from_gymnasium(inner), X=([-4, -8], [4, 8]), U=(-2, 2), steps=20, scenarios=RandomStarts([[0.1, 0.0]]),
        objective=QuadraticObjective(np.eye(2), [[1.0]]),
    )  # fmt: skip

    def env(problem=problem):
        return EpisodeEnv(problem, [], runs=4, rng=np.random.default_rng(0))

    first = env()
    first.reset()
    kept = first.state()
    first.step(torch.ones(4, 1))
    env().restore(kept)
    env(replace(problem, model=from_gymnasium(inner))).restore(kept)
    inner.m = 2.0
    with pytest.raises(InputError, match="state: got 4 runs"):
        env(replace(problem, model=from_gymnasium(inner))).restore(kept)


def test_wrong_calls_name_their_argument(illustrative):
    problem = illustrative.problem()
    rng = np.random.default_rng(0)
    for call, argument in (
        (lambda: EpisodeEnv(3, [1.0], rng=rng), "problem"),
        (lambda: EpisodeEnv(problem, [9.0], rng=rng), "design"),
        (lambda: EpisodeEnv(problem, [1.0], runs=0, rng=rng), "runs"),
        (lambda: EpisodeEnv(problem, [1.0], rng=3), "rng"),
        (lambda: EpisodeEnv(problem, [1.0], rng=rng, divergence=0.0), "divergence"),
        (lambda: EpisodeEnv(problem, [1.0], rng=rng, history=3), "output, history"),
        (lambda: EpisodeEnv(problem, [1.0], rng=rng, output=np.eye(2)), "output, history"),
    ):
        with pytest.raises(InputError) as caught:
            call()
        assert caught.value.argument == argument
