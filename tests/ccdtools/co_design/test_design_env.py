"""A co-design problem as an environment of Gymnasium: its returns are those of the closed loop."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

from ccdtools import (
    FixedStart,
    Gaussian,
    InputError,
    Measurement,
    Scenario,
    closed_loop_returns,
    compare,
    saturated_lqr,
)
from ccdtools.co_design import DesignEnv, DesignVectorEnv, EpisodeEnv
from ccdtools.disturbances import Cases
from learning import GymnasiumEnvs

pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics


@pytest.fixture
def problem(illustrative):
    """Return the illustrative problem without a disturbance, from one start."""
    return replace(illustrative.problem(), scenarios=FixedStart([-1.0, 1.5], Gaussian([0.0, 0.0])))


def episode(env, policy, **options):
    _, info = env.reset(seed=3, **options)
    total = 0.0
    for k in range(10**6):
        _, reward, terminated, truncated, info = env.step(policy(info["state"], info["design"]))
        total += reward
        if terminated or truncated:
            return total, k + 1, terminated
    return None


def test_episodes_end_where_the_problem_says_if_that_is_nearer(problem):
    ends = [DesignEnv(replace(problem, divergence=far), problem.design.centre) for far in (1.1, 1000.0)]
    lengths = [episode(env, lambda state, design: [1.0])[1] for env in ends]
    assert lengths[0] < lengths[1] < problem.steps


@pytest.mark.parametrize("drawn", [True, False])
def test_the_checker_of_gymnasium_has_nothing_to_say(illustrative, suspension, drawn):
    for study in (illustrative, suspension):
        problem = study.problem()
        env = DesignEnv(problem, None if drawn else problem.design.centre)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env(env)
            check_env(DesignEnv(problem, env.design if not drawn else None, output=np.eye(problem.model.nx), history=2))
        assert env.spec.make().observation_space == env.observation_space


@pytest.mark.parametrize("drawn", [True, False])
def test_the_checker_of_stable_baselines3_has_nothing_to_say(illustrative, suspension, drawn):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    for study in (illustrative, suspension):
        problem = study.problem()
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            checker.check_env(DesignEnv(problem, None if drawn else problem.design.centre))


@pytest.mark.long
def test_an_agent_of_stable_baselines3_is_compared_in_three_lines(suspension):
    PPO = pytest.importorskip("stable_baselines3").PPO
    problem = replace(suspension.problem(), scenarios=FixedStart([0.01, 0.1, 0.01, 0.1], Gaussian([0.0])))
    design = problem.design.centre
    x0, w = problem.scenarios.sample(4, problem.steps, np.random.default_rng(0))
    laws = {"LQR": saturated_lqr(problem, design)}

    env = DesignEnv(problem, design)
    model = PPO("MlpPolicy", env, n_steps=128, seed=0, device="cpu").learn(256)
    laws["PPO"] = env.controller(lambda seen: model.predict(seen, deterministic=True))

    found = compare(laws, Scenario(problem.model, x0, w), objective=problem.objective, X=problem.X, design=design)

    def policy(x, p):
        return model.predict(np.float32(x / problem.state_scale), deterministic=True)[0]

    total, steps, _ = episode(env, policy)
    assert steps == problem.steps
    assert found["PPO"].summary.mean == pytest.approx(total - problem.cost_of_design(design), rel=1e-4)
    assert found["PPO"].summary.mean < found["LQR"].summary.mean  # after 256 steps


def test_an_episode_has_the_return_of_the_closed_loop(problem):
    design = problem.design.from_unit([0.3])
    law = saturated_lqr(problem, design)
    lower, upper = problem.input_bounds

    def policy(x, p):
        return (2 * law(x[None])[0] - upper - lower) / (upper - lower)

    total, steps, terminated = episode(DesignEnv(problem, design), policy)
    expected = closed_loop_returns(problem, law, design, rng=np.random.default_rng(0)).values[0]
    assert total == pytest.approx(expected + problem.cost_of_design(design), rel=1e-5)
    assert (steps, terminated) == (problem.steps, False)


def test_every_reset_draws_a_design_that_is_seen_and_one_can_be_given(problem):
    env = DesignEnv(problem)
    seen = []
    for seed in range(20):
        observation, info = env.reset(seed=seed)
        assert problem.design.feasible(info["design"])
        np.testing.assert_allclose(observation[:2], info["state"] / problem.state_scale, rtol=1e-6)
        np.testing.assert_allclose(observation[2:], 2 * problem.design.to_unit(info["design"]) - 1, atol=1e-6)
        seen.append(observation[2])
    assert np.ptp(seen) > 1.0
    given = problem.design.from_unit([0.25])
    observation, info = env.reset(options={"design": given})
    np.testing.assert_allclose(info["design"], given)
    assert observation[2] == pytest.approx(-0.5)


@pytest.mark.parametrize("drawn", [True, False])
@pytest.mark.parametrize("pair", [True, False])
def test_an_agent_is_a_controller_that_does_as_in_its_environment(problem, drawn, pair):
    design = problem.design.from_unit([0.3])
    env = DesignEnv(problem, None if drawn else design)

    def agent(seen):
        actions = np.tanh(seen[..., :2] @ [-6.0, -3.0])[..., None]
        return (actions, None) if pair else actions

    observation, _ = env.reset(seed=0, options={"design": design})
    total, ended = 0.0, False
    while not ended:
        action = agent(observation[None])
        observation, reward, *flags, _ = env.step((action[0] if pair else action)[0])
        total, ended = total + reward, any(flags)
    returns = closed_loop_returns(problem, env.controller(agent, design), design, rng=np.random.default_rng(0))
    assert total == pytest.approx(returns.values[0] + problem.cost_of_design(design), rel=1e-5)


def test_an_agent_does_not_see_hidden_states(problem):
    design, hidden = problem.design.centre, replace(problem, hidden=1)
    env = DesignEnv(hidden, design)

    def agent(seen):
        return np.tanh(-3.0 * seen)

    observation, info = env.reset(seed=0)
    assert env.observation_space.shape == observation.shape == (1,)
    assert observation[0] == np.float32(info["state"][1] / problem.state_scale[1])
    lower, upper = problem.input_bounds
    inputs = lower + (upper - lower) / 2 * (1 + agent(observation))
    np.testing.assert_allclose(env.controller(agent)(info["state"]), inputs, rtol=1e-6)


def test_noise_of_other_channels_than_outputs_is_refused(problem):
    def first(x):
        return x[:, :1]

    for kind, options in ((DesignEnv, {}), (EpisodeEnv, {"design": [1.0], "rng": np.random.default_rng(0)})):
        env = kind(problem, output=Measurement(first, noise=[0.1, 0.1]), history=2, **options)
        with pytest.raises(InputError, match=r"output\.noise: got 2 channels, expected 1, one per output"):
            env.reset()


NOISE = 0.05 * np.random.default_rng(7).standard_normal((400, 1))  # the same in every run


def weighed(seen):
    """Action of four outputs and the inputs before them."""
    return np.tanh(seen[..., :8] @ [-6.0, 2.0, 1.0, 0.5, 0.8, -0.3, 0.2, 0.1])[..., None]


@pytest.mark.parametrize("drawn", [True, False])
def test_an_agent_sees_what_is_measured_as_in_the_closed_loop(problem, drawn):
    design, sensor = problem.design.from_unit([0.3]), Measurement([[1.0, 0.3]], noise=NOISE[: problem.steps])
    env = DesignEnv(problem, None if drawn else design, output=sensor, history=4)
    observation, _ = env.reset(seed=0, options={"design": design})
    total, ended = 0.0, False
    while not ended:
        assert env.observation_space.contains(observation)
        observation, reward, *flags, _ = env.step(weighed(observation))
        total, ended = total + reward, any(flags)
    x0, w = problem.scenarios.sample(3, problem.steps, np.random.default_rng(0))
    run = Scenario(problem.model, x0, w, output=sensor).run(env.controller(weighed, design), design=design)
    np.testing.assert_allclose(run.returns(problem.objective), total - problem.cost_of_design(design), rtol=1e-4)


def test_recorded_noise_needs_a_sample_for_each_step(problem):
    env = DesignEnv(problem, output=Measurement([[1.0, 0.3]], noise=NOISE[: problem.steps - 1]), history=4)
    with pytest.raises(InputError, match=r"output.noise: got shape \(1, 99, 1\), expected \(1, 100, ny\)"):
        env.reset(seed=0)


def test_noise_is_of_every_episode_and_of_its_seed(problem):
    env = DesignEnv(replace(problem, measurement=Measurement([[1.0, 0.0]], noise=[0.1])), history=1)
    first, again, other = (env.reset(seed=seed)[0][0] for seed in (0, 0, 1))
    assert first == again != other
    rows = DesignVectorEnv(env.problem, 3, history=1).reset(seed=0)[0]
    np.testing.assert_allclose(rows[:2, 0], [first, other])


def test_every_case_of_the_scenarios_is_met(problem):
    winds = [Gaussian([0.0, 0.0], mean=[0.0, mean]) for mean in (-0.1, 0.0, 0.1)]
    env = DesignEnv(replace(problem, scenarios=FixedStart([0.0, 0.0], Cases(winds))), problem.design.centre)
    met = set()
    for seed in range(30):
        env.reset(seed=seed)
        _, _, _, _, info = env.step(np.zeros(1))
        met.add(round(float(info["state"][1]), 6))
    assert len(met) == 3


def test_states_that_run_away_end_the_episode(problem):
    problem = replace(problem, divergence=1.5)
    _, steps, terminated = episode(DesignEnv(problem, problem.design.centre), lambda x, p: np.sign(x[:1]))
    assert terminated
    assert steps < problem.steps


def test_wrong_calls_name_their_argument(problem):
    with pytest.raises(InputError, match="problem: got 3"):
        DesignEnv(3)
    with pytest.raises(InputError, match="design"):
        DesignEnv(problem, problem.design.upper + 1)
    with pytest.raises(InputError, match="policy: got 3"):
        DesignEnv(problem).controller(3)
    with pytest.raises(InputError, match="design: got none"):
        DesignEnv(problem).controller(len)
    with pytest.raises(InputError, match="options: got"):
        DesignEnv(problem).reset(options={"speed": 1})
    for options in ({"history": 2}, {"output": np.eye(2)}):
        with pytest.raises(InputError, match="output, history"):
            DesignEnv(problem, **options)
    with pytest.raises(InputError, match="history: got 0, expected at least 1, of a problem with a measurement"):
        DesignEnv(replace(problem, measurement=Measurement(np.eye(2), noise=[0.1, 0.1])))
    env = DesignEnv(problem)
    with pytest.raises(InputError, match="step: got no episode"):
        env.step([0.0])
    env.reset()
    for action in ([np.nan], [0.0, 0.0], [[0.0]], 0.0):
        with pytest.raises(InputError, match="action"):
            env.step(action)
    while not any(env.step([0.0])[2:4]):
        pass
    with pytest.raises(InputError, match="step: got no episode"):
        env.step([0.0])


def test_a_fixed_design_stays_where_none_is_given(problem):
    env = DesignEnv(problem, problem.design.centre)
    _, info = env.reset(options={"design": None})
    np.testing.assert_allclose(info["design"], problem.design.centre)


def test_an_agent_of_the_library_is_a_controller(problem):
    env = DesignEnv(problem, problem.design.centre)
    agent = GymnasiumEnvs(lambda: DesignEnv(problem, problem.design.centre), runs=2).agent(seed=1)
    observation, info = env.reset(seed=0)
    action = agent(torch.as_tensor(observation)[None]).detach().numpy()
    lower, upper = problem.input_bounds
    expected = (lower + upper) / 2 + action[0] * (upper - lower) / 2
    np.testing.assert_allclose(env.controller(agent)(info["state"][None])[0], expected, rtol=1e-5)


def vectors(problem, design=None, runs=5):
    """Return environments that step together, and as many that step in turn."""
    return DesignVectorEnv(problem, runs, design), SyncVectorEnv([lambda: DesignEnv(problem, design)] * runs)


@pytest.mark.long
@pytest.mark.parametrize("drawn", [True, False])
@pytest.mark.parametrize("divergence", [1000.0, 1.5])
def test_environments_that_step_together_are_those_that_step_in_turn(illustrative, drawn, divergence):
    problem = replace(illustrative.problem(), steps=30, divergence=divergence)
    together, in_turn = vectors(problem, None if drawn else problem.design.centre)
    assert together.observation_space == in_turn.observation_space
    assert together.action_space == in_turn.action_space
    assert together.metadata["autoreset_mode"] == in_turn.metadata["autoreset_mode"]
    given = [env.reset(seed=7) for env in (together, in_turn)]
    ends = 0
    rng = np.random.default_rng(0)
    for _ in range(100):
        for (seen, infos), (expected, told) in [given]:
            np.testing.assert_allclose(seen, expected, rtol=1e-4, atol=1e-5)
            np.testing.assert_allclose(infos["design"], np.stack(told["design"]))
        actions = rng.uniform(-1, 1, (5, 1)).astype(np.float32)
        one, other = (env.step(actions) for env in (together, in_turn))
        for found, expected in zip(one[1:4], other[1:4]):
            np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
        ends += one[2].sum() + one[3].sum()
        given = [one[::4], other[::4]]
    assert ends >= 15


def test_each_of_many_environments_may_have_a_design(problem):
    env = DesignVectorEnv(problem, 3)
    designs = problem.design.from_unit([[0.1], [0.5], [0.9]])
    seen, infos = env.reset(seed=0, options={"design": designs})
    np.testing.assert_array_equal(infos["design"], designs)
    np.testing.assert_allclose(seen[:, 2], [-0.8, 0.0, 0.8], atol=1e-6)
    _, infos = env.reset(options={"design": designs[1]})
    np.testing.assert_array_equal(infos["design"], np.tile(designs[1], (3, 1)))
    law = saturated_lqr(problem, designs[1])
    total = np.zeros(3)
    lower, upper = problem.input_bounds
    for _ in range(problem.steps):
        actions = (2 * law(infos["state"]) - upper - lower) / (upper - lower)
        _, rewards, _, _, infos = env.step(actions)
        total += rewards
    expected = closed_loop_returns(problem, law, designs[1], rng=np.random.default_rng(0)).values[0]
    np.testing.assert_allclose(total, expected + problem.cost_of_design(designs[1]), rtol=1e-5)


def test_many_environments_take_the_wrappers_of_gymnasium(problem):
    env = RecordEpisodeStatistics(DesignVectorEnv(replace(problem, steps=10), 4))
    env.reset(seed=0)
    for _ in range(10):
        *_, infos = env.step(np.zeros((4, 1), np.float32))
    assert (infos["episode"]["l"] == 10).all()


def test_wrong_calls_of_many_environments_name_their_argument(problem):
    env = DesignVectorEnv(problem, 3)
    with pytest.raises(InputError, match="step: got no episodes"):
        env.step(np.zeros((3, 1)))
    for wrong, name in (({"seed": [1, 2]}, "seed: got 2 seeds"), ({"seed": -1}, "seed: got -1"),
                        ({"seed": "1"}, "seed: got '1'"), ({"seed": [1, 2, 0.5]}, "seed: got 0.5"),
                        ({"options": {"speed": 1}}, "options: got"),
                        ({"options": {"design": [1.0, 2.0]}}, "design: got shape")):  # fmt: skip
        with pytest.raises(InputError, match=name):
            env.reset(**wrong)
    env.reset(seed=0)
    for actions in (np.zeros(3), np.zeros((2, 1)), np.full((3, 1), np.nan)):
        with pytest.raises(InputError, match="actions"):
            env.step(actions)
    with pytest.raises(InputError, match="num_envs: got 0"):
        DesignVectorEnv(problem, 0)


def test_a_design_that_is_refused_leaves_all_environments_as_they_were(problem):
    env = DesignVectorEnv(problem, 3)
    space = problem.design
    designs = np.stack([space.lower, space.centre, space.upper])
    env.reset(seed=0, options={"design": designs[::-1]})
    with pytest.raises(InputError, match="design"):
        env.reset(options={"design": np.stack([space.lower, space.lower, 9 * space.upper])})
    *_, infos = env.step(np.zeros((3, 1)))
    np.testing.assert_array_equal(infos["design"], designs[::-1])


def test_a_fixed_design_is_known_before_the_first_reset(problem):
    np.testing.assert_array_equal(DesignEnv(problem, problem.design.centre).design, problem.design.centre)
