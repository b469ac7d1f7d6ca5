"""Sets of random plants in hard units: what is wrong, too small or late.

python benchmarks/adversarial_sets.py                    all three tables
python benchmarks/adversarial_sets.py --only positive    one of them: positive, controllable, control
python benchmarks/adversarial_sets.py --count 40         fewer cases of each
python benchmarks/adversarial_sets.py --held-out         families that nothing was developed on

Every oracle is a linear program of its own, solved by HiGHS in the units in which the plant was drawn, so that
the units handed to the package do not disturb it.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import time
from collections import Counter
from dataclasses import replace

import numpy as np
from scipy.optimize import linprog
from set_cases import Array, Case, Rows, control_case, controllable_case, positive_case
from set_oracles import along, exit_of, inner_point, largest, lifted, ranges

from invariant_sets import (
    Polytope,
    SetResult,
    Status,
    controllable_set,
    maximal_control_invariant_set,
    maximal_positively_invariant_set,
    predecessor_set,
)

CLOSE = 1e-6  # what an oracle may be wrong by, relative to the width of the set


# --- verdicts --------------------------------------------------------------------------------------------------


def judge_positive(case: Case, C: Array, Y: Rows, result: SetResult) -> str:
    """Return what is wrong with a maximal positively invariant set, "" if nothing."""
    if result.status is not Status.CONVERGED:
        return f"status {result.status.name}"
    n = len(case.A)
    blocks = [C]
    for _ in range(n - 1):
        blocks.append(blocks[-1] @ case.A)
    _, sizes, seen = np.linalg.svd(np.vstack(blocks))
    sizes = np.append(sizes, np.zeros(n - len(sizes)))[:n]
    observable = sizes[-1] > 1e-7 * sizes[0]
    if result.set.is_bounded != observable and not 1e-12 < sizes[-1] / sizes[0] < 1e-7:
        return f"bounded {result.set.is_bounded}, observable {observable}"
    F, g = case.drawn(result.set)
    width = ranges((F, g))
    if (np.array([largest(f @ case.A, F, g) for f in F]) > g + CLOSE * width).any():
        return "not invariant"
    for f, limit in zip(*case.X):
        if largest(f, F, g) > limit + CLOSE * (1 + abs(limit)):
            return "outside X"
    rows, right = [case.X[0]], [case.X[1]]
    for _ in range(400):  # the definition itself: outputs of 400 steps
        rows.append(rows[-1] @ case.A)
        right.append(case.X[1])
        if np.abs(rows[-1]).max() < 1e-9:
            break
    hidden = int((sizes <= 1e-12 * sizes[0]).sum())
    seen = seen[: n - hidden] if hidden else np.eye(n)  # what no output sees is zero but for rounding
    if np.abs(F - F @ seen.T @ seen).max() > CLOSE:
        return "bounded where no output sees"
    everything = np.vstack(rows) @ seen.T, np.concatenate(right)
    if any(largest(f, *everything) > limit + 10 * CLOSE * w for f, limit, w in zip(F @ seen.T, g, width)):
        return "too small"
    return ""


def judge_controllable(case: Case, result: SetResult, rays: int = 100) -> str:
    """Return what is wrong with a controllable set, "" if nothing: points inside and outside along rays."""
    n = len(case.A)
    rows = lifted(case, case.steps, case.target)
    found = inner_point(rows, n)
    if found is None:
        return "" if result.status is Status.EMPTY else "empty, but not said"
    start, radius = found
    if result.status is Status.EMPTY:
        return "said EMPTY" if radius > 1e-9 else ""
    if result.status is not Status.CONVERGED:
        return f"status {result.status.name}"
    mine = case.drawn(result.set)
    rng = np.random.default_rng(0)
    for direction in rng.normal(size=(rays, n)):
        limit, claimed = along(rows, start, direction), exit_of(mine, start, direction)
        back, claimed_back = along(rows, start, -direction), exit_of(mine, start, -direction)
        width = limit + back
        if abs(claimed - limit) > CLOSE * width or abs(claimed_back - back) > CLOSE * width:
            return f"off by {max(abs(claimed - limit), abs(claimed_back - back)) / width:.1e} of the width"
    return ""


def judge_control(case: Case, result: SetResult, seconds: float, limit: float, rays: int = 12) -> str:
    """Return what is wrong with a maximal control invariant set, "" if nothing."""
    n, m = case.B.shape
    if seconds > 1.5 * limit + 1.0:
        return f"late: {seconds:.0f} s"
    if result.status is Status.EMPTY:
        return "" if inner_point(lifted(case, 40, None), n) is None else "said EMPTY"
    if result.set.is_empty:
        return f"no set, {result.status.name}"
    C, outer = case.drawn(result.set), case.drawn(result.outer)
    found = inner_point(C, n)
    if found is None:
        return "no point in it"
    start, width = found[0], ranges(C)
    rng = np.random.default_rng(0)
    extreme = [linprog(d, A_ub=C[0], b_ub=C[1], bounds=(None, None)).x for d in rng.normal(size=(4 * rays, n))]
    for x in extreme:
        if x is None or (case.X[0] @ x > case.X[1] + CLOSE * (1 + np.abs(case.X[1]))).any():
            return "outside X or unbounded"
        rows = np.block([[C[0] @ case.B, -width[:, None]], [case.U[0], np.zeros((len(case.U[1]), 1))]])
        answer = linprog(
            np.append(np.zeros(m), 1.0),
            A_ub=rows,
            b_ub=np.append(C[1] - C[0] @ case.A @ x, case.U[1]),
            bounds=(None, None),
        )
        if answer.status != 0 or answer.x[-1] > CLOSE:
            return "not invariant"
    returning = lifted(case, 10, C)  # 10 more steps back
    for direction in rng.normal(size=(rays, n)):
        reach, back = exit_of(outer, start, direction), along(returning, start, direction)
        if back > reach * (1 + 1e-5) + CLOSE:
            return f"outer too small: {back:.3g} against {reach:.3g}"
        mine = exit_of(C, start, direction)
        beyond = start + 1.001 * mine * direction
        if result.status is Status.CONVERGED and not _leaves(case, beyond, 0.001 * mine, back - mine):
            return "too small"
    return ""


def _leaves(case: Case, x: Array, margin: float, back: float) -> bool:
    """Return whether no input keeps x in X for 40 steps (up to 640 where the plant is slow)."""
    n = len(x)
    if back > margin:
        return False
    for steps in (40, 160, 640):
        F, g = lifted(case, steps, None)
        room = g - F[:, :n] @ x
        if steps * (len(case.X[1]) + len(case.U[1])) * steps * case.B.shape[1] > 4e7:
            break
        answer = linprog(np.zeros(F.shape[1] - n), A_ub=F[:, n:], b_ub=room, bounds=(None, None), method="highs-ds")
        if answer.status == 2:
            return True
    return True  # not settled in that many steps, but the backward steps above add nothing


# --- tables ----------------------------------------------------------------------------------------------------


def table(name: str, verdicts: list[tuple[int, str, str]], seconds: float) -> None:
    """Print how many of each verdict there are."""
    wrong = [(seed, said) for seed, said, _ in verdicts if said]
    statuses = dict(Counter(status for _, _, status in verdicts))
    print(f"{name}: {len(verdicts)} cases, {len(wrong)} wrong, {seconds:.1f} s in all, {statuses}")
    for seed, said in wrong[:40]:
        print(f"    seed {seed}: {said}")


def positive(seeds: range, held_out: bool = False) -> list[tuple[int, str, str]]:
    """Return (seed, verdict, status) of maximal positively invariant sets."""
    verdicts = []
    for seed in seeds:
        case, C, Y = positive_case(seed, held_out)
        A, _ = case.matrices
        result = maximal_positively_invariant_set(A, Polytope(*Y), C=C / case.state_units)
        verdicts.append((seed, judge_positive(case, C, Y, result), result.status.name))
    return verdicts


def controllable(seeds: range, held_out: bool = False) -> list[tuple[int, str, str]]:
    """Return (seed, verdict, status) of controllable and predecessor sets."""
    verdicts = []
    for seed in seeds:
        case = controllable_case(seed, held_out)
        A, B = case.matrices
        X, U, target = case.states(case.X), case.inputs(), case.states(case.target)
        if seed % 3 == 0:
            result, case = predecessor_set(A, B, target, U, X=X), replace(case, steps=1)
        else:
            result = controllable_set(A, B, X, U, target, case.steps)
        verdicts.append((seed, judge_controllable(case, result), result.status.name))
    return verdicts


def control(seeds: range, held_out: bool = False, limit: float = 20.0) -> list[tuple[int, str, str]]:
    """Return (seed, verdict, status) of maximal control invariant sets under a time limit."""
    verdicts = []
    for seed in seeds:
        case = control_case(seed, held_out)
        start = time.perf_counter()
        result = maximal_control_invariant_set(*case.matrices, case.states(case.X), case.inputs(), time_limit=limit)
        spent = time.perf_counter() - start
        verdicts.append((seed, judge_control(case, result, spent, limit), f"{result.status.name}"))
        print(
            f"  {seed} n={len(case.A)} m={case.B.shape[1]} {result.status.name} {spent:.1f} s "
            f"gap {result.certificate.gap:.1e} {verdicts[-1][1]}",
            flush=True,
        )
    return verdicts


TABLES = {"positive": (positive, 400), "controllable": (controllable, 400), "control": (control, 300)}


def main() -> None:
    """Print the tables asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=TABLES)
    parser.add_argument("--count", type=int)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--held-out", action="store_true")
    chosen = parser.parse_args()
    for name, (function, count) in TABLES.items():
        if chosen.only in (None, name):
            start = time.perf_counter()
            seeds = range(chosen.first, chosen.first + (chosen.count or count))
            table(name, function(seeds, chosen.held_out), time.perf_counter() - start)


if __name__ == "__main__":
    main()
