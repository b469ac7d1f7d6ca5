"""Online MPC under an adversary: random plants in any units, oracles beside them.

    python benchmarks/adversarial_mpc.py [plants] [crossed] [units] [outputs] [laws] [--count 400] [--seed 0]

Every plan is checked for what its fields promise (inputs in U and within the rate limit, states of the model,
violation and cost of the states returned), its status by a linear program in states and inputs (HiGHS), its optimality
by the same QP with the states kept (Clarabel), and where the plant runs away by the adjoint of the cost. `crossed` are
the plants with a cross weight. `outputs` weighs outputs y = Cx + Du with references, previews, blocks, rate limits and
soft limits, in random units, by all solvers, `laws` the explicit law; their oracle knows the outputs alone.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import numpy as np  # noqa: E402
from mpc_problems import REFUSED, crossed_case, in_other_units, random_case  # noqa: E402
from plan_oracles import promises, verdict  # noqa: E402
from weighted_outputs import law_faults, output_case, output_faults  # noqa: E402

from mpc import LinearMPC  # noqa: E402


def printed(title, *counters):
    """Print the head of a table, and a row for each count."""
    print(f"\n| {title} | count |\n|---|---|")
    for counter in counters:
        for name, number in counter.items():
            print(f"| {name} | {number} |")


def bench_crossed(count, seed):
    """Random unstable plants over long horizons, with a cross weight."""
    bench_plants(count, seed, crossed_case)


def bench_plants(count, seed, case=random_case):
    """Random unstable plants over long horizons."""
    statuses, faults, solvers, times = Counter(), Counter(), Counter(), []
    cases = 0
    for i in range(count):
        rng = np.random.default_rng([seed, i])
        data, x, signals = case(rng)
        try:
            controller = LinearMPC(**data)
        except REFUSED as error:
            faults[f"refused: {type(error).__name__}"] += 1
            continue
        cases += 1
        start = time.perf_counter()
        plan = controller.solve(x, **signals)
        times.append(time.perf_counter() - start)
        statuses[plan.status.name] += 1
        solvers[plan.solver] += 1
        for fault in promises(controller, plan, x, signals) + verdict(controller, plan, x, signals):
            faults[fault] += 1
            print(f"  case {i}: {fault}; {plan!r}; n={controller.nx} m={controller.nu} soft={controller.soft} "
                  f"rate={controller.rate_limit is not None} X={controller.X is not None} "
                  f"T={controller.terminal_set is not None} "
                  f"radius={np.abs(np.linalg.eigvals(controller.A)).max():.2f}", flush=True)  # fmt: skip
    by = {f"by {solver}": number for solver, number in solvers.items()}
    printed(f"{cases} random plants, spectral radius 1.0 to 1.5, N = 5 to 100", statuses, by, faults)
    print(f"| median, largest time of a first solve [ms] | {1e3 * np.median(times):.1f}, {1e3 * max(times):.0f} |")


def bench_units(count, seed):
    """The same problems in units 1e-8 … 1e8 of states and inputs and 1e-12 … 1e12 of the cost."""
    faults, compared = Counter(), 0
    for i in range(count):
        rng = np.random.default_rng([seed, 1, i])
        data, x, signals = random_case(rng)
        if rng.random() < 0.7:
            data["horizon"] = int(rng.integers(3, 16))
        x = x * 10.0 ** rng.uniform(0, 1)
        units = (
            10.0 ** rng.uniform(-8, 8, len(x)),
            10.0 ** rng.uniform(-8, 8, data["B"].shape[1]),
            10.0 ** rng.uniform(-12, 12),
        )
        try:
            base = LinearMPC(**data)
        except REFUSED:
            continue
        plan = base.solve(x, **signals)
        other_data, other_x, other_signals = in_other_units(data, x, signals, units)
        compared += 1
        try:
            other = LinearMPC(**other_data).solve(other_x, **other_signals)
        except REFUSED as error:
            faults[f"refused in other units: {error}"] += 1
            continue
        gap = np.abs(other.inputs[0] * units[1] - plan.inputs[0]) / base.input_extent
        for fault, found in (("status", other.status is not plan.status), ("first input", gap.max() > 1e-4)):
            if found:
                faults[fault] += 1
                print(f"  case {i}: {fault}; {plan!r} and {other!r}; gap {gap.max():.1e} soft={base.soft}", flush=True)
    printed(f"{compared} random problems in other units", faults)


def bench_outputs(count, seed):
    """Weighted outputs with feedthrough, in units of 1e-4 … 1e4, by every solver."""
    faults, statuses = Counter(), Counter()
    for i in range(count):
        rng = np.random.default_rng([seed, 2, i])
        data, outputs, x, signals = output_case(rng)
        units = (10.0 ** rng.uniform(-4, 4, len(x)), 10.0 ** rng.uniform(-4, 4, data["B"].shape[1]),
                 10.0 ** rng.uniform(-4, 4))  # fmt: skip
        for solver in ("daqp", "osqp", "clarabel"):
            try:
                status, wrong = output_faults(data, outputs, x, signals, units, solver)
            except REFUSED as error:
                faults[f"refused: {str(error)[:90]}"] += 1
                continue
            statuses[f"{solver} {status.name}"] += 1
            for fault in wrong:
                faults[f"{solver}: {fault}"] += 1
                print(f"  case {i}: {solver}: {fault}; n={len(x)} m={len(units[1])} N={data['horizon']} "
                      f"{sorted(data.keys() - {'A', 'B', 'Q', 'R', 'S', 'U', 'horizon'})} {sorted(signals)}",
                      flush=True)  # fmt: skip
    printed(f"{count} random problems with weighted outputs", statuses, faults)


def bench_laws(count, seed):
    """Explicit laws of weighted outputs, in units of 1e-4 … 1e4, against the plan of the oracle."""
    faults, compared = Counter(), 0
    for i in range(count):
        found = law_faults(np.random.default_rng([seed, 3, i]))
        if found is None:
            faults["refused"] += 1
            continue
        compared += found[0]
        for fault in found[1]:
            faults[fault] += 1
            print(f"  case {i}: {fault}", flush=True)
    printed(f"{count} explicit laws of weighted outputs, {compared} states", faults)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("parts", nargs="*", default=["plants"])
    parser.add_argument("--count", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    for part in options.parts:
        globals()[f"bench_{part}"](options.count, options.seed)
