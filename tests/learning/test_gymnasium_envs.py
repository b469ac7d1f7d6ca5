"""Environments of Gymnasium: their experience as they give it, training with defaults, and what is refused."""

import os
import time

import numpy as np
import pytest
import torch

from learning import ActorCritic, Collector, GymnasiumEnvs, train
from learning.exceptions import CheckpointError, InputError, SimulatorError

gymnasium = pytest.importorskip("gymnasium")


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def test_experience_is_that_of_the_environments_by_themselves():
    env = GymnasiumEnvs("Pendulum-v1", runs=2, seed=7)
    rollout = Collector(env, env.agent(), generator=generator()).rollout(210)
    low, high = env.envs[0].action_space.low, env.envs[0].action_space.high
    for i in range(2):
        alone = gymnasium.make("Pendulum-v1")
        observation, _ = alone.reset(seed=7 + i)
        for k in range(210):
            np.testing.assert_allclose(rollout.observations[k, i], observation, rtol=1e-6)
            action = np.clip(2.0 * rollout.latents[k, i].numpy(), low, high)
            observation, reward, over, cut, _ = alone.step(action)
            np.testing.assert_allclose(rollout.successors[k, i], observation, rtol=1e-6)
            assert rollout.rewards[k, i].item() == pytest.approx(reward, rel=1e-6)
            assert (rollout.terminated[k, i].item(), rollout.truncated[k, i].item()) == (over, cut)
            if cut:
                observation, _ = alone.reset()
        assert rollout.truncated[199, i]


def test_a_training_goes_on_in_a_fresh_process_with_the_same_numbers(tmp_path):
    def trained(iterations, seed, **options):
        env = GymnasiumEnvs("Pendulum-v1", runs=2, seed=seed)
        net = env.agent(seed=seed)
        return train(env, net, iterations=iterations, steps=64, generator=generator(seed), **options)

    whole = trained(3, 0)

    def stop(row):
        if row.iteration == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trained(3, 0, checkpoint=tmp_path / "a.pt", callback=stop)
    again = trained(3, 5, checkpoint=tmp_path / "a.pt")
    for name, tensor in whole.agent.state_dict().items():
        assert torch.equal(again.agent.state_dict()[name], tensor), name


def changed(**parts):
    """Return a function that makes a pendulum with other parts."""

    def make():
        env = gymnasium.make("Pendulum-v1")
        for name, value in parts.items():
            setattr(env, name, value(env) if callable(value) else value)
        return env

    return make


def stepping(change, *, after=0):
    """Return a `step` whose result is changed after so many steps of one environment."""

    def part(env):
        step, taken = env.step, iter(range(10**6))
        return lambda action: change(*step(action)) if next(taken) >= after else step(action)

    return part


def rewarded_by_chance(step):
    """Return a `step` whose rewards are chance."""

    def stepped(action):
        observation, _, *rest = step(action)
        return observation, float(next(DRAWS)[0]), *rest

    return stepped


def by_chance(reset):
    """Return a `reset` whose observations are chance."""

    def begun(**options):
        reset(**options)
        return next(DRAWS), {}

    return begun


def stepping_to(end):
    """Return a part of `changed`: a `step` whose episodes are over after `end()` steps in all."""

    def part(env):
        step = env.step

        def stepped(action):
            observation, reward, *_ = step(action)
            return observation, reward, end(), False, {}

        return stepped

    return part


class Sized:
    """Environment with n observations, which are always the same array."""

    def __init__(self, n):
        self.observation_space, self.action_space = box(-1.0, 1.0, (n,)), box(-1.0, 1.0, (1,))
        self.seen, self.unwrapped = np.zeros(n, np.float32), self

    def reset(self, *, seed=None):
        self.seen[:] = 0.0
        return self.seen, {}

    def step(self, action):
        self.seen += 0.01
        return self.seen, 1.0, False, bool(self.seen[0] > 0.095), {}


ENDS = iter([False, False, False, True, False, True])
DRAWS = iter(np.random.default_rng(0).random((9999, 3), np.float32))
SAME = gymnasium.make("Pendulum-v1")
SIZES = iter((3, 3, 5, 5))
box = gymnasium.spaces.Box
REFUSED = {
    "a name nobody knows": ("Nothing-v1", "a registered environment"),
    "no environment": (lambda: 3, "the name of an environment"),
    "discrete actions": ("CartPole-v1", "a box of shape"),
    "endless actions": (changed(action_space=box(-np.inf, np.inf, (1,))), "finite bounds of the actions"),
    "one environment again and again": (lambda: SAME, "a new one at every call"),
    "several spaces": (lambda: Sized(next(SIZES)), "the same spaces at every call"),
    "rewards by chance": (changed(step=lambda env: rewarded_by_chance(env.step)), "the same numbers"),
    "episodes that end by chance": (changed(step=stepping_to(lambda: next(ENDS))), "and an end, expected"),
    "whole numbers as actions": (changed(action_space=box(0, 5, (1,), np.int64)), "of float"),
    "rewards by chance late in an episode": (
        changed(step=stepping(lambda o, r, *rest: (o, float(next(DRAWS)[0]), *rest), after=350)),
        "151 steps after two",
    ),
    "observations by chance": (changed(reset=lambda env: by_chance(env.reset)), "the same numbers"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_no_policy_can_be_trained_in_is_refused(name):
    make, message = REFUSED[name]
    with pytest.raises(InputError, match=message) as caught:
        GymnasiumEnvs(make)
    assert caught.value.argument == "make"


@pytest.mark.check
def test_an_episode_without_an_end_is_tried_for_a_second_or_two():
    class Endless(Sized):
        taken = 0

        def step(self, action):
            self.taken += 1
            self.seen[:] = self.taken % 2
            return self.seen, 1.0, False, False, {}

        def reset(self, *, seed=None):
            self.taken -= self.taken % 2  # what went before does not matter
            self.seen[:] = 0.0
            return self.seen, {}

    start = time.monotonic()
    env = GymnasiumEnvs(lambda: Endless(3), runs=1)
    assert time.monotonic() - start < 10
    assert env.envs[0].taken > 100


FAILING = {
    "a list of rewards": (lambda o, r, *rest: (o, [r], *rest), "a finite number as reward"),
    "a reward that is no number": (lambda o, r, *rest: (o, float("nan"), *rest), "a finite number as reward"),
    "another shape": (lambda o, *rest: (o[:2], *rest), "shape"),
    "another type": (lambda o, *rest: (o.astype(np.float64), *rest), "float64"),
    "four values, as before Gymnasium": (lambda o, r, over, cut, _: (o, r, over, {}), "five values"),
    "an observation that is no number": (lambda o, *rest: (o * np.nan, *rest), "finite ones"),
}


@pytest.mark.parametrize("name", FAILING)
def test_an_environment_that_breaks_its_word_is_named(name):
    change, message = FAILING[name]
    env = GymnasiumEnvs(changed(step=stepping(change, after=410)))
    with pytest.raises(SimulatorError, match=message) as caught:
        Collector(env, env.agent(), generator=generator()).rollout(40)
    assert caught.value.argument == "env"
    assert "from environment 0" in caught.value.got
    assert caught.value.step == 10  # two episodes of the first environment were tried before


def test_a_reward_beyond_single_precision_is_refused():
    env = GymnasiumEnvs(changed(step=stepping(lambda o, r, *rest: (o, 1e39, *rest), after=410)))
    with pytest.raises(InputError, match=r"env: got the rewards .* at step 10 of a rollout, .* single precision"):
        Collector(env, env.agent(), generator=generator()).rollout(40)


def test_an_environment_that_dies_in_a_training_is_named_with_its_step():
    def dying(env):
        step, taken = env.step, iter(range(40 if next(made) == 2 else 10**6))

        def stepped(action):
            if next(taken, None) is None:
                raise RuntimeError("licence lost")
            return step(action)

        return stepped

    made = iter(range(3))
    env = GymnasiumEnvs(changed(step=dying), runs=3)
    with pytest.raises(SimulatorError, match=r"RuntimeError: licence lost from environment 2, .* at step 40"):
        train(env, env.agent(), iterations=9, steps=16, generator=generator())


@pytest.mark.check
@pytest.mark.parametrize(("end", "fault"), [("while True: pass", "does not come back"),
                                            ("os._exit(3)", "ends its process by code 3")])  # fmt: skip
def test_an_environment_that_hangs_or_takes_its_process_with_it_is_named(tmp_path, end, fault):
    def ending(env):
        step, taken = env.step, iter(range(410))

        def stepped(action):
            if next(taken, None) is None:
                exec(end, {"os": os})
            return step(action)

        return stepped

    env = GymnasiumEnvs(changed(step=ending), runs=1, step_limit=5.0)
    with pytest.raises(SimulatorError, match=f"{fault} .*from environment 0, .* within 5 s.* at step 10"):
        train(env, env.agent(), iterations=9, steps=16, generator=generator())


@pytest.mark.check
def test_an_environment_in_a_process_of_its_own_is_the_same_and_is_kept(tmp_path):
    def trained(iterations, **options):
        env = GymnasiumEnvs("Pendulum-v1", runs=1, **options)
        return train(
            env, env.agent(), iterations=iterations, steps=16, generator=generator(), checkpoint=tmp_path / "a"
        )

    trained(1, step_limit=20.0)
    apart = trained(2, step_limit=20.0)
    (tmp_path / "a").unlink()
    for own, here in zip(apart.agent.parameters(), trained(2).agent.parameters()):
        assert torch.equal(own, here)


def test_an_agent_of_other_actions_is_refused():
    env = GymnasiumEnvs(lambda: Sized(3), runs=2)
    with pytest.raises(InputError, match=r"actions: got shape \(2, 2\), expected \(2, 1\)"):
        Collector(env, ActorCritic([-1] * 3, [1] * 3, [-1] * 2, [1] * 2), generator=generator()).rollout(1)


def test_an_environment_may_use_its_own_array_again():
    env = GymnasiumEnvs(lambda: Sized(3), runs=2)
    rollout = Collector(env, env.agent(), generator=generator()).rollout(20)
    np.testing.assert_allclose(rollout.successors[9, :, 0], 0.1, rtol=1e-5)
    np.testing.assert_allclose(rollout.observations[10], 0.0)


def test_what_pickle_cannot_keep_is_refused_before_the_first_step(tmp_path):
    env = GymnasiumEnvs(changed(step=stepping(lambda *result: result)))
    with pytest.raises(InputError, match="environments that pickle can keep"):
        train(env, env.agent(), iterations=1, steps=2, generator=generator(), checkpoint=tmp_path / "a.pt",
              callback=lambda row: pytest.fail("trained"))  # fmt: skip


def test_a_checkpoint_of_other_environments_is_refused(tmp_path):
    def trained(runs, **options):
        env = GymnasiumEnvs("Pendulum-v1", runs=runs)
        return train(env, env.agent(), steps=8, generator=generator(), checkpoint=tmp_path / "a.pt", **options)

    trained(2, iterations=1)
    with pytest.raises(CheckpointError, match="2 environments"):
        trained(3, iterations=2)


def test_a_checkpoint_does_not_go_on_with_another_plant(tmp_path):
    def trained(gravity, iterations):
        env = GymnasiumEnvs(lambda: gymnasium.make("Pendulum-v1", g=gravity), runs=2)
        return train(env, env.agent(), iterations=iterations, steps=8, generator=generator(), checkpoint=tmp_path / "a")

    trained(10.0, 1)
    assert len(trained(10.0, 2).rows) == 2
    with pytest.raises(CheckpointError, match="reward and observation 1 steps after a first reset"):
        trained(3.0, 3)
