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
from mass_and_wall import DESIGN, Case

from ccdtools import CoDesignProblem, LearnedPolicy, closed_loop_returns, load_study, saturated_lqr
from ccdtools.arrays import Array
from ccdtools.co_design import DesignEnv, EpisodeEnv
from ccdtools.controllers import Passive
from ccdtools.controllers.controllers import Controller
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
# For the problems of this library its Zoo has none: its defaults with 16 environments, and what the Zoo gives the
# pendulum with the discount of 0.99 that all others here have.
PROBLEMS = ("suspension", "wall", "pendulum_on_cart")
STEPS = 192_000
SETTINGS: dict[str, tuple[int, dict]] = {
    "default": (16, {"n_steps": 128}),
    "pendulum": (4, {**ZOO["Pendulum-v1"][3], "gamma": 0.99}),
}


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


def stated(name: str) -> tuple[CoDesignProblem, Array]:
    """Problem of the library and its fixed design."""
    if name == "wall":
        return Case().problem(), np.array(DESIGN)
    problem = load_study(name).problem()
    return problem, problem.design.centre


def ours_on(name: str, seed: int, runs: int) -> Controller:
    """Law that PPO of this library finds from scratch in 192 000 steps."""
    problem, design = stated(name)
    env = EpisodeEnv(problem, design, runs=runs, rng=np.random.default_rng(seed))
    generator = torch.Generator().manual_seed(seed)
    trained = train(env, env.agent(seed=seed), iterations=STEPS // (64 * runs), steps=64, generator=generator)
    return LearnedPolicy(trained.agent, design)


def peers_on(name: str, seed: int, settings: str) -> Controller:
    """Law that PPO of Stable-Baselines3 finds in as many steps, observations and rewards normalised."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    problem, design = stated(name)
    runs, own = SETTINGS[settings]
    env = VecNormalize(make_vec_env(lambda: DesignEnv(problem, design), runs, seed=1000 * seed))
    model = PPO("MlpPolicy", env, seed=seed, device="cpu", **own).learn(STEPS)

    def policy(seen):
        return model.predict(env.normalize_obs(seen), deterministic=True)

    return DesignEnv(problem, design).controller(policy)


def print_problem(name: str, seeds: int, peer: bool) -> None:
    """Print a row for each library and setting on a problem."""
    problem, design = stated(name)

    def mean(law: Controller) -> float:
        found = closed_loop_returns(problem, law, design, rng=np.random.default_rng(10**6), runs=1000)
        return float(found.values.mean())

    print(
        f"{name}: doing nothing {mean(Passive(problem.model.nu)):.2f}, LQR {mean(saturated_lqr(problem, design)):.2f}"
    )
    trainings = [("ccdtools", ours_on, 16), ("ccdtools", ours_on, 128)]
    trainings += [("SB3", peers_on, setting) for setting in SETTINGS] if peer else []
    for who, trained, how in trainings:
        scores, seconds = [], []
        for seed in range(seeds):
            start = time.process_time()
            law = trained(name, seed, how)
            seconds.append(time.process_time() - start)
            scores.append(mean(law))
        print(
            f"{name:11s} {who:9s} {how!s:9s} median {np.median(scores):8.2f}, {min(scores):8.2f} to"
            f" {max(scores):8.2f}, {np.median(seconds):5.1f} s",
            flush=True,
        )


def main() -> None:
    """Print a row for each environment and library."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=[*ZOO, *PROBLEMS])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--peer", action="store_true", help="Stable-Baselines3, too")
    options = parser.parse_args()
    torch.set_num_threads(1)
    for name in PROBLEMS:
        if options.only in (None, name):
            print_problem(name, options.seeds, options.peer)
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
                f" {np.median(seconds):5.1f} s, {ZOO[name][0] / np.median(seconds):.0f} steps a second",
                flush=True,
            )


if __name__ == "__main__":
    main()
