"""What half a second of road preview is worth to the active suspension, on the recorded road and the real plant.

    python benchmarks/road_preview.py [seed]

LQR, MPC and a co-designed policy, each with and without preview, on the same drive of 875 s; the policies are trained
on the nominal model under the noise that the case study assumes, never on the road.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import torch

from benchmarks.loop_targets import recorded_road
from ccdtools import CoDesignProblem, codesign, load_study
from ccdtools.co_design import CoDesignResult, expert_dataset, previewed_problem
from ccdtools.co_design.design_controllers import HORIZON, saturated_lqr
from ccdtools.controllers import Previewing
from ccdtools.limits import excursions
from ccdtools.simulation import simulate
from ccdtools.statistics import change_of_level
from learning import fit_actor_critic
from mpc import LinearMPC

STEPS = 10  # of 0.05 s
WINDOW = 500  # samples, 25 s: the drive in windows, whose gains are taken as independent for the interval


def main(seed: int = 0) -> None:
    """Print the table."""
    road = recorded_road()
    if road is None:
        print("The recorded road is not part of the project; set CCDTOOLS_DATA to its folder.")
        return
    torch.set_num_threads(1)
    study = load_study("suspension")
    plain = study.problem()
    ahead = previewed_problem(plain, STEPS)
    found = {"without": trained(plain, study.p0, seed), "with": trained(ahead, study.p0, seed)}
    w = np.asarray(road.signal)[None, : len(road.signal) // WINDOW * WINDOW]

    def driven(controller, design):
        """The run on the real plant."""
        return simulate(study.real.plant, controller, x0=study.real.x0, steps=w.shape[1], disturbance=w, design=design,
                        limit=plain.limit)  # fmt: skip

    def row(label, pair, designs):
        """One line: both returns, and their paired difference with its interval."""
        runs = [driven(controller, design) for controller, design in zip(pair, designs)]
        own, other = (run.rewards(study.objective) for run in reversed(runs))
        gain = change_of_level(*(series.reshape(-1, WINDOW) for series in (own - other, other)))
        size = 100 / abs(float(other.reshape(-1, WINDOW).sum(axis=1).mean()))
        low, high = (size * end for end in gain.ci95)
        out = [excursions(run.states, study.X) for run in runs]
        share, depth = ([f"{getattr(one, name).mean():.4f}" for one in out] for name in ("fraction", "peak"))
        print(f"{label:<32}{other.sum():>10.1f}{own.sum():>10.1f}{size * gain.mean:>+8.1f} %  [{low:+.1f}, {high:+.1f}]"
              f" %   {', '.join(share)}   {', '.join(depth)}", flush=True)  # fmt: skip

    designs = {"p0": study.p0, "design without": found["without"].design, "design with": found["with"].design}
    for name, result in found.items():
        print(f"{name} preview: {study.plant.design.describe(result.design)}, {result.status.name}", flush=True)
    print(f"\n{'':<32}{'without':>10}{'with':>10}{'gain':>8}    95 % interval    outside X        peak depth")
    for name, design in designs.items():
        laws = [saturated_lqr(problem, design) for problem in (plain, ahead)]
        row(f"LQR, {name}", (laws[0], Previewing(laws[1], STEPS)), (design, design))
        laws = [mpc(problem, design) for problem in (plain, ahead)]
        row(f"MPC, {name}", (laws[0], Previewing(laws[1], STEPS)), (design, design))
    each = [found[name].design for name in ("without", "with")]
    laws = [mpc(problem, design) for problem, design in zip((plain, ahead), each)]
    row("MPC, each at its own design", (laws[0], Previewing(laws[1], STEPS)), each)
    laws = [found[name].policy for name in ("without", "with")]
    row("learned, each at its own design", (laws[0], Previewing(laws[1], STEPS)), each)


def trained(problem: CoDesignProblem, design, seed: int) -> CoDesignResult:
    """Expert data, a clone of it, and the co-design from it."""
    begun = time.perf_counter()
    rng = np.random.default_rng(seed)
    data = expert_dataset(problem, samples=1000, sets="lqr", rng=rng)
    agent = fit_actor_critic(
        data.inputs, data.actions, data.values, action_bounds=problem.input_bounds,
        input_bounds=problem.observation_bounds, rng=rng,
    )  # fmt: skip
    result = codesign(problem, agent=agent, design=design, rng=rng)
    print(f"{problem.model.nx} states: {time.perf_counter() - begun:.0f} s", flush=True)
    return result


def mpc(problem: CoDesignProblem, design) -> LinearMPC:
    """The MPC of a comparison, at a design."""
    A, B, _ = problem.model.matrices(design)
    return LinearMPC(A, B, Q=problem.objective.Q, R=problem.objective.R, horizon=HORIZON, X=problem.X, U=problem.U)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
