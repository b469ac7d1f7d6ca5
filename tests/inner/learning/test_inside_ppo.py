"""What test_ppo.py claims, seen from inside."""

import pytest
import torch
from toys import DoubleIntegrator, agent

from learning import PPO, PPOConfig, collect, gae
from learning.ppo import ppo_losses, prepare


def generator(seed=1):
    return torch.Generator().manual_seed(seed)


def experience(net, steps=20, **options):
    return collect(DoubleIntegrator(**options), net, steps=steps, generator=generator())


def test_advantages_are_normalised_and_outliers_limited():
    batch = prepare(agent(), experience(agent()), PPOConfig.warm())
    assert abs(batch.advantages.mean()) < 1e-2
    assert batch.advantages.std() == pytest.approx(1, abs=0.05)
    data = experience(agent())
    data.rewards[3, 2] = -1e6
    assert prepare(agent(), data, PPOConfig.warm()).advantages.abs().max() <= 5.0


def test_value_targets_are_advantage_plus_value():
    net, config = agent(), PPOConfig.warm()
    data = experience(net)
    with torch.no_grad():
        values, successors = net.value(data.observations), net.value(data.successors)
    raw = gae(data.rewards, values, successors, data.terminated, data.truncated, gamma=config.gamma, lam=config.lam)
    torch.testing.assert_close(prepare(net, data, config).targets, (raw + values).flatten())


def test_a_time_limit_is_bootstrapped_with_the_state_before_the_restart():
    net = agent()
    data = experience(net, steps=20, horizon=20)
    config = PPOConfig(lam=0.0)
    with torch.no_grad():
        expected = data.rewards[-1] + config.gamma * net.value(data.successors[-1])
    torch.testing.assert_close(prepare(net, data, config).targets.reshape(20, 8)[-1], expected)


def test_the_ratio_is_one_at_the_first_pass():
    net, config = agent(std=2.0), PPOConfig.warm()
    batch = prepare(net, experience(net), config)
    losses = ppo_losses(net, batch, config)
    assert losses.surrogate.item() == pytest.approx(-batch.advantages.mean().item(), abs=1e-6)
    assert abs(losses.kl) < 1e-6


def test_the_clipped_surrogate_has_no_gradient_beyond_its_limits():
    net, config = agent(), PPOConfig(clip=0.2)
    batch = prepare(net, experience(net), config)
    far = type(batch)(
        batch.observations,
        batch.latents,
        batch.log_probs - 1.0,
        batch.advantages.abs() + 0.1,
        batch.targets,
        batch.values,
    )  # every ratio is e > 1.2 with a positive advantage
    surrogate = ppo_losses(net, far, config).surrogate
    assert surrogate.item() == pytest.approx(-1.2 * far.advantages.mean().item(), rel=1e-5)
    gradients = torch.autograd.grad(surrogate, net.actor_parameters(), allow_unused=True)
    assert all(g is None or not g.any() for g in gradients)


def test_the_value_loss_is_smooth_l1_in_units_of_the_value_scale():
    net, config = agent(), PPOConfig(value_coefficient=0.7)
    net.value_scale.fill_(4.0)
    batch = prepare(net, experience(net), config)
    error = ((net.value(batch.observations) - batch.targets) / 4.0).abs()
    expected = 0.7 * torch.where(error < 1, 0.5 * error**2, error - 0.5).mean()
    torch.testing.assert_close(ppo_losses(net, batch, config).value, expected)


def test_every_sample_is_used_once_per_pass(monkeypatch):
    net = agent()
    data = experience(net)
    seen = []

    def spy(agent, batch, config):
        seen.append(batch.latents)
        return ppo_losses(agent, batch, config)

    monkeypatch.setattr("learning.ppo.ppo_losses", spy)
    PPO(net, PPOConfig(minibatch=48, passes=2, kl_limit=float("inf"))).update(data, generator=generator())
    assert [len(part) for part in seen] == 2 * [48, 48, 48, 16]
    for half in (seen[:4], seen[4:]):
        torch.testing.assert_close(torch.cat(half).flatten().sort().values, data.latents.flatten().sort().values)
