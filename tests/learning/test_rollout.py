"""Collecting experience."""

import torch
from toys import DoubleIntegrator, agent

from learning import collect


def rollout(steps=30, **options):
    return collect(DoubleIntegrator(**options), agent(), steps=steps, generator=torch.Generator().manual_seed(1))


def test_experience_is_time_first():
    data = rollout(steps=5)
    assert data.observations.shape == data.successors.shape == (5, 8, 2)
    assert data.latents.shape == (5, 8, 1)
    assert data.rewards.shape == data.log_probs.shape == data.terminated.shape == data.truncated.shape == (5, 8)


def test_the_log_probability_belongs_to_the_unclipped_latent():
    wide = agent(std=3.0)
    data = collect(DoubleIntegrator(), wide, steps=20, generator=torch.Generator().manual_seed(1))
    assert (data.latents.abs() > 1).float().mean() > 0.5
    expected = wide.distribution(data.observations).log_prob(data.latents).sum(-1)
    torch.testing.assert_close(data.log_probs, expected)
    clipped = wide.distribution(data.observations).log_prob(data.latents.clamp(-1, 1)).sum(-1)
    assert not torch.allclose(data.log_probs, clipped)


def test_the_environment_receives_clipped_actions():
    seen = []

    class Spy(DoubleIntegrator):
        def step(self, actions):
            seen.append(actions)
            return super().step(actions)

    data = collect(Spy(), agent(std=3.0), steps=10, generator=torch.Generator().manual_seed(1))
    actions = torch.stack(seen)
    torch.testing.assert_close(actions, 2.0 * data.latents.clamp(-1, 1))


def test_a_successor_is_the_next_observation_unless_the_episode_was_restarted():
    data = rollout(steps=30, horizon=20)
    same = torch.isclose(data.successors[:-1], data.observations[1:]).all(-1)
    assert same[:19].all()
    assert not same[19].any()
    assert data.truncated[19].all()
    assert data.truncated.sum() == 8


def test_the_same_generator_gives_the_same_experience():
    torch.testing.assert_close(rollout().latents, rollout().latents)


def test_collecting_needs_no_gradient():
    assert not rollout(steps=2).log_probs.requires_grad
