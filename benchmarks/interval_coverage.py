"""How often the 95 % interval of one run covers the mean over all: `mean_interval` on drives and on known processes.

``python benchmarks/interval_coverage.py`` drives the suspension 200 times 750 s with each generated driver, at the
start design, under LQR, no control, a tuned PID, and the LQR of other weights; the truth is the mean over the drives.
The model is the nominal one, whose returns are those of the real plant within 0.3 %; ``--real`` takes that (an hour).
``--processes`` takes series whose mean is known instead, 1000 each. A row says how many intervals were given, how many
of these cover, and how wide they are beside that of a known variance.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator

import numpy as np
from scipy.signal import lfilter

from ccdtools import GeneratedRoad, LinearFeedback, Passive, Scenario, load_study, saturated_lqr
from ccdtools.arrays import Array
from ccdtools.comparison.pid_tuning import tuned_pid
from ccdtools.controllers.controllers import Controller
from ccdtools.statistics import mean_interval
from mpc import lqr

STEPS = 15_000  # of a drive
AT_ONCE = 100  # drives simulated together
LENGTHS = (1000, 5000, 15_000)
HEADINGS = f"{'':34}{'steps':>7}{'given':>8}{'covers':>8}{'width':>7}"

Process = Callable[[int, int, np.random.Generator], Array]


def row(name: str, series: Array, truth: float) -> str:
    """The row of one process: series (n, T), and the mean that their intervals should cover."""
    intervals = [mean_interval(one) for one in series]
    ends = np.array([one.ci95 for one in intervals if one.reliable]).reshape(-1, 2)
    given = f"{name:34}{series.shape[1]:>7}{len(ends) / len(series):>8.1%}"
    if len(ends) == 0:
        return given
    covers = np.mean((ends[:, 0] < truth) & (truth < ends[:, 1]))
    width = np.median(ends[:, 1] - ends[:, 0]) / (2 * 1.96 * series.mean(axis=1).std())
    return f"{given}{covers:>8.1%}{width:>7.2f}"


# ── drives ──


def controllers(drives: int) -> dict[str, Controller]:
    """Those that drive: the last is an LQR that differs from LQR as little as a learned policy may."""
    problem = load_study("suspension").problem()
    design = load_study("suspension").p0
    A, B, _ = problem.model.matrices(design)
    Q = problem.objective.Q.copy()
    Q[3, 3] *= 1.2
    K, _ = lqr(A, B, Q=Q, R=1.3 * problem.objective.R)
    return {
        "LQR": saturated_lqr(problem, design),
        "passive": Passive(1),
        "PID": tuned_pid(problem, design, rng=np.random.default_rng(drives)),
        "LQR of other weights": LinearFeedback(K, *problem.input_bounds),
    }


def rewards(controller: Controller, w: Array, *, real: bool) -> Array:
    """Rewards of the suspension under disturbances (n, T, 1), from rest."""
    study = load_study("suspension")
    plant = study.real.plant if real else study.model
    found = []
    for k in range(0, len(w), AT_ONCE):
        part = w[k : k + AT_ONCE]
        run = Scenario(plant, np.tile(study.real.x0, (len(part), 1)), part).run(controller, design=study.p0)
        found.append(run.rewards(study.objective))
    return np.concatenate(found)


def drive_rows(drives: int, *, real: bool) -> Iterator[str]:
    """Rows of both drivers: mean return of every controller, and its paired difference to LQR."""
    for driver in ("mild", "aggressive"):
        w = GeneratedRoad(driver).sample(drives, STEPS, np.random.default_rng(7))
        reference = np.zeros(0)
        for name, controller in controllers(drives).items():
            own = rewards(controller, w, real=real)
            yield row(f"{driver}, {name}", own, float(own.mean()))
            if name == "LQR":
                reference = own
            else:
                yield row(f"{driver}, {name} − LQR", own - reference, float((own - reference).mean()))


# ── processes of known mean ──


def autoregression(rho: float) -> Process:
    """x⁺ = ρ x + e, stationary, of variance 1."""

    def draw(runs: int, steps: int, rng: np.random.Generator) -> Array:
        noise = np.sqrt(1 - rho**2) * rng.standard_normal((runs, steps))
        noise[:, 0] /= np.sqrt(1 - rho**2)
        return np.asarray(lfilter([1.0], [1.0, -rho], noise, axis=1))

    return draw


def squares(rho: float) -> Process:
    """A cost: the square of an autoregression, minus 1."""
    return lambda runs, steps, rng: autoregression(rho)(runs, steps, rng) ** 2 - 1


def regimes(length: float) -> Process:
    """White noise about a level of ±1, drawn anew once in `length` samples on average."""

    def draw(runs: int, steps: int, rng: np.random.Generator) -> Array:
        renewed = rng.random((runs, steps)) < 1 / length
        renewed[:, 0] = True
        latest = np.maximum.accumulate(np.where(renewed, np.arange(steps), 0), axis=1)
        level = rng.choice([-1.0, 1.0], size=(runs, steps))
        return np.take_along_axis(level, latest, axis=1) + rng.standard_normal((runs, steps))

    return draw


def process_rows(runs: int) -> Iterator[str]:
    """Rows of processes whose mean is zero."""
    processes = {f"AR(1), ρ = {rho}": autoregression(rho) for rho in (0.0, 0.5, 0.9, 0.99)}
    processes |= {f"squares of AR(1), ρ = {rho}": squares(rho) for rho in (0.5, 0.9, 0.99)}
    processes |= {f"regimes of {length} samples": regimes(length) for length in (20, 100)}
    for name, process in processes.items():
        for steps in LENGTHS:
            yield row(name, process(runs, steps, np.random.default_rng(steps)), 0.0)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--processes", action="store_true", help="series of known mean instead of drives")
    parser.add_argument("--real", action="store_true", help="drives of the real plant instead of the nominal model")
    parser.add_argument("--runs", type=int, default=None, help="drives (200) or series (1000)")
    asked = parser.parse_args()
    print(HEADINGS, flush=True)
    rows = process_rows(asked.runs or 1000) if asked.processes else drive_rows(asked.runs or 200, real=asked.real)
    for line in rows:
        print(line, flush=True)
