"""Small problems with known answers, shared by the tests of `learning`."""

import torch

from learning import ActorCritic, NetworkConfig


class DoubleIntegrator:
    """x⁺ = (x₁ + 0.1 x₂, x₂ + 0.1 u) with reward −x⁺ᵀx⁺ − 0.01 u²; a VectorEnv that truncates after `horizon`."""

    def __init__(self, runs=8, horizon=20, seed=0, limit=1e9):
        self.runs, self.horizon, self.limit = runs, horizon, limit
        self.generator = torch.Generator().manual_seed(seed)

    def reset(self):
        self.k = 0
        self.x = 2 * torch.rand(self.runs, 2, generator=self.generator) - 1
        return self.x

    def state(self):
        return {"k": self.k, "x": self.x, "generator": self.generator.get_state()}

    def restore(self, state):
        self.k, self.x = state["k"], state["x"]
        self.generator.set_state(state["generator"])

    def step(self, actions):
        position, velocity = self.x.unbind(-1)
        x = torch.stack([position + 0.1 * velocity, velocity + 0.1 * actions[:, 0]], dim=-1)
        reward = -x.square().sum(-1) - 0.01 * actions.square().sum(-1)
        terminated = (x.abs() > self.limit).any(-1)
        self.k += 1
        truncated = torch.full_like(terminated, self.k >= self.horizon) & ~terminated
        self.x = x
        following = self.reset() if self.k >= self.horizon else x
        return following, x, reward, terminated, truncated


def agent(hidden=(16, 16), *, seed=0, std=0.3, **options):
    """An untrained agent for the double integrator."""
    config = NetworkConfig(hidden, initial_std=std, **options)
    return ActorCritic([-1, -1], [1, 1], [-2.0], [2.0], config=config, seed=seed)
