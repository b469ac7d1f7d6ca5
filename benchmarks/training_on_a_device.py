"""Steps a second of PPO with its updates, on the CPU and on a CUDA device.

    python benchmarks/training_on_a_device.py [--threads 1]

Pendulum-v1's equations in torch, as many at once as a row says, on the same device as the networks; rollouts of 128
steps, minibatches of 64 samples (the default) or a quarter of a rollout. Means of two after one to warm up.
"""

from __future__ import annotations

import argparse
import itertools
import time
from statistics import mean

import torch

from learning import ActorCritic, NetworkConfig, PPOConfig, train

STEPS = 128


class Pendulums:
    """So many pendulums on a device; a VectorEnv."""

    def __init__(self, runs: int, device: str) -> None:
        self.runs, self.device = runs, device

    def reset(self) -> torch.Tensor:
        """Angles and rates by chance."""
        self.k = 0
        self.angle = 2 * torch.pi * torch.rand(self.runs, device=self.device)
        self.rate = 2 * torch.rand(self.runs, device=self.device) - 1
        return self.seen()

    def seen(self) -> torch.Tensor:
        """Cosine, sine and rate."""
        return torch.stack([self.angle.cos(), self.angle.sin(), self.rate], dim=-1)

    def step(self, actions: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """A step of 0.05 s; 200 are an episode."""
        u = actions[:, 0]
        wrapped = (self.angle + torch.pi) % (2 * torch.pi) - torch.pi
        reward = -(wrapped**2 + 0.1 * self.rate**2 + 0.001 * u**2)
        self.rate = (self.rate + 0.05 * (15 * self.angle.sin() + 3 * u)).clamp(-8, 8)
        self.angle = self.angle + 0.05 * self.rate
        successor = self.seen()
        self.k += 1
        never = torch.zeros(self.runs, dtype=torch.bool, device=self.device)
        ended = torch.full_like(never, self.k >= 200)
        following = self.reset() if self.k >= 200 else successor
        return following, successor, reward, never, ended


def seconds(runs: int, hidden: tuple[int, ...], minibatch: int, device: str) -> float:
    """Time of a rollout and its update."""
    net = ActorCritic([-1, -1, -8], [1, 1, 8], [-2], [2], config=NetworkConfig(hidden))
    ended: list[float] = []

    def note(_: object) -> None:
        if device != "cpu":
            torch.cuda.synchronize()
        ended.append(time.perf_counter())

    draws = torch.Generator().manual_seed(0)
    config = PPOConfig(minibatch=minibatch, kl_limit=1e9)  # all passes
    options = {"iterations": 3, "steps": STEPS, "config": config, "device": device, "callback": note}
    train(Pendulums(runs, device), net, generator=draws, **options)
    return mean(b - a for a, b in itertools.pairwise(ended))


def main() -> None:
    """Print a row per size."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cuda")
    asked = parser.parse_args()
    torch.set_num_threads(asked.threads)
    print(f"torch {torch.__version__}, {asked.threads} threads, {asked.device}")
    print("| at once | units | minibatch | CPU, steps/s | device, steps/s |\n|---|---|---|---|---|")
    for runs, hidden, quarter in (
        (16, (64, 64), False), (256, (64, 64), True), (4096, (64, 64), True), (4096, (256, 256), True),
    ):  # fmt: skip
        minibatch = runs * STEPS // 4 if quarter else PPOConfig().minibatch
        cpu, device = (runs * STEPS / seconds(runs, hidden, minibatch, where) for where in ("cpu", asked.device))
        print(f"| {runs} | {hidden} | {minibatch} | {cpu:,.0f} | {device:,.0f} |", flush=True)


if __name__ == "__main__":
    main()
