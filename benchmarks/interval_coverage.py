"""How often the 95 % interval of one run covers the mean over all: `mean_interval` on drives and on known processes.

``python benchmarks/interval_coverage.py`` drives the suspension 200 times 750 s with each generated driver, at the
start design, under LQR, no control, a tuned PID, and the LQR of other weights; the truth is the mean over the drives.
The model is the nominal one, whose returns are those of the real plant within 0.3 %; ``--real`` takes that (an hour).
``--processes`` takes series whose mean is known instead, 1000 each. A row says how many intervals were given, how many
of these cover, and how wide they are beside that of a known variance.
``--risks`` takes intervals of risks instead, of n independent runs beside two that are lost, beside the risk of 4e6
draws: how many samples have none (fewer than ten runs decide the risk), and how many of the other intervals cover.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator

import numpy as np
from scipy.signal import lfilter

from ccdtools import CVaR, LinearFeedback, Mean, MeanSpread, Scenario, WorstCase, load_study, saturated_lqr
from ccdtools.arrays import Array
from ccdtools.co_design.risk import Risk
from ccdtools.co_design.risk_intervals import summarise_in_risk
from ccdtools.comparison.pid_tuning import tuned_pid
from ccdtools.controllers import Passive
from ccdtools.controllers.controllers import Controller
from ccdtools.statistics import mean_interval
from ccdtools.vehicles import GeneratedRoad
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


def levels(length: int) -> Process:
    """Normal levels that hold for exactly so many samples, from a phase drawn at random."""

    def draw(runs: int, steps: int, rng: np.random.Generator) -> Array:
        number = (np.arange(steps) + rng.integers(0, length, (runs, 1))) // length
        return np.take_along_axis(rng.standard_normal((runs, steps // length + 2)), number, axis=1)

    return draw


def garch(runs: int, steps: int, rng: np.random.Generator) -> Array:
    """Squares of GARCH(1, 1) with α = 0.1 and β = 0.88, minus their mean 1: a cost whose size comes in clusters."""
    variance = np.ones(runs)
    found = np.zeros((runs, steps + 500))
    for k in range(steps + 500):
        found[:, k] = variance * rng.standard_normal(runs) ** 2
        variance = 0.02 + 0.1 * found[:, k] + 0.88 * variance
    return found[:, 500:] - 1


def process_rows(runs: int) -> Iterator[str]:
    """Rows of processes whose mean is zero."""
    processes = {f"AR(1), ρ = {rho}": autoregression(rho) for rho in (0.0, 0.5, 0.9, 0.99)}
    processes |= {f"squares of AR(1), ρ = {rho}": squares(rho) for rho in (0.5, 0.9, 0.99)}
    processes |= {f"regimes of {length} samples": regimes(length) for length in (20, 100)}
    processes |= {f"levels held for {length} samples": levels(length) for length in (50, 300)}
    processes["squares of GARCH(1, 1)"] = garch
    for name, process in processes.items():
        for steps in LENGTHS:
            yield row(name, process(runs, steps, np.random.default_rng(steps)), 0.0)


# ── risks of independent runs ──

LAWS = {
    "normal": lambda shape, rng: rng.standard_normal(shape) - 10,
    "skewed (lognormal, σ = 1)": lambda shape, rng: -np.exp(rng.standard_normal(shape)),
    "Student's t, 4 degrees": lambda shape, rng: rng.standard_t(4, shape) - 10,
    "mixture, 5 % ten lower": lambda shape, rng: (
        np.where(rng.random(shape) < 0.05, -20 + 3 * rng.standard_normal(shape), -10 + rng.standard_normal(shape))
    ),
}  # fmt: skip
APART = (0.0, 0.0, 0.2, 3.0)  # by how much the cases of a worst case lie higher: two are alike, one nearly so
RISKS: dict[str, tuple[Risk, Callable[[Array], float]]] = {
    "mean": (Mean(), lambda r: float(r.mean())),
    "mean − spread": (MeanSpread(1.0), lambda r: float(r.mean() - r.std())),
    "worst tenth": (CVaR(0.1), lambda r: float(np.partition(r, len(r) // 10)[: len(r) // 10].mean())),
    "worst 2 %": (CVaR(0.02), lambda r: float(np.partition(r, len(r) // 50)[: len(r) // 50].mean())),
    "worst of 4 cases": (WorstCase(cases=4), lambda r: float(r.mean())),
}
DRAWS = 4_000_000
LOST = 2  # runs, beside those that are kept


def risk_rows(samples: int) -> Iterator[str]:
    """Rows of every law, risk and number of runs: samples without an interval, and coverage by the others."""
    for law, draw in LAWS.items():
        big = draw(DRAWS, np.random.default_rng(0))
        for name, (risk, exact) in RISKS.items():
            for runs in (100, 1000):
                truth = exact(big)
                rng = np.random.default_rng(runs)
                shift = np.resize(APART, runs) if isinstance(risk, WorstCase) else 0.0
                found = []
                for _ in range(samples):
                    lost = np.arange(runs + LOST) >= runs
                    drawn = np.concatenate([draw(runs, rng) + shift, np.full(LOST, -1e8)])
                    found.append(summarise_in_risk(risk, drawn, lost))
                given = np.array([one.ci95 for one in found if np.isfinite(one.ci95).all()]).reshape(-1, 2)
                covers = f"{np.mean((given[:, 0] < truth) & (truth < given[:, 1])):>8.1%}" if len(given) else ""
                yield f"{f'{law}, {name}':46}{runs:>6}{1 - len(given) / samples:>8.1%}{covers}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--processes", action="store_true", help="series of known mean instead of drives")
    parser.add_argument("--real", action="store_true", help="drives of the real plant instead of the nominal model")
    parser.add_argument("--risks", action="store_true", help="risks of independent runs instead")
    parser.add_argument("--runs", type=int, default=None, help="drives (200), or series or samples (1000)")
    asked = parser.parse_args()
    print(f"{'':46}{'runs':>6}{'none':>8}{'covers':>8}" if asked.risks else HEADINGS, flush=True)
    of_known = risk_rows if asked.risks else process_rows
    known = asked.risks or asked.processes
    rows = of_known(asked.runs or 1000) if known else drive_rows(asked.runs or 200, real=asked.real)
    for line in rows:
        print(line, flush=True)
