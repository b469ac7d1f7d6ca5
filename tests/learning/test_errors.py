"""What `learning` refuses: each error names its argument, carries its data and survives a process boundary."""

import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from learning import (
    PPO,
    ActorCritic,
    CloningConfig,
    NetworkConfig,
    PPOConfig,
    QuantileConfig,
    collect,
    fit_actor_critic,
    fit_quantiles,
    gae,
    load,
    save,
    train,
)  # fmt: skip
from learning.exceptions import CheckpointError, InputError

BOX = ([-1.0], [1.0])
FEW = torch.zeros(3, 2)
NETWORK = ActorCritic([0], [1], [-1], [1])
ENV = SimpleNamespace(reset=lambda: torch.zeros(1, 1), step=lambda actions: None)


def cloned(**changes):
    """Return `fit_actor_critic` on two samples of one input, with some of its arguments changed."""
    given = {"action_bounds": BOX, "rng": np.random.default_rng(0), "config": CloningConfig(steps=1)}
    return fit_actor_critic([[0.0], [1.0]], [[0.0], [0.5]], [0.0, -1.0], **(given | changes))


@pytest.mark.parametrize(
    ("call", "argument"),
    [
        (lambda: NetworkConfig(hidden=8), "hidden"),
        (lambda: NetworkConfig(hidden=(8.5,)), "hidden"),
        (lambda: NetworkConfig(initial_std="wide"), "initial_std"),
        (lambda: CloningConfig(steps=0), "steps"),
        (lambda: CloningConfig(learning_rate=np.inf), "learning_rate"),
        (lambda: QuantileConfig(levels="median"), "levels"),
        (lambda: QuantileConfig(calibration=1.0), "calibration"),
        (lambda: QuantileConfig(batch=-1), "batch"),
        (lambda: fit_quantiles("x", np.zeros((30, 1)), rng=np.random.default_rng(0)), "inputs"),
        (lambda: fit_quantiles(np.zeros((30, 1)), np.zeros((30, 1)), rng=0), "rng"),
        (lambda: fit_quantiles(np.zeros((30, 1)), np.zeros((30, 1)), rng=None), "rng"),
        (lambda: fit_quantiles(np.zeros((30, 1)), np.zeros((30, 1)), stretches=[40, -10], rng=np.random.default_rng(0)),
         "stretches"),
        (lambda: fit_actor_critic([[0.0]], [[0.0]], [0.0], action_bounds=BOX, rng=3), "rng"),
        (lambda: fit_actor_critic([["a"]], [[0.0]], [0.0], action_bounds=BOX, rng=np.random.default_rng(0)), "inputs"),
        (lambda: fit_actor_critic([[0.0], [1.0, 2.0]], [[0.0]], [0.0], action_bounds=BOX,
                                  rng=np.random.default_rng(0)), "inputs"),
        (lambda: cloned(action_bounds=3), "action_bounds"),
        (lambda: cloned(action_bounds=None), "action_bounds"),
        (lambda: cloned(action_bounds=([-1, -1], [1, 1])), "action_bounds"),
        (lambda: cloned(input_bounds=([-1, -1], [1, 1])), "input_bounds"),
        (lambda: cloned(config=3), "config"),
        (lambda: cloned(network=(64, 64)), "network"),
        (lambda: fit_quantiles(np.zeros((30, 1)), np.zeros((30, 1)), rng=np.random.default_rng(0), config=0), "config"),
        (lambda: collect(3, NETWORK, steps=2, generator=torch.Generator()), "env"),
        (lambda: collect(ENV, 3, steps=2, generator=torch.Generator()), "agent"),
        (lambda: collect(ENV, NETWORK, steps=0, generator=torch.Generator()), "steps"),
        (lambda: collect(ENV, NETWORK, steps=2, generator=0), "generator"),
        (lambda: train(ENV, NETWORK, iterations=1, steps=2, generator=torch.Generator(), config=3), "config"),
        (lambda: train(ENV, None, iterations=1, steps=2, generator=torch.Generator()), "agent"),
        (lambda: gae(FEW, FEW, FEW, FEW > 0, FEW[:2] > 0, gamma=0.9, lam=0.9), "truncated"),
        (lambda: gae("rewards", FEW, FEW, FEW > 0, FEW > 0, gamma=0.9, lam=0.9), "rewards"),
        (lambda: gae(FEW, FEW, FEW, FEW, FEW > 0, gamma=0.9, lam=0.9), "terminated"),
        (lambda: gae(FEW, FEW, FEW, FEW > 0, FEW > 0, gamma=9, lam=0.9), "gamma"),
        (lambda: PPO(3, PPOConfig()), "agent"),
        (lambda: PPO(NETWORK, PPOConfig), "config"),
        (lambda: PPO(NETWORK, PPOConfig()).update(3, generator=torch.Generator()), "rollout"),
        (lambda: fit_quantiles(np.zeros((30, 1)), np.zeros((30, 1)), stretches=30, rng=np.random.default_rng(0)),
         "stretches"),
        (lambda: save("agent.safetensors", 3), "network"),
        (lambda: save(3, NETWORK), "path"),
        (lambda: save("agent.safetensors", NETWORK, {"a": object()}), "extra"),
        (lambda: load(None), "path"),
        (lambda: ActorCritic(["low"], [1], [-1], [1]), "observation_lower"),
    ],
)  # fmt: skip
def test_a_wrong_call_names_its_argument(call, argument):
    with pytest.raises(InputError) as caught:
        call()
    assert caught.value.argument == argument
    assert str(caught.value).startswith(f"{argument}: got ")


def test_errors_carry_their_data_and_can_be_pickled():
    for error in (InputError("x", "3", "4", "Use 4."), CheckpointError("a.safetensors", "nothing", "a network")):
        again = pickle.loads(pickle.dumps(error))
        assert type(again) is type(error)
        assert str(again) == str(error)
        assert again.__dict__ == error.__dict__


def test_saving_makes_the_folder_and_refuses_a_path_that_cannot_be_one(tmp_path):
    network = ActorCritic([0], [1], [-1], [1])
    save(tmp_path / "new" / "agent.safetensors", network)
    again, _ = load(tmp_path / "new" / "agent.safetensors")
    x = torch.rand(3, 1)
    torch.testing.assert_close(again.latent(x), network.latent(x))
    (tmp_path / "file").write_text("")
    with pytest.raises(CheckpointError, match="expected a file that can be written"):
        save(tmp_path / "file" / "agent.safetensors", network)


def test_a_constant_column_far_from_zero_is_not_stretched():
    rng = np.random.default_rng(0)
    x = np.column_stack([np.full(200, 1e6), rng.uniform(-1e-9, 1e-9, 200)])
    network = fit_quantiles(x, x[:, 1:], rng=rng, config=QuantileConfig(steps=20))
    assert network.input_scale[0] == 1.0
    assert network.input_scale[1] < 1e-8


def test_a_network_prints_in_a_line():
    assert repr(NETWORK) == "ActorCritic(1 observations, 1 actions, hidden layers (64, 64))"
