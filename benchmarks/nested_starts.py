"""Nested co-design from ten random first designs: the known optimum every time, and how long it takes.

``python benchmarks/nested_starts.py [--inner lqr|mpc] [--starts 10]`` prints a row for the illustrative example from
two initial states and for the suspension: the best design, how far the furthest one is from it in parts of the box, and
the longest time. Known: p about 2.45, p = 3 and the corner (1e4, 3000).
"""

from __future__ import annotations

import argparse

import torch

from ccdtools import Nested, load_study, multi_start


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inner", default="lqr")
    parser.add_argument("--starts", type=int, default=10)
    parser.add_argument("--problems", default="0,1,2")
    given = parser.parse_args()
    torch.set_num_threads(1)
    problems = [
        ("illustrative, from (−2, −2)", load_study("illustrative").started(x0=[-2.0, -2.0])),
        ("illustrative, from (−3.5, −2)", load_study("illustrative")),
        ("suspension", load_study("suspension")),
    ]
    print("| problem | inner | best design | furthest from it, of the box | returns | longest time |")
    print("| --- | --- | --- | --- | --- | --- |")
    for i in map(int, given.problems.split(",")):
        name, study = problems[i]
        found = multi_start(study.problem(), given.starts, method=Nested(given.inner))
        returns = [row["return"] for row in found.table()]
        longest = max(result.seconds for result in found)
        print(f"| {name} | {given.inner} | {study.plant.design.describe(found.best.design)} | {found.spread:.2%} | "
              f"{min(returns):.4f} to {max(returns):.4f} | {longest:.1f} s |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
