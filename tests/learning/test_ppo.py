"""PPO: advantages by their definition, the ratio, the KL limit, and that it learns."""

import copy
import pickle

import numpy as np
import pytest
import torch
from scipy.linalg import solve_discrete_are
from toys import DoubleIntegrator, agent

from learning import PPO, PPOConfig, collect, gae, train
from learning.exceptions import InputError

NEVER = torch.zeros(3, 1, dtype=torch.bool)


def column(*values):
    return torch.tensor(values).reshape(-1, 1)


def generator(seed=1):
    return torch.Generator().manual_seed(seed)


def experience(net, steps=20, **options):
    return collect(DoubleIntegrator(**options), net, steps=steps, generator=generator())


def at(k, steps=3):
    flags = torch.zeros(steps, 1, dtype=torch.bool)
    flags[k] = True
    return flags


# ── advantages ──


def test_gae_agrees_with_an_example_worked_by_hand():
    # δ = (1 + 0.5·2 − 1, 2 + 0.5·3 − 2, 3 + 0.5·4 − 3) = (1, 1.5, 2), γλ = 0.25: A₂ = 2, A₁ = 2, A₀ = 1.5
    out = gae(column(1.0, 2.0, 3.0), column(1.0, 2.0, 3.0), column(2.0, 3.0, 4.0), NEVER, NEVER, gamma=0.5, lam=0.5)
    torch.testing.assert_close(out, column(1.5, 2.0, 2.0))


def test_gae_runs_over_time_and_never_mixes_the_batch():
    torch.manual_seed(0)
    rewards, values, successors = torch.randn(6, 4), torch.randn(6, 4), torch.randn(6, 4)
    none = torch.zeros(6, 4, dtype=torch.bool)
    whole = gae(rewards, values, successors, none, none, gamma=0.9, lam=0.8)
    for i in range(4):
        j = slice(i, i + 1)
        alone = gae(rewards[:, j], values[:, j], successors[:, j], none[:, j], none[:, j], gamma=0.9, lam=0.8)
        torch.testing.assert_close(whole[:, j], alone)


def test_gae_terminal_state_cuts_bootstrap_and_trace():
    args = column(1.0, 1.0, 1.0), column(0.0, 0.0, 0.0), column(10.0, 10.0, 10.0)
    out = gae(*args, at(1), NEVER, gamma=0.5, lam=1.0)
    torch.testing.assert_close(out, column(1 + 5 + 0.5 * 1, 1.0, 1 + 5.0))


def test_gae_time_limit_keeps_bootstrap_and_cuts_trace():
    args = column(1.0, 1.0, 1.0), column(0.0, 0.0, 0.0), column(10.0, 10.0, 10.0)
    out = gae(*args, NEVER, at(1), gamma=0.5, lam=1.0)
    torch.testing.assert_close(out, column(1 + 5 + 0.5 * 6, 6.0, 6.0))


def slow_gae(rewards, values, successors, terminated, truncated, gamma, lam):
    """Σ_l (γλ)^l δ_{t+l} up to the end of the episode, written as its definition (Schulman et al. 2016, eq. 16)."""
    steps, runs = rewards.shape
    out = torch.zeros(steps, runs, dtype=rewards.dtype)
    for i in range(runs):
        for t in range(steps):
            for k in range(t, steps):
                future = 0.0 if terminated[k, i] else gamma * successors[k, i]
                out[t, i] += (gamma * lam) ** (k - t) * (rewards[k, i] + future - values[k, i])
                if terminated[k, i] or truncated[k, i]:
                    break
    return out


@pytest.mark.parametrize("lam", [0.0, 0.7, 1.0])
def test_gae_agrees_with_its_quadratic_definition(lam):
    torch.manual_seed(1)
    rewards, values, successors = (torch.randn(25, 6, dtype=torch.float64) for _ in range(3))
    terminated = torch.rand(25, 6) < 0.1
    truncated = (torch.rand(25, 6) < 0.1) & ~terminated
    args = rewards, values, successors, terminated, truncated
    torch.testing.assert_close(gae(*args, gamma=0.97, lam=lam), slow_gae(*args, 0.97, lam))


def test_with_lambda_one_and_true_values_the_advantage_of_a_deterministic_chain_is_zero():
    gamma = 0.9
    rewards = torch.ones(50, 1, dtype=torch.float64)
    values = torch.full((50, 1), 1 / (1 - gamma), dtype=torch.float64)
    none = torch.zeros(50, 1, dtype=torch.bool)
    last = none.clone()
    last[-1] = True
    out = gae(rewards, values, values, none, last, gamma=gamma, lam=1.0)
    torch.testing.assert_close(out, torch.zeros_like(out), atol=1e-12, rtol=0)


# ── a prepared batch ──


# ── the loss and the update ──


def weights(parameters):
    return torch.cat([p.detach().flatten() for p in parameters]).clone()


def test_an_update_without_the_actor_leaves_the_policy_alone():
    net = agent()
    data = experience(net)
    actor, critic = weights(net.actor_parameters()), weights(net.value_network.parameters())
    PPO(net, PPOConfig.warm()).update(data, generator=generator(), actor=False)
    assert torch.equal(weights(net.actor_parameters()), actor)
    assert not torch.equal(weights(net.value_network.parameters()), critic)


def test_critic_only_iterations_leave_the_actor_alone_in_training():
    net = agent()
    before = weights(net.actor_parameters())
    options = {"steps": 20, "generator": generator()}
    train(DoubleIntegrator(), net, iterations=3, config=PPOConfig.warm(critic_only=3), **options)
    assert torch.equal(weights(net.actor_parameters()), before)
    train(DoubleIntegrator(), net, iterations=3, config=PPOConfig.warm(critic_only=2), **options)
    assert not torch.equal(weights(net.actor_parameters()), before)


def test_the_kl_limit_stops_the_passes():
    config = PPOConfig.warm(learning_rate=1e-2, passes=30, minibatch=40)
    net = agent()
    data = experience(net)
    free = PPO(copy.deepcopy(net), PPOConfig(**{**vars(config), "kl_limit": float("inf")}))
    limited = PPO(copy.deepcopy(net), PPOConfig(**{**vars(config), "kl_limit": 0.01}))
    all_of_them = free.update(data, generator=generator())
    stopped = limited.update(data, generator=generator())
    assert all_of_them.passes == 30
    assert stopped.passes < 30
    assert stopped.kl > 0.01


def test_the_explained_variance_is_one_for_a_perfect_critic_and_zero_for_a_constant_one():
    net, config = agent(), PPOConfig.warm(lam=0.0)
    data = experience(net)
    with torch.no_grad():
        data.rewards[:] = net.value(data.observations) - config.gamma * net.value(data.successors)
    perfect = PPO(copy.deepcopy(net), config).update(data, generator=generator(), actor=False)
    assert perfect.explained_variance == pytest.approx(1.0, abs=1e-6)
    for parameter in net.value_network.parameters():
        parameter.data.zero_()
    constant = PPO(net, config).update(data, generator=generator(), actor=False)
    assert constant.explained_variance == pytest.approx(0.0, abs=1e-6)


def test_the_optimisers_live_as_long_as_the_training():
    net = agent()
    ppo = PPO(net, PPOConfig.warm(passes=1))
    for _ in range(3):
        ppo.update(experience(net), generator=generator())
    for optimiser in ppo.state()["optimisers"]:
        assert optimiser["steps"].item() == 3


def test_optimisers_are_restored_to_where_the_networks_are():
    state = PPO(agent(), PPOConfig.warm()).state()  # a checkpoint is read to the CPU
    elsewhere = PPO(agent().to("meta"), PPOConfig.warm())
    elsewhere.restore(state)
    for optimiser in elsewhere.state()["optimisers"]:
        assert {value.device.type for value in optimiser.values()} == {"meta"}


def test_gradients_are_clipped_before_adam():
    net = agent()
    ppo = PPO(net, PPOConfig.warm(max_gradient=1e-6, passes=1))
    statistics = ppo.update(experience(net), generator=generator())
    for optimiser in ppo.state()["optimisers"]:  # after one step its mean is a tenth of what it got
        assert optimiser["mean"].norm().item() == pytest.approx(1e-7, rel=1e-3)
    assert statistics.gradient_norm > 1e-3  # as it was before


def mean_return(law):
    env = DoubleIntegrator(runs=256, horizon=40, seed=9)
    x = env.reset()
    total = 0.0
    with torch.no_grad():
        for _ in range(40):
            x, _, reward, _, _ = env.step(law(x))
            total += reward.mean().item()
    return total


def linear_quadratic_regulator():
    A, B = np.array([[1, 0.1], [0, 1]]), np.array([[0], [0.1]])
    P = solve_discrete_are(A, B, np.eye(2), [[0.01]])
    K = np.linalg.solve(0.01 + B.T @ P @ B, B.T @ P @ A)
    return lambda x: (-x @ torch.tensor(K.T, dtype=torch.float32)).clamp(-2, 2)


@pytest.mark.long
def test_ppo_alone_closes_most_of_the_gap_between_doing_nothing_and_lqr():
    net = agent()
    for parameter in (net.mean_network.head.weight, net.mean_network.head.bias, net.mean_network.skip.weight):
        parameter.data.zero_()
    net.value_offset.fill_(-30.0)
    net.value_scale.fill_(20.0)

    def law(x):
        return net.action(net.latent(x))

    nothing, best = mean_return(law), mean_return(linear_quadratic_regulator())
    calls = []
    config = PPOConfig.warm(learning_rate=3e-3, value_rate=5e-3, critic_only=3, minibatch=640, final_std=0.1)
    train(
        DoubleIntegrator(runs=64, horizon=40), net, iterations=40, steps=40, config=config, generator=generator(),
        callback=calls.append,
    )  # fmt: skip
    assert (mean_return(law) - nothing) / (best - nothing) > 0.8
    assert net.log_std.exp().item() == pytest.approx(0.1, rel=0.1)
    assert [row.iteration for row in calls] == list(range(40))
    assert np.isfinite([row.update.kl for row in calls]).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gamma": 1.0}, "gamma: got 1.0, expected a number from 0 to 1, both excluded"),
        ({"gamma": 0.0}, "gamma: got 0.0"),
        ({"passes": 2.5}, "passes: got 2.5, expected a whole number, at least 1"),
        ({"minibatch": True}, "minibatch: got True"),
        ({"learning_rate": -1e-3}, "learning_rate: got -0.001, expected a finite number at least 0"),
        ({"kl_limit": "small"}, "kl_limit: got 'small'"),
        ({"lam": 1.1}, "lam: got 1.1, expected a number from 0 to 1"),
    ],
)
def test_settings_outside_their_range_are_refused(options, message):
    with pytest.raises(InputError, match=message) as caught:
        PPOConfig(**options)
    assert caught.value.argument in options


def test_a_trained_agent_is_as_large_a_pickle_as_an_untrained_one():
    net = agent()
    size = len(pickle.dumps(net))
    PPO(net, PPOConfig.warm(passes=1)).update(experience(net), generator=generator())
    assert len(pickle.dumps(net)) < 1.1 * size


def test_frozen_parameters_stay():
    net = agent()
    net.value_network.head.requires_grad_(False)
    net.mean_network.head.requires_grad_(False)
    frozen = weights([*net.value_network.head.parameters(), *net.mean_network.head.parameters()])
    others = weights(net.actor_parameters())
    PPO(net, PPOConfig(passes=2, running_scales=False)).update(experience(net), generator=generator())
    assert torch.equal(weights([*net.value_network.head.parameters(), *net.mean_network.head.parameters()]), frozen)
    assert not torch.equal(weights(net.actor_parameters()), others)


def test_a_network_that_is_frozen_whole_stays():
    net = agent()
    net.value_network.requires_grad_(False)
    frozen, others = weights(net.value_network.parameters()), weights(net.actor_parameters())
    ppo = PPO(net, PPOConfig(passes=2, running_scales=False))
    ppo.update(experience(net), generator=generator(), actor=False)
    assert torch.equal(weights(net.actor_parameters()), others)
    ppo.update(experience(net), generator=generator())
    assert torch.equal(weights(net.value_network.parameters()), frozen)
    assert not torch.equal(weights(net.actor_parameters()), others)
