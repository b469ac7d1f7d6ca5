"""PPO with the defaults as they come beside Stable-Baselines3 with the hyperparameters of its RL Zoo.

python benchmarks/bench_learning.py                                the library alone
python benchmarks/bench_learning.py --peer                         and Stable-Baselines3, which must be installed
python benchmarks/bench_learning.py --only Pendulum-v1 --seeds 3   one environment

Equal steps of the environment, one thread each. The final policy, without exploration, runs 30 episodes from starts
that no training saw. Seeds, median and range of the mean returns; processor time of a training.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import time
from collections.abc import Callable

import gymnasium
import numpy as np
import torch

from ccdtools import LearnedPolicy, closed_loop_returns, load_study
from ccdtools.co_design import EpisodeEnv
from ccdtools.controllers import Passive
from learning import GymnasiumEnvs, train

# Steps of the environment, environments at once, running normalisation and settings of the RL Zoo for PPO (file
# hyperparams/ppo.yml); the two tasks in MuJoCo, on which nothing was developed, have the defaults of Stable-Baselines3.
ZOO: dict[str, tuple[int, int, bool, dict]] = {
    "Pendulum-v1": (
        100_000, 4, False,
        dict(gae_lambda=0.95, gamma=0.9, n_epochs=10, learning_rate=1e-3, use_sde=True, sde_sample_freq=4,
             n_steps=1024),
    ),
    "MountainCarContinuous-v0": (
        20_000, 1, True,
        dict(batch_size=256, n_steps=8, gamma=0.9999, learning_rate=7.77e-5, ent_coef=0.00429, clip_range=0.1,
             n_epochs=10, gae_lambda=0.9, max_grad_norm=5, vf_coef=0.19, use_sde=True,
             policy_kwargs=dict(log_std_init=-3.29, ortho_init=False)),
    ),
    "InvertedPendulum-v5": (100_000, 1, True, {}),
    "Hopper-v5": (100_000, 1, True, {}),
}  # fmt: skip


def ours(name: str, seed: int) -> Callable:
    """A trained policy of this library."""
    env = GymnasiumEnvs(name, runs=4, seed=1000 * seed)
    generator = torch.Generator().manual_seed(seed)
    agent = train(env, env.agent(seed=seed), iterations=ZOO[name][0] // 1024, steps=256, generator=generator).agent

    def policy(observation):
        with torch.no_grad():
            return agent(torch.tensor(observation, dtype=torch.float32)[None])[0].numpy()

    return policy


def peers(name: str, seed: int) -> Callable:
    """A trained policy of Stable-Baselines3."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    steps, runs, normalised, settings = ZOO[name]
    env = make_vec_env(name, runs, seed=1000 * seed)
    if normalised:
        env = VecNormalize(env, gamma=settings.get("gamma", 0.99))
    model = PPO("MlpPolicy", env, seed=seed, device="cpu", **settings).learn(steps)

    def policy(observation):
        seen = env.normalize_obs(observation) if normalised else observation
        return model.predict(seen, deterministic=True)[0]

    return policy


def score(policy: Callable, name: str, seed: int, episodes: int = 30) -> float:
    """Mean return of the policy from starts of its own."""
    env = gymnasium.make(name)
    total = 0.0
    for k in range(episodes):
        observation, _ = env.reset(seed=10**6 + 1000 * seed + k)
        ended = False
        while not ended:
            observation, reward, over, cut, _ = env.step(policy(observation))
            total += float(reward)
            ended = over or cut
    return total / episodes


def on_suspension(seed: int, runs: int) -> tuple[float, float, float]:
    """Return and steps a second of PPO from scratch, 192 000 steps; return of doing nothing."""
    problem = load_study("suspension").problem()
    design = problem.design.centre
    env = EpisodeEnv(problem, design, runs=runs, rng=np.random.default_rng(seed))
    generator = torch.Generator().manual_seed(seed)
    start = time.process_time()
    iterations = 192_000 // (runs * problem.steps)
    trained = train(env, env.agent(seed=seed), iterations=iterations, steps=problem.steps, generator=generator)
    speed = trained.rows[-1].samples / (time.process_time() - start)
    laws = LearnedPolicy(trained.agent, design), Passive(problem.model.nu)
    found = [closed_loop_returns(problem, law, design, rng=np.random.default_rng(10**6), runs=1000) for law in laws]
    return float(found[0].values.mean()), speed, float(found[1].values.mean())


def main() -> None:
    """Print a row for each environment and library."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=[*ZOO, "suspension"])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--peer", action="store_true", help="Stable-Baselines3, too")
    options = parser.parse_args()
    torch.set_num_threads(1)
    for runs in (16, 128) if options.only in (None, "suspension") else ():
        scores, speeds, idle = zip(*(on_suspension(seed, runs) for seed in range(options.seeds)))
        print(
            f"suspension, {runs:3d} runs       ccdtools  median {np.median(scores):8.1f}, {min(scores):8.1f} to"
            f" {max(scores):8.1f}, {np.median(speeds):.0f} steps/s; doing nothing {idle[0]:.1f}",
            flush=True,
        )
    for name in ZOO if options.only is None else [options.only] if options.only in ZOO else []:
        try:
            gymnasium.make(name)
        except (ImportError, gymnasium.error.Error) as error:
            print(f"{name:26s} not measured: {error}")
            continue
        for who, trained in [("ccdtools", ours), *([("SB3", peers)] if options.peer else [])]:
            scores, seconds = [], []
            for seed in range(options.seeds):
                start = time.process_time()
                policy = trained(name, seed)
                seconds.append(time.process_time() - start)
                scores.append(score(policy, name, seed))
            print(
                f"{name:26s} {who:9s} median {np.median(scores):8.1f}, {min(scores):8.1f} to {max(scores):8.1f},"
                f" {np.median(seconds):5.1f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
