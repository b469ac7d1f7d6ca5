"""Parameter and moving-horizon estimation beside published optima, other programs and simulated truth.

`python benchmarks/estimation_statements.py [logs]`: 200 simulated logs by default.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "cases"))

import numpy as np
from estimation_problems import (
    LOTKA_VOLTERRA,
    PUBLISHED,
    kalman_difference,
    lotka_volterra_log,
    lotka_volterra_with_product,
)

from mpc.optimal_control.estimation import estimate_parameters


def published() -> None:
    """Print estimates beside published ones."""
    print("| problem | squared residuals | published | parameters | apart | iterations | s | status |")
    print("|---|---|---|---|---|---|---|---|")
    for name, case in PUBLISHED.items():
        began = time.perf_counter()
        found = estimate_parameters(case.experiment, case.dynamics, case.output, **case.options)
        seconds = time.perf_counter() - began
        apart = np.abs(found.p / case.p - 1).max()
        values = ", ".join(f"{value:.5g}" for value in found.p)
        print(
            f"| {name} | {found.residual_variance * found.degrees:.8g} | {case.residuals} | {values} | {apart:.0e} "
            f"| {found.solution.iterations} | {seconds:.2f} | {found.status.name} |"
        )


def coverage(logs: int) -> None:
    """Print how many 95 % intervals contain the truth, of all parameters."""
    print("\n| noise | logs | SOLVED | intervals with the truth, each parameter | s each |")
    print("|---|---|---|---|---|")
    for label, noise in (("given", [1.0, 1.0]), ("estimated", None)):
        inside, solved, began = [], 0, time.perf_counter()
        for seed in range(logs):
            found = estimate_parameters(lotka_volterra_log(seed), **LOTKA_VOLTERRA.statement, noise=noise)
            low, high = found.intervals().T
            inside.append((low <= LOTKA_VOLTERRA.p) & (LOTKA_VOLTERRA.p <= high))
            solved += found.solved
        shares = ", ".join(f"{100 * share:.1f} %" for share in np.mean(inside, axis=0))
        print(f"| {label} | {logs} | {solved} | {shares} | {(time.perf_counter() - began) / logs:.2f} |")


def pairs(logs: int) -> None:
    """Print how often a product of two parameters is named, and nothing else."""
    named = 0
    for seed in range(logs):
        found = estimate_parameters(lotka_volterra_log(seed), **lotka_volterra_with_product(), noise=[1.0, 1.0])
        named += len(found.open) == 1 and set(found.open[0]) == {"p2", "p5"}
    print(f"\nA product of two parameters: the pair and nothing else is named in {named} of {logs} logs.")


def kalman() -> None:
    """Print the largest difference from the Kalman filter on linear Gaussian plants."""
    print("\n| linear Gaussian plants | samples each | window | largest difference, in deviations | ms a sample |")
    print("|---|---|---|---|---|")
    for window in (2, 10, 20):
        began = time.perf_counter()
        apart = max(kalman_difference(seed, window) for seed in range(20))
        milliseconds = 1e3 * (time.perf_counter() - began) / (20 * 60)
        print(f"| 20 | 60 | {window} | {apart:.0e} | {milliseconds:.1f} |")


def main() -> None:
    """Print the tables."""
    logs = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    published()
    coverage(logs)
    pairs(logs)
    kalman()


if __name__ == "__main__":
    main()
