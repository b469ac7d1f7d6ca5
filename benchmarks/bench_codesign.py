"""Every way to co-design on six problems: closed-loop returns on common scenarios, evaluations and time.

``python benchmarks/bench_codesign.py [PROBLEM ...] [--methods NAME,NAME] [--seeds 0,1,2] [--out FOLDER]`` prints a
table for each problem with what it says below, and keeps each as a CSV file as soon as it is finished. All methods run
with the first seed, the fast ones with the others too.

Required: methods whose optimum is the same in theory (nested LQR, and the searches of the same closed loop) within
0.5 %; what is learned never below nested LQR by more than 0.5 %; a problem whose best design is known
(`benchmarks/interior_design.py`, and dynamic programming for the illustrative example) with that design.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import interior_design
import numpy as np
import torch

from ccdtools import CoDesignProblem, DesignSpace, compare_methods, load_study

FAST = ("sequential", "nested Riccati", "nested LQR", "nested trajectory", "simultaneous", "CMA-ES")
ALL = (*FAST, "nested MPC", "simultaneous gain", "Bayesian search", "pathwise")
EQUAL_IN_THEORY = ("nested LQR", "CMA-ES", "Bayesian search")  # one closed loop, searched in three ways
SAME = 0.5  # per cent
FLYWHEEL = 2e4  # price per kg·m² of flywheel, in units of the return
WATER = 30.0  # price per cm² of tank
LENGTH, MASS = 20.0, 8.0  # price of a pole of one metre, of a cart of one kilogram; half as large costs twice as much

Start = tuple[CoDesignProblem, np.ndarray]


def study(name: str, x0: list[float] | None = None) -> Start:
    """The problem of a study, and its first design."""
    own = load_study(name)
    own = own if x0 is None else own.started(x0=x0)
    return own.problem(), own.p0


def interior() -> Start:
    """A quarter car whose springs, dampers and wheels away from a catalogue cost money."""
    problem = interior_design.problem()
    return problem, problem.design.centre


def servo() -> Start:
    """A servo whose gears have whole ratios, and whose flywheel costs money."""
    own = load_study("dc_servo")
    box = own.plant.design
    whole = DesignSpace(box.names, box.lower, box.upper, box.units, integer=["n"])
    objective = replace(own.objective, design_cost=lambda p: FLYWHEEL * p[1])
    return replace(own, plant=replace(own.plant, design=whole), objective=objective).problem(), own.p0


def tanks() -> Start:
    """Two tanks in centimetres, not linear, whose walls cost money."""
    own = load_study("two_tanks")
    priced = replace(own.objective, design_cost=lambda p: WATER * (p[0] + p[1]))
    return replace(own, objective=priced).problem(), own.p0


def pendulum() -> Start:
    """A pole on a cart, not linear, whose short poles and light carts are dear."""
    own = load_study("pendulum_on_cart")
    priced = replace(own.objective, design_cost=lambda p: LENGTH / p[0] + MASS / p[1])
    return replace(own, objective=priced).problem(), own.p0


PROBLEMS: dict[str, Callable[[], Start]] = {
    "illustrative, from (−2, −2)": lambda: study("illustrative", [-2.0, -2.0]),
    "illustrative, from (−3.5, −2)": lambda: study("illustrative", [-3.5, -2.0]),
    "suspension": lambda: study("suspension"),
    "interior quarter car": interior,
    "servo, whole gear ratio": servo,
    "pendulum on a cart": pendulum,
    "two tanks": tanks,
}  # fmt: skip


def check(comparison) -> list[str]:
    """What is not as required."""
    wrong = []
    for row in comparison:
        if row.difference is None:
            continue
        percent = comparison.percent(row.difference.mean)
        if row.name in EQUAL_IN_THEORY and abs(percent) > SAME:
            wrong.append(f"{row.name} is {percent:+.2f} % from {comparison.reference}, and should be equal")
        if row.name == "pathwise" and percent < -SAME:
            wrong.append(f"pathwise is {percent:+.2f} % below {comparison.reference}")
    return wrong


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("problems", nargs="*", help=f"parts of {', '.join(PROBLEMS)}")
    parser.add_argument("--methods", default=",".join(ALL))
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--out", type=Path, default=None)
    given = parser.parse_args()
    torch.set_num_threads(1)
    asked = given.methods.split(",")
    seeds = [int(seed) for seed in given.seeds.split(",")]
    for name, stated in PROBLEMS.items():
        if given.problems and not any(part in name for part in given.problems):
            continue
        problem, start = stated()
        for seed in seeds:
            methods = [one for one in asked if one in FAST or seed == seeds[0]]
            found = compare_methods(problem, methods, seed=seed, design=start)
            print(f"\n### {name}, seed {seed}\n\n{found.markdown()}\n", flush=True)
            print("\n".join(f"- {line}" for line in [*found.verdict, *check(found)]), flush=True)
            if given.out is not None:
                given.out.mkdir(parents=True, exist_ok=True)
                stem = "".join(c if c.isalnum() else "_" for c in f"{name} {seed}")
                found.to_csv(given.out / f"{stem}.csv")


if __name__ == "__main__":
    main()
