"""How often the interval of a gain on recombined runs covers: ``python benchmarks/recombination_coverage.py``.

Loops x⁺ = a x + e, a slow and a fast one, under errors of many kinds; the candidate has another a. What costs is x², of
two such states (x₁ + x₂)². A log is told independent or not as in a study, and judged accordingly. The truth is the
mean over 200 000 runs.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.signal import lfilter

from ccdtools import QuadraticObjective
from ccdtools.statistics import summarise
from ccdtools.trajectory import Trajectory
from ccdtools.twin.recombined_returns import independence, recombined_gain
from ccdtools.twin.replay import Replay
from ccdtools.twin.residuals import Residuals

STEPS = 100
ROUNDS = 10
COSTS = {states: QuadraticObjective(Q=np.ones((states, states)), R=[[1e-9]]) for states in (1, 2)}
LOOPS = {"slow": (0.99, 0.97), "fast": (0.7, 0.5)}  # a in service, and of the candidate
Noise = Callable[[int, np.random.Generator], np.ndarray]


def coloured(rho: float, share: float, runs: int, rng: np.random.Generator) -> np.ndarray:
    """White noise with so large a share of AR(1) noise, of variance one."""
    slow = lfilter([1], [1, -rho], rng.standard_normal((runs, STEPS + 200)), axis=1)[:, 200:] * np.sqrt(1 - rho**2)
    return np.sqrt(share) * slow + np.sqrt(1 - share) * rng.standard_normal((runs, STEPS))


def scaled(size: float | np.ndarray, runs: int, rng: np.random.Generator) -> np.ndarray:
    """White noise of a size that may change in time."""
    return size * rng.standard_normal((runs, STEPS))


def spiky(runs: int, rng: np.random.Generator) -> np.ndarray:
    """White noise, in one of 200 samples 15 times as large."""
    return scaled(1.0, runs, rng) * np.where(rng.random((runs, STEPS)) < 0.005, 15, 1)


def levels(runs: int, rng: np.random.Generator) -> np.ndarray:
    """White noise of another size in every run."""
    return scaled(np.exp(0.5 * rng.standard_normal((runs, 1))), runs, rng)


def bursts(runs: int, rng: np.random.Generator) -> np.ndarray:
    """White noise, in every fourth run five times as large for ten steps."""
    begun = rng.integers(0, STEPS - 10, (runs, 1))
    loud = (rng.random((runs, 1)) < 0.25) & (time >= begun) & (time < begun + 10)
    return scaled(np.where(loud, 5.0, 1.0), runs, rng)


def two_states(lag: int, runs: int, rng: np.random.Generator) -> np.ndarray:
    """White noise of two states, that of the second as that of the first so many steps before; 0 if it is its own."""
    first = rng.standard_normal((runs, STEPS + lag))
    second = first[:, :STEPS] if lag else rng.standard_normal((runs, STEPS))
    return np.stack([first[:, lag:], second], axis=-1)


time = np.arange(STEPS)
NOISES: dict[str, Noise] = {
    "white": partial(scaled, 1.0), "white, unit 1e-6": partial(scaled, 1e-6), "white, unit 1e6": partial(scaled, 1e6),
    "loud start": partial(scaled, 1 + 9 * np.exp(-time / 5)), "season": partial(scaled, 1.1 + np.sin(time / 8)),
    "spikes": spiky, "size differs by run": levels,
    "AR(0.3)": partial(coloured, 0.3, 1.0), "AR(0.6)": partial(coloured, 0.6, 1.0),
    "AR(0.9)": partial(coloured, 0.9, 1.0),
    "AR(0.9), 5 %": partial(coloured, 0.9, 0.05), "AR(0.9), 2.5 %": partial(coloured, 0.9, 0.025),
    "AR(0.9), 0.8 %": partial(coloured, 0.9, 0.008), "AR(0.03)": partial(coloured, 0.03, 1.0),
    "bursts": bursts, "two states": partial(two_states, 0), "two states, one later": partial(two_states, 1),
}  # fmt: skip


def loop(pole: float, x0: np.ndarray, w: np.ndarray) -> Trajectory:
    """Runs of x⁺ = a x + e."""
    x = lfilter([1], [1, -pole], np.concatenate([x0[:, None], w], axis=1), axis=1)
    return Trajectory(x, np.zeros_like(w[..., :1]), w, np.full(len(w), -1), np.zeros(0), 0.1)


def returns(pole: float, e: np.ndarray, unit: float) -> np.ndarray:
    """Returns (n,) from x = unit."""
    states = e.shape[2]
    return loop(pole, np.full((len(e), states), unit), e).returns(COSTS[states])


def of_states(noise: Noise, runs: int, rng: np.random.Generator) -> np.ndarray:
    """Errors (n, T, nx)."""
    e = noise(runs, rng)
    return e if e.ndim == 3 else e[..., None]


def row(noise: Noise, poles: tuple[float, float], runs: int, logs: int, seed: int) -> list[str]:
    """Cells of the table for one kind of errors, loop and number of runs."""
    rng = np.random.default_rng(seed)
    unit = float(noise(100, rng).std())
    cost = COSTS[of_states(noise, 1, rng).shape[2]]
    own, other = poles
    many = (of_states(noise, 5000, rng) for _ in range(40))
    true = np.mean([(returns(other, e, unit) - returns(own, e, unit)).mean() for e in many])
    told, covers, covers_whole, final, width = [], [], [], [], []
    for _ in range(logs):
        e = of_states(noise, runs, rng)
        x = np.full(e.shape, unit)
        log = Residuals(np.zeros_like(x), x, np.zeros_like(x[..., :1]), np.zeros(0), e, independent=True)
        replay = Replay([log])
        whole = summarise(returns(other, e, unit) - returns(own, e, unit)).ci95
        found = independence(replay, lambda x0, w: (loop(own, x0, w),), cost, rng)
        covers_whole.append(whole[0] < true < whole[1])
        told.append(found.independent)
        final.append(covers_whole[-1])
        if found.independent:
            drive = lambda x0, w: (loop(other, x0, w), loop(own, x0, w))  # noqa: E731
            gain = recombined_gain(replay, drive, cost, ROUNDS * runs, rng).gain
            covers.append(gain.ci95[0] < true < gain.ci95[1])
            final[-1] = covers[-1]
            width.append((gain.ci95[1] - gain.ci95[0]) / (whole[1] - whole[0]))
    made = [f"{np.mean(covers):.0%}", f"{np.mean(width):.2f}"] if covers else ["–", "–"]
    return [f"{np.mean(told):.0%}", *made, f"{np.mean(covers_whole):.0%}", f"{np.mean(final):.0%}"]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, default=100)
    parser.add_argument("--errors", nargs="+", choices=NOISES, default=list(NOISES))
    parser.add_argument("--runs", type=int, nargs="+", default=[200, 60, 36])
    given = parser.parse_args()
    head = ["errors", "loop", "runs", "recombined", "covers", "width", "whole runs cover", "as judged covers"]
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    for name in given.errors:
        for kind, poles in LOOPS.items():
            for runs in given.runs:
                cells = [name, kind, str(runs), *row(NOISES[name], poles, runs, given.logs, seed=1)]
                print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
