"""The semi-active car for two drivers: its learned policy beside laws of the field at designs of their own.

    python benchmarks/flagship.py RUN [--picture FILE]

RUN is the folder of `ccdtools run semi_active_damper`. Each law is tuned at twelve designs on the nominal model, and
shown at the best of them and at the design of the policy. All are simulated on the real plant, on the same fresh roads;
intervals are of paired differences over the drives, in % of the law's cost.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from ccdtools import Scenario
from ccdtools.controllers.history import load_policy
from ccdtools.figure_style import styled
from ccdtools.studies import load_study
from ccdtools.studies.cases.semi_active_damper import REAL

SPRINGS, DAMPERS, DRIVES, STEPS, SHOWN = (1.5e4, 2e4, 2.5e4, 3e4), (1.5e3, 2e3, 3e3), 400, 200, 200


@dataclass(frozen=True)
class Constant:
    """Damper that stays as it is."""

    u: float

    def __call__(self, x):
        """Inputs (n, 1)."""
        return np.full((len(x), 1), self.u)


def best_constant(problem, design):
    """Best of nine constant dampers at a design."""
    scenario = nominal(problem)
    return max(map(Constant, np.linspace(-1, 1, 9)), key=lambda law: mean(problem, scenario, law, design))


def nominal(problem):
    """Scenario on the nominal model that designs of laws are chosen on."""
    x0, w = problem.scenarios.sample(64, problem.steps, np.random.default_rng(5))
    return Scenario(problem.model, x0, w)


def mean(problem, scenario, law, design):
    """Mean return of a law."""
    return float(scenario.run(law, design=design).returns(problem.objective).mean())


def own_design(problem, make):
    """Best of the designs for a law tuned at each."""
    scenario = nominal(problem)
    designs = [np.array(design) for design in product(SPRINGS, DAMPERS)]
    return max(designs, key=lambda design: mean(problem, scenario, make(problem, design), design))


def interval(parts):
    """Mean and half width of its 95 % interval."""
    return parts.mean(), 1.96 * parts.std(ddof=1) / len(parts) ** 0.5


def draw(gains, runs, target):
    """Write the picture: gains of the policy beside each law, and one piece of road."""
    with styled():
        figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.6), layout="constrained")
        for i, (middle, half) in enumerate(gains.values()):
            left.errorbar(middle, i, xerr=half, fmt="o", capsize=3, color="#0072B2")
        left.set_yticks(range(len(gains)), [f"{name}" for name in gains])
        left.axvline(0, color="k", lw=0.5)
        left.set(xlabel="less cost with the learned policy [%]", title="Real car, fresh roads")
        time = REAL.dt * np.arange(SHOWN + 1)
        for (name, run), colour in zip(runs.items(), ("#999999", "#d95f02")):
            right.plot(time, run.states[0, -SHOWN - 1 :, 4], color=colour, lw=1.2, label=name)
        right.set(xlabel="time [s]", ylabel="felt acceleration [m/s²]", title="Two seconds of one road")
        right.legend(framealpha=0.9)
        figure.savefig(target, dpi=110)


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--picture", type=Path)
    asked = parser.parse_args()
    study = load_study("semi_active_damper")
    problem = study.problem()
    policy = load_policy(asked.run / "policy.safetensors")
    laws = {"best constant damper": best_constant, **study.laws}
    shown = {}
    for name, make in laws.items():
        own = own_design(problem, make)
        shown[f"{name}, own design"] = make(problem, own), own
        shown[name] = make(problem, policy.design), policy.design
    shown["learned"] = policy, policy.design
    kinds = study.real.fresh
    print("| law | design |", " | ".join(f"{kind}: cost, the policy costs less by" for kind in kinds), "|")
    print("|---|---|", "---|" * len(kinds), sep="")
    rows, runs = {}, {}
    for kind, drive in kinds.items():
        w = drive.sample(DRIVES, STEPS, np.random.default_rng(7))
        scenario = Scenario(REAL, np.zeros((DRIVES, REAL.nx)), w)
        trajectories = {name: scenario.run(law, design=p) for name, (law, p) in shown.items()}
        costs = {name: -run.returns(problem.objective) / STEPS for name, run in trajectories.items()}
        rows[kind] = {n: (c.mean(), *interval(100 * (c - costs["learned"]) / c.mean())) for n, c in costs.items()}
        runs[kind] = trajectories
    for name, (_, p) in shown.items():
        cells = [f"{cost:.2f}" + f", {mean:.1f} ± {half:.1f} %" * (name != "learned")
                 for cost, mean, half in (rows[kind][name] for kind in kinds)]  # fmt: skip
        print(f"| {name} | {p[0]:.0f}, {p[1]:.0f} | {' | '.join(cells)} |")
    if asked.picture:
        first = next(iter(kinds))
        gains = {name: row[1:] for name, row in rows[first].items() if name.endswith("own design")}
        chosen = {"skyhook": runs[first]["skyhook, own design"], "learned": runs[first]["learned"]}
        draw(gains, chosen, asked.picture)


if __name__ == "__main__":
    main()
