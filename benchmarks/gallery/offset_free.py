"""MPC by the package's fit beside offset-free MPC: ``python -m gallery.offset_free``, from the folder ``benchmarks``.

Cases of `gallery.fitted`: the slide with dry friction, a slope and a weak actuator, and studies of the gallery, each at
the design of the model's optimum, which nobody moves. One log of the real plant under nominal MPC, ten runs of an
episode; `fit_plant` with what is stated to be unknown, or where that is not told `identified_change` (nothing is
stated), and MPC of what was found. Offset-free MPC knows no log: it estimates a constant disturbance on the way, its
gain the best of three on the real plant. Both are driven on the same fresh runs of the real plant, as is nominal MPC.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ccdtools import deploy, linear_mpc
from ccdtools.statistics import paired_difference
from ccdtools.twin import fit_plant, identified_change, updated_problem
from gallery.fitted import WIDE, Case, case
from mpc import OffsetFreeMPC

GAINS = (0.02, 0.1, 0.3)  # of the estimate; the best one on the real plant counts
LOGGED = 10  # runs


def laws(one: Case, seed: int) -> Iterator[tuple[str, str, Any]]:
    """Column, detail and controller of each that is compared."""
    study, p = one.study, one.best
    problem = study.problem()
    nominal = linear_mpc(problem, p)
    yield "nominal", "", nominal
    for gain in GAINS:
        C = np.zeros((0, problem.model.nx))
        yield "offset-free", f"gain {gain:g}", OffsetFreeMPC(nominal, C, gain=gain, reference=())
    w = study.real.disturbance.sample(LOGGED, problem.steps, np.random.default_rng(seed))
    log = deploy(study.real.plant, nominal, p, w, x0=study.real.x0, limit=problem.limit)
    fit = fit_plant(problem, log, plant=one.wide)
    stated = fit.status.name in ("SOLVED", "AT_BOUND")
    yield "by the fit", fit.status.name, linear_mpc(updated_problem(problem, fit), p) if stated else nominal
    changed = identified_change(problem, log)
    yield "nothing stated", "", linear_mpc(updated_problem(problem, changed), p)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row per run: return of nominal MPC, and gains over it and over offset-free MPC in per cent of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", default=["slide", *WIDE])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--runs", type=int, default=200)
    given = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    print("| plant | seed | nominal MPC | offset-free over it | fit over it | fit over offset-free | nothing stated "
          "over offset-free |\n|" + "---|" * 7)  # fmt: skip
    for name in given.cases:
        one, gains = case(name), []
        problem = one.study.problem()
        for seed in range(given.seeds):
            w = one.study.real.disturbance.sample(given.runs, problem.steps, np.random.default_rng(1000 + seed))
            best: dict[str, tuple[str, np.ndarray]] = {}
            for column, detail, law in laws(one, seed):
                run = deploy(one.study.real.plant, law, one.best, w, x0=one.study.real.x0, limit=problem.limit)
                values = run.returns(problem.objective)
                if column not in best or values.mean() > best[column][1].mean():
                    best[column] = detail, values
            size = abs(best["nominal"][1].mean()) / 100
            pairs = (("offset-free", "nominal"), ("by the fit", "nominal"), ("by the fit", "offset-free"),
                     ("nothing stated", "offset-free"))  # fmt: skip
            found = [paired_difference(best[a][1], best[b][1]) for a, b in pairs]
            gains.append([one.mean / size for one in found])
            cells = [f"{g.mean / size:+.2f} [{g.ci95[0] / size:+.2f}, {g.ci95[1] / size:+.2f}]" for g in found]
            details = f"{seed} ({best['offset-free'][0]}, {best['by the fit'][0]})"
            print(f"| {name} | {details} | {-size * 100:.3f} | {' | '.join(cells)} |", flush=True)
        ends = [f"{min(column):+.2f} to {max(column):+.2f}" for column in zip(*gains)]
        print(f"| {name} | all | | {' | '.join(ends)} |", flush=True)


if __name__ == "__main__":
    main()
