"""Every controller on the same disturbances and initial states."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array
from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.controllers.controllers import Controller, LinearFeedback, Passive
from ccdtools.controllers.pid_tuning import tuned_pid
from ccdtools.exceptions import InputError
from ccdtools.simulation import Simulable, Trajectory, simulate
from ccdtools.statistics import PairedDifference, Summary, paired_difference, summarise
from invariant_sets import Polytope
from mpc import LinearMPC, lqr

BLOCK = 100  # samples per replicate of a single long run
MPC_RUNS = 100
REFERENCE = "LQR"


@dataclass(frozen=True, eq=False)
class Scenario:
    """A plant with initial states (n, nx) and disturbances (n, T, nw): what every controller meets alike."""

    plant: Simulable
    x0: Array
    disturbance: Array


@dataclass(frozen=True, eq=False)
class Score:
    """One controller on one scenario.

    Attributes
    ----------
    controller : str
    summary : Summary
        Of the returns of the runs that did not diverge. For a single long run the replicates are its blocks of
        100 samples, scaled to the whole: `mean` is the return of the run, `std` that of the scaled blocks, `n` their
        number, and `ci95` the interval of the whole if blocks are independent.
    paired_to_lqr : PairedDifference
        On the runs where neither diverged.
    diverged : float
        Fraction of runs.
    violations : float
        Fraction of the states outside X.
    step_time : float
        Median time of one call with one state [s].
    """

    controller: str
    summary: Summary
    paired_to_lqr: PairedDifference
    diverged: float
    violations: float
    step_time: float


def baselines(problem: CoDesignProblem, design: ArrayLike, *, rng: np.random.Generator) -> dict[str, Controller]:
    """Passive, LQR, tuned PID and online MPC (horizon 20) for the nominal model at one design."""
    A, B, _ = problem.model.matrices(design)
    Q, R = problem.objective.Q, problem.objective.R
    return {
        "passive": Passive(problem.model.nu),
        REFERENCE: LinearFeedback(lqr(A, B, Q=Q, R=R)[0], *problem.input_bounds),
        "PID": tuned_pid(problem, design, rng=rng),
        "MPC": LinearMPC(A, B, Q=Q, R=R, horizon=20, X=problem.X, U=problem.U),
    }


def compare(
    controllers: Mapping[str, Controller],
    scenario: Scenario,
    *,
    design: ArrayLike,
    objective: QuadraticObjective,
    X: Polytope,
    limit: ArrayLike | None = None,
    few: Mapping[str, int] | None = None,
) -> list[Score]:
    """Scores of all controllers on one scenario, paired to the one named LQR.

    Parameters
    ----------
    controllers : mapping of name to controller
        "LQR" among them.
    few : mapping of name to int, optional
        Controllers that see only the first so many runs; MPC 100 by default.
    """
    if REFERENCE not in controllers:
        raise InputError(f"controllers: got {sorted(controllers)}, expected {REFERENCE!r} among them.")
    few = {"MPC": MPC_RUNS} if few is None else few
    reference = _run(controllers[REFERENCE], scenario, design, limit, len(scenario.x0))
    rows = []
    for name, controller in controllers.items():
        n = min(few.get(name, len(scenario.x0)), len(scenario.x0))
        run = reference if name == REFERENCE else _run(controller, scenario, design, limit, n)
        rows.append(_score(name, controller, run, reference, objective, X))
    return rows


def _run(controller: Controller, scenario: Scenario, design, limit, n: int) -> Trajectory:
    w = scenario.disturbance[:n]
    return simulate(
        scenario.plant, controller, x0=scenario.x0[:n], steps=w.shape[1], disturbance=w, design=design, limit=limit
    )


def _score(name, controller, run: Trajectory, reference: Trajectory, objective, X: Polytope) -> Score:
    n = len(run.states)
    kept = ~(run.diverged | reference.diverged[:n])
    own, other = run.rewards(objective), reference.rewards(objective)[:n]
    visited = run.states[~run.diverged][:, 1:].reshape(-1, run.states.shape[2])
    return Score(
        controller=name,
        summary=summarise(replicates(own[~run.diverged], n)),
        paired_to_lqr=paired_difference(replicates(own[kept], n), replicates(other[kept], n)),
        diverged=float(run.diverged.mean()),
        violations=float(1 - X.contains(visited).mean()) if len(visited) else float("nan"),
        step_time=step_time(controller, run.states[0, 0]),
    )


def replicates(rewards: Array, runs: int) -> Array:
    """Independent returns from rewards (n, T): one per run, or the blocks of a single run.

    The N block sums b_i of a single run become N b_i: their mean is the return of the run, and the standard error
    of that mean is the standard deviation of a total of N independent blocks.
    """
    if runs > 1 or len(rewards) == 0 or rewards.shape[1] < 2 * BLOCK:
        return rewards.sum(axis=1)
    edges = np.arange(0, rewards.shape[1] - BLOCK + 1, BLOCK)
    blocks = np.add.reduceat(rewards[0], edges)
    return blocks.sum() + len(blocks) * (blocks - blocks.mean())


def step_time(controller: Controller, x: Array, *, calls: int = 50) -> float:
    """Median time of ``controller(x)`` for one state (nx,) [s]."""
    reset = getattr(controller, "reset", None)
    times = []
    for _ in range(calls):
        start = time.perf_counter()
        controller(x)
        times.append(time.perf_counter() - start)
    if reset is not None:
        reset(1)
    return float(np.median(times))
