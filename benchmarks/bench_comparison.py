"""A comparison of six controllers on the suspension, killed and resumed, and how often its intervals cover.

    python benchmarks/bench_comparison.py [--seeds 10] [--jobs 2] [--page comparison.html]
    python benchmarks/bench_comparison.py --same          # serial, two processes, Dask, and killed six times
    python benchmarks/bench_comparison.py --cover 1000    # comparisons whose truth is known
    python benchmarks/bench_comparison.py --tables 4000   # and tables of seeds and runs of other truths
    python benchmarks/bench_comparison.py --table FOLDER  # all four, kept in a folder
    python benchmarks/bench_comparison.py --list          # their commands

Two designs, three scenarios, and the car with one parameter off by 20 % with ``--plants``. PPO is trained from
scratch for every design and seed, 192 000 samples each.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import joblib
import numpy as np
import torch
from asked import Row, printed

from ccdtools import (
    LearnedPolicy,
    LinearFeedback,
    QuadraticObjective,
    Scenario,
    experiment,
    linear_mpc,
    load_study,
    plant_from_matrices,
    saturated_lqr,
)
from ccdtools.co_design import EpisodeEnv
from ccdtools.comparison.pid_tuning import tuned_pid
from ccdtools.controllers import Passive
from ccdtools.plants import library
from ccdtools.statistics import interval_of_crossed
from ccdtools.vehicles import GeneratedRoad
from learning import train

STUDY = load_study("suspension")
PROBLEM = STUDY.problem()
RUNS = 50
SEEDS = 10
ROWS = (
    Row("comparison", "six controllers, two designs, three scenarios, ten seeds: at most 20 minutes on two cores",
        ("bench_comparison.py",)),
    Row("the same bits", "in one process, in two, on Dask and after kill −9", ("bench_comparison.py --same",)),
    Row("intervals", "95 ± 1.5 % of intervals hold a known truth",
        ("bench_comparison.py --cover 1000", "bench_comparison.py --tables 4000")),
)  # fmt: skip


def from_scratch(design, rng, samples=192_000, runs=32):
    """PPO from scratch at a design, and the samples that it saw."""
    env = EpisodeEnv(PROBLEM, design, runs=runs, rng=rng)
    seed = int(rng.integers(2**31))
    iterations = max(1, samples // (runs * PROBLEM.steps))
    generator = torch.Generator().manual_seed(seed)
    trained = train(env, env.agent(seed=seed), iterations=iterations, steps=PROBLEM.steps, generator=generator)
    return LearnedPolicy(trained.agent, design), iterations * runs * PROBLEM.steps


def other_gain(design, rng):
    """LQR whose gain is scaled at random, as if it had been learned."""
    law = saturated_lqr(PROBLEM, design)
    return LinearFeedback(law.K * (1 + 0.1 * rng.standard_normal(law.K.shape)), law.lower, law.upper)


CONTROLLERS = {
    "LQR": lambda design, rng: saturated_lqr(PROBLEM, design),
    "passive": lambda design, rng: Passive(1),
    "PID": lambda design, rng: tuned_pid(PROBLEM, design, rng=rng),
    "MPC": lambda design, rng: linear_mpc(PROBLEM, design),
    "LQR, gain off by 10 %": other_gain,
    "PPO": from_scratch,
}
DESIGNS = {"paper": STUDY.p0, "soft": [15_000.0, 1_500.0]}


def starts(rng):
    """Starts and disturbances that the problem states."""
    x0, w = PROBLEM.scenarios.sample(RUNS, PROBLEM.steps, rng)
    return Scenario(PROBLEM.model, x0, np.array(w))


def drives(driver):
    """Drives of a driver from rest, on the nonlinear car."""

    def drawn(rng):
        w = GeneratedRoad(driver).sample(RUNS, PROBLEM.steps, rng)
        return Scenario(STUDY.real.plant, np.zeros((RUNS, 4)), w)

    return drawn


SCENARIOS = {"starts": starts, "mild driver": drives("mild"), "aggressive driver": drives("aggressive")}


def wrong_plants() -> dict:
    """The nominal car, and those with one parameter off by 20 %."""
    car = library.QuarterCar()
    off = {
        f"{name} {part:+.0%}": replace(car, **{name: (1 + part) * getattr(car, name)})
        for name in ("sprung", "unsprung", "tyre") for part in (-0.2, 0.2)
    }  # fmt: skip
    return {name: library.quarter_car(car=one, dt=PROBLEM.model.dt) for name, one in ({"nominal": car} | off).items()}


def compared(seeds, jobs, folder=None, **options):
    """The comparison."""
    return experiment(
        CONTROLLERS, SCENARIOS, designs=DESIGNS, seeds=seeds, objective=PROBLEM.objective, X=PROBLEM.X,
        limit=PROBLEM.limit, jobs=jobs, folder=folder, **options,
    )  # fmt: skip


def timed(kind: str, jobs: int, folder: str | None = None) -> list:
    """Rows of the comparison; its time is printed."""
    start = time.monotonic()
    rows = compared(SEEDS, jobs, folder).rows()
    print(f"{kind}: {time.monotonic() - start:.0f} s", flush=True)
    return rows


def same() -> None:
    """Rows of the comparison in one process, two, on Dask, and killed and resumed: the same bits."""
    from dask.distributed import Client, LocalCluster

    whole = timed("one process", 1)
    two = timed("two processes", 2)
    print(f"{len(whole)} rows; two processes: {'the same' if two == whole else 'OTHER'}", flush=True)
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster, Client(cluster),
        joblib.parallel_config(backend="dask"),
    ):  # fmt: skip
        found = timed("Dask", 2)
    print(f"Dask, two workers: {'the same' if found == whole else 'OTHER'}")
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(6):
            process = subprocess.Popen([sys.executable, __file__, "--part", folder], start_new_session=True)
            time.sleep(rng.uniform(20.0, 60.0))
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            print(f"killed with {len(list(Path(folder).glob('*.npz')))} of 120 tasks kept", flush=True)
        found = timed("the rest", 2, folder)
    print(f"killed six times and resumed: {'the same' if found == whole else 'OTHER'}")


A, R, T, N = 0.95, 0.5, 20, 20  # a scalar plant x⁺ = A x + u + w, whose mean returns are known


def truth(gains):
    """Mean returns of gains (n,) from x0 of variance 4 under noise of variance 1: a recursion of variances."""
    variance, total = np.full_like(gains, 4.0), np.zeros_like(gains)
    for _ in range(T):
        total -= R * gains**2 * variance
        variance = (A - gains) ** 2 * variance + 1.0
        total -= variance
    return total


def cover(number: int) -> None:
    """How many intervals of comparisons with a known truth hold it."""
    plant = plant_from_matrices([[A]], [[1.0]], [[1.0]], dt=1.0, continuous=False)
    objective = QuadraticObjective(Q=[[1.0]], R=[[R]])
    best, spread = 0.6, 0.6

    def drawn(rng):
        return Scenario(plant, 2 * rng.standard_normal((N, 1)), rng.standard_normal((N, T, 1)))

    laws = {
        "LQR": lambda design, rng: LinearFeedback([[best]]),
        "learned": lambda design, rng: LinearFeedback([[best + spread * (rng.beta(2, 5) - 2 / 7)]]),
    }
    learned = truth(best + spread * (np.random.default_rng(1).beta(2, 5, 4_000_000) - 2 / 7)).mean()
    known = {"return": learned, "gain": learned - truth(np.array([best]))[0]}
    for fresh in (True, False):
        for seeds in (5, 10, 20):
            held = dict.fromkeys(known, 0)
            for k in range(number):
                scenario = drawn if fresh else drawn(np.random.default_rng([k, 1]))
                numbers = range(1000 * k, 1000 * k + seeds)
                cell = experiment(laws, scenario, seeds=numbers, objective=objective, X=([-99.0], [99.0]))["learned"]
                for name, found in (("return", cell.value), ("gain", cell.evidence.gain)):
                    held[name] += found.ci95[0] <= known[name] <= found.ci95[1]
            kind = "runs of each seed's own" if fresh else "the same runs with all seeds"
            shares = ", ".join(f"{name} {n / number:.1%}" for name, n in held.items())
            print(f"{kind}, {seeds} seeds: {shares}", flush=True)


def tables(number: int) -> None:
    """How many intervals of tables of seeds and runs hold a known mean."""
    rng = np.random.default_rng(0)

    def normal(*shape):
        return rng.standard_normal((number, *shape))

    truths = {
        "normal seeds, runs and both together": (lambda s, n: normal(s, 1) + normal(1, n) + normal(s, n), 0.0),
        "runs alone matter": (lambda s, n: 0.1 * normal(s, 1) + 2 * normal(1, n) + 0.5 * normal(s, n), 0.0),
        "exponential seeds and runs": (
            lambda s, n: rng.exponential(size=(number, s, 1)) + rng.exponential(size=(number, 1, n)) + normal(s, n), 2.0
        ),
        "lognormal, seeds times runs": (lambda s, n: np.exp(0.5 * (normal(s, 1) + normal(1, n))), np.exp(0.25)),
        "χ² runs of one degree of freedom": (
            lambda s, n: 0.3 * (normal(s, 1) + normal(s, n)) - normal(1, n) ** 2, -1.0
        ),
        "squared gains times χ² runs": (
            lambda s, n: -(rng.uniform(-1, 1, (number, s, 1)) ** 2) * normal(1, n) ** 2, -1 / 3
        ),
        "a fifth of the seeds fail": (
            lambda s, n: -5.0 * (rng.random((number, s, 1)) < 0.2) + normal(1, n) + normal(s, n), -1.0
        ),
        "neither seeds nor runs, both together alone": (normal, 0.0),
        "χ² seeds of one degree of freedom, no runs": (lambda s, n: normal(s, 1) ** 2, 1.0),
    }  # fmt: skip
    print("| truth | 5 × 20 | 10 × 20 | 20 × 20 | 10 × 50 |\n|---|---|---|---|---|")
    for name, (drawn, mean) in truths.items():
        shares = []
        for sizes in ((5, 20), (10, 20), (20, 20), (10, 50)):
            ends = np.array([interval_of_crossed(table) for table in drawn(*sizes)])
            shares.append(f"{100 * np.mean((ends[:, 0] <= mean) & (mean <= ends[:, 1])):.1f} %")
        print(f"| {name} | {' | '.join(shares)} |", flush=True)


def main() -> None:
    """Print what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--page", type=Path)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--plants", action="store_true")
    parser.add_argument("--same", action="store_true")
    parser.add_argument("--cover", type=int)
    parser.add_argument("--tables", type=int)
    parser.add_argument("--table", type=Path)
    parser.add_argument("--list", action="store_true", help="rows and their commands")
    parser.add_argument("--part", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    if asked.part:
        compared(SEEDS, 2, asked.part)
    elif asked.table or asked.list:
        printed(ROWS, asked.table, [])
    elif asked.same:
        same()
    elif asked.cover:
        cover(asked.cover)
    elif asked.tables:
        tables(asked.tables)
    else:
        start = time.monotonic()
        options = {"plants": wrong_plants()} if asked.plants else {}
        found = compared(asked.seeds, asked.jobs, asked.folder, **options)
        print(f"{time.monotonic() - start:.0f} s\n\n{found.table.markdown}\n\n" + "\n".join(found.notes))
        for kind, verdict in found.verdicts.items():
            print(f"{', '.join(kind)}: {verdict}")
        if asked.page:
            found.save(asked.page)


if __name__ == "__main__":
    main()
