"""Random mp-QPs made hard: other units, rows that say nothing, dependent rows, equalities; against the online QP.

    python benchmarks/mpqp_adversary.py [problems of each kind [first seed]]

A problem counts as wrong where its partition is not complete, the law differs from the online QP by more than 1e-6, a
feasible parameter lies in no region, an infeasible one in a region, over 1 % of the parameters in two, or where the
number of regions differs from that of the same problem in its plain form.

Rows that are parallel or opposite but for 1e-6 may leave a law inaccurate. Such a problem counts as wrong where its
partition calls itself complete, or infeasible, though a linear program finds a parameter feasible that lies in no
region: with a slack of 1e-5 in every row, and variables of at most a thousand.
"""

from __future__ import annotations

import os
import sys
import time
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "cases")]

import numpy as np  # noqa: E402
from random_problems import closing_slab, nearly_parallel_rows, problem_of  # noqa: E402
from scipy.optimize import linprog  # noqa: E402

from invariant_sets import Polytope  # noqa: E402
from mpc import InputError, MPQPStatus, solve_mpqp  # noqa: E402
from mpc.dense_qp import DenseQP  # noqa: E402

STATES = 400  # random parameters of each comparison
NEXT_TO_NOTHING = 1e-4  # of the typical bound: z that are smaller are judged as if they were so large


def plain(rng):
    """A random problem with a box on z, and the half widths of its parameters."""
    nt, nz = int(rng.integers(1, 5)), int(rng.integers(1, 5))
    m = int(rng.integers(0, 10))
    L = rng.normal(size=(nz, nz))
    G = np.vstack([np.eye(nz), -np.eye(nz), rng.normal(size=(m, nz))])
    S = np.vstack([np.zeros((2 * nz, nt)), rng.normal(size=(m, nt))])
    w = np.concatenate([np.ones(2 * nz), rng.uniform(0.1, 2.0, size=m)])
    H = L @ L.T + 0.1 * np.eye(nz)
    return problem_of(H, rng.normal(size=(nz, nt)), rng.normal(size=nz), G, w, S), np.ones(nt)


def in_units(rng, problem, half):
    """The same problem with parameters, variables, rows and cost in other units."""
    st, sz = 10.0 ** rng.uniform(-8, 8, problem.nt), 10.0 ** rng.uniform(-8, 8, problem.nz)
    cost, rows = 10.0 ** rng.uniform(-12, 12), 10.0 ** rng.uniform(-6, 6, problem.m)
    changed = problem_of(
        cost * problem.H / np.outer(sz, sz), cost * problem.F / np.outer(sz, st), cost * problem.f / sz,
        rows[:, None] * problem.G / sz, rows * problem.w, rows[:, None] * problem.S / st,
    )  # fmt: skip
    return changed, half * st


def with_rows(rng, problem, half):
    """Rows shuffled, with copies, far rows, and rows that others imply."""
    extra = [np.eye(problem.m)]
    for _ in range(4):
        mix = np.zeros(problem.m)
        mix[rng.choice(problem.m, size=min(3, problem.m), replace=False)] = rng.uniform(0.1, 2.0, min(3, problem.m))
        extra.append(mix[None])
    extra.append(np.eye(problem.m)[rng.integers(0, problem.m, 3)] * rng.uniform(0.1, 10))
    mixed = np.vstack(extra)
    G, w, S = mixed @ problem.G, mixed @ problem.w, mixed @ problem.S
    G, S = np.vstack([G, rng.normal(size=(2, problem.nz))]), np.vstack([S, rng.normal(size=(2, problem.nt))])
    w = np.append(w, 10.0 ** rng.uniform(6, 15, 2))
    order = rng.permutation(len(w))
    return problem_of(problem.H, problem.F, problem.f, G[order], w[order], S[order]), half


def with_dependent_rows(rng, problem, half):
    """Pyramids: groups of rows that meet in one point of z for every parameter."""
    apex, tilt = rng.uniform(-0.3, 0.3, problem.nz), rng.normal(size=(problem.nz, problem.nt)) * 0.2
    normals = rng.normal(size=(problem.nz + 2, problem.nz))
    normals *= np.sign(normals @ rng.normal(size=problem.nz))[:, None]
    G, w = np.vstack([problem.G, normals]), np.concatenate([problem.w, normals @ apex])
    return problem_of(problem.H, problem.F, problem.f, G, w, np.vstack([problem.S, normals @ tilt])), half


def with_equality(rng, problem, half):
    """One equality as two inequalities in different units."""
    g, s, bound = rng.normal(size=(1, problem.nz)), 0.1 * rng.normal(size=(1, problem.nt)), 0.1 * rng.normal()
    a, b = 10.0 ** rng.uniform(-3, 3, 2)
    G, S = np.vstack([problem.G, a * g, -b * g]), np.vstack([problem.S, a * s, -b * s])
    return problem_of(problem.H, problem.F, problem.f, G, np.append(problem.w, [a * bound, -b * bound]), S), half


def with_odd_bounds(rng, problem, half):
    """Lower bounds that are zero, zero but for rounding, or tiny; every second time with the least z as the cost."""
    w = problem.w.copy()
    odd = np.flatnonzero(rng.random(problem.nz) < 0.6)
    w[problem.nz + odd] = rng.choice([0.0, 0.1 + 0.2 - 0.3, 10.0 ** rng.uniform(-12, -2)], len(odd))
    F, f = (rng.integers(2) * cost for cost in (problem.F, problem.f))
    return problem_of(problem.H, F, f, problem.G, w, problem.S), half


def with_spread_weights(rng, problem, half):
    """Weights of the variables up to four powers of ten apart."""
    d = 10.0 ** rng.uniform(-1, 1, problem.nz)
    H = problem.H * np.outer(d, d)
    return problem_of(H, problem.F * d[:, None], problem.f * d, problem.G, problem.w, problem.S), half


KINDS = {
    "plain": (lambda rng, problem, half: (problem, half), True), "other units": (in_units, True),
    "rows that say nothing": (with_rows, True), "dependent rows": (with_dependent_rows, False),
    "an equality": (with_equality, False),
    "dependent rows in other units": (lambda rng, *p: in_units(rng, *with_dependent_rows(rng, *p)), False),
    "odd bounds": (with_odd_bounds, False),
    "odd bounds in other units": (lambda rng, *p: in_units(rng, *with_odd_bounds(rng, *p)), False),
    "spread weights": (with_spread_weights, False),
}  # fmt: skip


def judge(problem, half, regions, states=STATES):
    """What is wrong with the partition, in a word; "" where nothing is."""
    theta_set = Polytope.from_bounds(-half, half)
    partition = solve_mpqp(problem, theta_set, time_limit=20.0)
    online = DenseQP(problem.H, problem.G)
    theta = half * np.random.default_rng(0).uniform(-1, 1, size=(states, problem.nt))
    results = [online.solve(*problem.at(t)) for t in theta]
    feasible = np.array([not r.infeasible for r in results])
    if partition.status is MPQPStatus.INFEASIBLE:
        return "" if feasible.mean() < 0.01 else "called infeasible"
    if partition.status is not MPQPStatus.COMPLETE:
        return partition.status.name
    rows, t = partition.scaled_rows, (theta - partition.centre) / partition.half
    inside = np.maximum.reduceat(t @ rows[:, :-1].T - rows[:, -1], partition.offsets[:-1], axis=1)
    known = feasible & (inside.min(axis=1) <= 1e-7)
    law = partition.law[inside.argmin(axis=1)[known]]
    z = np.einsum("nij,nj->ni", law[:, :, :-1], theta[known]) + law[:, :, -1]
    truth = np.array([results[i].z for i in np.flatnonzero(known)]).reshape(z.shape)
    size = np.sqrt(np.diag(problem.H))
    typical = float(np.median(np.abs(problem.w) / np.linalg.norm(problem.G / size, axis=1)))
    largest = max(np.abs(truth * size).max(initial=0.0), NEXT_TO_NOTHING * typical)
    error = np.abs((z - truth) * size).max(initial=0.0) / max(largest, 1e-300)
    wrong = {
        f"law {error:.1e}": error > 1e-6,
        "holes": np.mean(feasible & ~known) > 1e-3,
        "infeasible inside": (~feasible & (inside.min(axis=1) < -1e-6)).any(),
        "overlap": np.mean((inside < -1e-6).sum(axis=1) > 1) > 0.01,
        f"{len(partition)} regions, not {regions}": regions is not None and len(partition) != regions,
    }
    return ", ".join(name for name, true in wrong.items() if true)


def judge_holes(problem, states=STATES):
    """Whether a partition that does not call itself inaccurate leaves feasible parameters out; "" where it does not."""
    ones = np.ones(problem.nt)
    partition = solve_mpqp(problem, Polytope.from_bounds(-2 * ones, 2 * ones), time_limit=20.0)
    if partition.status is MPQPStatus.INACCURATE:
        return ""
    theta = np.random.default_rng(0).uniform(-2, 2, size=(states, problem.nt))
    if len(partition):
        rows, t = partition.scaled_rows, (theta - partition.centre) / partition.half
        inside = np.maximum.reduceat(t @ rows[:, :-1].T - rows[:, -1], partition.offsets[:-1], axis=1)
        theta = theta[inside.min(axis=1) > 1e-6]
    cost, limits = np.zeros(problem.nz), (-1e3, 1e3)
    left_out = sum(linprog(cost, problem.G, problem.w + problem.S @ t - 1e-5, bounds=limits).status == 0 for t in theta)
    return f"{partition.status.name}, {left_out} of {states} parameters left out" if left_out else ""


def nearly_dependent(name, count, first, problem_of_seed):
    """Print one row for problems with rows that are parallel, or opposite, but for 1e-6."""
    start, wrong = time.perf_counter(), []
    for seed in range(first, first + count):
        try:
            verdict = judge_holes(problem_of_seed(seed))
        except InputError:  # equalities that leave no freedom
            continue
        if verdict:
            wrong.append(f"{seed}: {verdict}")
    print(f"| {name} | {count} | {len(wrong)} | {time.perf_counter() - start:.0f} |", flush=True)
    for line in wrong[:8]:
        print("    ", line)


def main(count=100, first=50_000):
    """Print one row a kind, and every problem that is wrong."""
    print("| kind | problems | wrong | s |\n|---|---|---|---|")
    nearly_dependent("nearly parallel rows", 10 * count, first, nearly_parallel_rows)
    nearly_dependent("nearly opposite rows", 10 * count, first, partial(nearly_parallel_rows, opposite=True))
    nearly_dependent("slabs that close", 10 * count, first, closing_slab)
    for name, (change, same_regions) in KINDS.items():
        start, wrong = time.perf_counter(), []
        for seed in range(first, first + count):
            rng = np.random.default_rng(seed)
            problem, half = plain(rng)
            regions = len(solve_mpqp(problem, Polytope.from_bounds(-half, half))) if same_regions else None
            try:
                verdict = judge(*change(rng, problem, half), regions)
            except InputError as error:  # equalities may leave no freedom
                verdict = "" if "leaves no input free" in str(error) or "cannot be met" in str(error) else str(error)
            if verdict:
                wrong.append(f"{seed}: {verdict}")
        print(f"| {name} | {count} | {len(wrong)} | {time.perf_counter() - start:.0f} |", flush=True)
        for line in wrong[:8]:
            print("    ", line)


if __name__ == "__main__":
    main(*(int(a) for a in sys.argv[1:3]))
