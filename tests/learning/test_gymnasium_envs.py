"""Environments of Gymnasium: their experience as they give it, training with defaults, and what is refused."""

import numpy as np
import pytest
import torch

from learning import Collector, GymnasiumEnvs, train
from learning.exceptions import InputError

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


def stepping(change):
    """Return a `step` whose result is changed."""

    def part(env):
        step = env.step
        return lambda action: change(*step(action))

    return part


DRAWS = iter(np.random.default_rng(0).random((9, 3)))
box = gymnasium.spaces.Box
REFUSED = {
    "a name nobody knows": ("Nothing-v1", "a registered environment"),
    "no environment": (lambda: 3, "the name of an environment"),
    "discrete actions": ("CartPole-v1", "a box of shape"),
    "endless actions": (changed(action_space=box(-np.inf, np.inf, (1,))), "finite bounds of the actions"),
    "observations by chance": (changed(reset=lambda env: lambda **_: (next(DRAWS), {})), "the same observation"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_no_policy_can_be_trained_in_is_refused(name):
    make, message = REFUSED[name]
    with pytest.raises(InputError, match=message) as caught:
        GymnasiumEnvs(make)
    assert caught.value.argument == "make"


FAILING = {
    "a reward that is no number": (lambda o, r, *rest: (o, float("nan"), *rest), "finite rewards"),
    "another shape": (lambda o, *rest: (o[:2], *rest), "shape"),
    "another type": (lambda o, *rest: (o.astype(np.float64), *rest), "float64"),
    "an observation that is no number": (lambda o, *rest: (o * np.nan, *rest), "finite ones"),
}


@pytest.mark.parametrize("name", FAILING)
def test_an_environment_that_breaks_its_word_is_named(name):
    change, message = FAILING[name]
    env = GymnasiumEnvs(changed(step=stepping(change)))
    with pytest.raises(InputError, match=message) as caught:
        Collector(env, env.agent(), generator=generator()).rollout(3)
    assert caught.value.argument == "env"
