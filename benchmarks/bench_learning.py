"""PPO with the defaults as they come beside Stable-Baselines3 with the hyperparameters of its RL Zoo.

python benchmarks/bench_learning.py                                the library alone
python benchmarks/bench_learning.py --peer                         and Stable-Baselines3, which must be installed
python benchmarks/bench_learning.py --only Pendulum-v1 --seeds 3   one environment
python benchmarks/bench_learning.py --in-c                         policies in C: time, size, difference to NumPy
python benchmarks/bench_learning.py --table FOLDER [--row "walls"] every row that is asked of learning, by its script
python benchmarks/bench_learning.py --list                         their commands

Equal steps of the environment, one thread each. The final policy, without exploration, runs 30 episodes from starts
that no training saw. Seeds, median and range of the mean returns; processor time of a training.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import ctypes
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
import torch
from asked import Row, printed
from mass_and_wall import DESIGN, Case

from ccdtools import CoDesignProblem, LearnedPolicy, Scenario, closed_loop_returns, load_study, saturated_lqr
from ccdtools.arrays import Array
from ccdtools.co_design import DesignEnv, EpisodeEnv
from ccdtools.comparison.c_step_time import c_step_time
from ccdtools.controllers import Passive
from ccdtools.controllers.controllers import Controller
from learning import ActorCritic, GymnasiumEnvs, NetworkConfig, train

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
ROWS = (
    Row("PPO", "Stable-Baselines3, five seeds, equal steps: intervals overlap, half the time; 116 000 steps a second",
        ("bench_learning.py --peer",)),
    Row("walls", "at most 2 % below dynamic programming, five seeds, no false CONVERGED",
        ("mass_and_wall.py --seeds 5 --methods pathwise",)),
    Row("damper", "within 1 % of a nonlinear program from every start, five seeds, at 1/100 of its time a step",
        ("semi_active_damper.py --optimal-control 24",
         "semi_active_damper.py --free --springs 10000 --optimal-control 24")),
    Row("jumps", "a policy's gradient within three standard errors of differences, or said to be blind",
        ("policy_gradients.py",)),
    Row("outputs", "within 1 % of LQG on four linear plants; better beyond chance on two others",
        ("lqg_codesign.py --learned estimate", "output_policies.py")),
    Row("LQG", "co-design within 1 % of the trace formula, eight plants", ("lqg_codesign.py",)),
    Row("gain", "one gain with the plant within 2 % of CMA-ES, five plants", ("gain_codesign.py --methods gain",)),
    Row("studies", "methods beside each other, on states and on outputs",
        (*(f"study_methods.py --peer --iterations 60 --steps 48000 --seed {seed}" for seed in range(3)),
         "study_methods.py --peer --sensors",
         "study_methods.py --peer --studies fmu_landing.py --runs 100 --iterations 40 --steps 32000")),
    Row("swing-up", "an imitation within 2 % of nonlinear MPC, a step at most 1/50 of its time",
        ("swing_up.py --by pathwise",)),
    Row("black boxes", "ten plants within 1 % of their optimum in 300 evaluations", ("black_boxes.py",)),
    Row("Gymnasium", "Pendulum-v1 with a wrong mass: generation 2 better in 19 of 20 seeds",
        ("gymnasium_pendulum.py --seeds 20",)),
    Row("C", "NumPy to 1e-12 in double, 1e-6 in float; at most 1 µs and 10 kB for 2 × 16 units",
        ("bench_learning.py --in-c",)),
    Row("fits", "200 fits to 50 … 300 samples: promised 80 %, at most 3 % below", ("band_coverage.py few",)),
)  # fmt: skip


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


def print_in_c() -> None:
    """Print a row for each size of a policy of the suspension and each kind of number: in C, beside NumPy."""
    problem, design = stated("suspension")
    lower, upper = problem.observation_bounds
    x0, w = problem.scenarios.sample(1, 1000, np.random.default_rng(0))
    states = np.random.default_rng(1).uniform(-1.0, 1.0, (1000, problem.model.nx)) * problem.state_scale
    half = (problem.input_bounds[1] - problem.input_bounds[0]) / 2
    for hidden in ((16, 16), (64, 64)):
        agent = ActorCritic(lower, upper, *problem.input_bounds, config=NetworkConfig(hidden), seed=0)
        with torch.no_grad():
            for weights in agent.parameters():
                weights.normal_(0.0, 0.5, generator=torch.Generator().manual_seed(0))  # until units saturate
        policy = LearnedPolicy(agent, design)
        run = Scenario(problem.model, x0, np.array(w)).run(policy, design=design)
        median, slow = c_step_time(policy, run)
        for scalar, number in (("double", ctypes.c_double), ("float", ctypes.c_float)):
            with tempfile.TemporaryDirectory() as folder:
                code = policy.to_c(folder, scalar=scalar)
                shared = Path(folder) / "policy.so"
                subprocess.run([shutil.which("cc"), "-O2", "-shared", "-fPIC", code.files[1], "-o", shared, "-lm"],
                               check=True)  # fmt: skip
                law = ctypes.CDLL(str(shared)).policy_law
                x, u = np.array(states, number), np.zeros((len(states), problem.model.nu), number)
                for one, found in zip(x, u):
                    law(np.ctypeslib.as_ctypes(one), np.ctypeslib.as_ctypes(found))
            expected = policy(states)
            apart = np.abs(u - expected).max() / half.max()
            clock = f"{1e6 * median:.2f} µs (99th percentile {1e6 * slow:.2f})" if scalar == "double" else "–"
            print(f"{hidden} {scalar:6s} {clock}, {code.flash_bytes} B, apart by {apart:.1e} of half the range, "
                  f"of which inputs take up to {np.abs(expected).max() / half.max():.2f}")  # fmt: skip


def main() -> None:
    """Print a row for each environment and library."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=[*ZOO, *PROBLEMS])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--peer", action="store_true", help="Stable-Baselines3, too")
    parser.add_argument("--in-c", action="store_true", help="policies in C alone")
    parser.add_argument("--table", type=Path, help="every row that is asked, kept in this folder")
    parser.add_argument("--row", nargs="+", choices=[row.name for row in ROWS], default=[])
    parser.add_argument("--list", action="store_true", help="rows and their commands")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.table or options.list:
        return printed(ROWS, options.table, options.row)
    if options.in_c:
        return print_in_c()
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
    return None


if __name__ == "__main__":
    main()
