"""Random plants in hard units against oracles that share no code with the package: what is wrong, too small or late.

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
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import linprog

from invariant_sets import (
    Polytope,
    SetResult,
    Status,
    controllable_set,
    maximal_control_invariant_set,
    maximal_positively_invariant_set,
    predecessor_set,
)

Array = np.ndarray
Rows = tuple[Array, Array]
CLOSE = 1e-6  # what an oracle may be wrong by, relative to the width of the set


@dataclass(frozen=True)
class Case:
    """A plant x⁺ = A x + B u with rows of X, U and a target, as drawn; the package gets it in other units.

    Attributes
    ----------
    A, B : arrays
        Dynamics.
    X, U, target : (F, g)
        Rows F z <= g.
    state_units, input_units : arrays
        The package sees x·state_units and u·input_units.
    steps : int
        Steps of a controllable set.
    """

    A: Array
    B: Array
    X: Rows
    U: Rows
    target: Rows
    state_units: Array
    input_units: Array
    steps: int = 1

    @property
    def matrices(self) -> tuple[Array, Array]:
        """A and B in the units of the package."""
        s, t = self.state_units, self.input_units
        return self.A * s[:, None] / s, self.B * s[:, None] / t

    def states(self, rows: Rows) -> Polytope:
        """Return rows on x as a set in the units of the package."""
        return Polytope(rows[0] / self.state_units, rows[1])

    def inputs(self) -> Polytope:
        """Return U in the units of the package."""
        return Polytope(self.U[0] / self.input_units, self.U[1])

    def drawn(self, P: Polytope) -> Rows:
        """Return the rows of a set of the package in the units of the plant as drawn, of unit norm."""
        F = np.vstack([P.A, P.A_eq, -P.A_eq]) * self.state_units
        norms = np.linalg.norm(F, axis=1)
        norms[norms == 0] = 1.0
        return F / norms[:, None], np.concatenate([P.b, P.b_eq, -P.b_eq]) / norms


# --- oracles ---------------------------------------------------------------------------------------------------


def largest(c: Array, F: Array, g: Array) -> float:
    """Return max cᵀz over F z <= g by HiGHS: −inf if empty, +inf if unbounded; either is confirmed by zero cost."""
    for method in ("highs-ds", "highs-ipm"):
        answer = linprog(
            -c,
            A_ub=F,
            b_ub=g,
            bounds=(None, None),
            method=method,
            options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
        )
        if answer.status == 0:
            return float(-answer.fun)
    feasible = linprog(0 * c, A_ub=F, b_ub=g, bounds=(None, None), method="highs-ds").status == 0
    return np.inf if feasible else -np.inf


def lifted(case: Case, steps: int, target: Rows | None) -> Rows:
    """Return rows on (x₀, u₀, …) that keep x in X and u in U for `steps` steps, and x in the target at the end."""
    n, m = case.B.shape
    width = n + steps * m
    state = np.hstack([np.eye(n), np.zeros((n, steps * m))])
    rows, right = [], []
    for k in range(steps):
        rows.append(case.X[0] @ state)
        right.append(case.X[1])
        pick = np.zeros((m, width))
        pick[:, n + k * m : n + (k + 1) * m] = np.eye(m)
        rows.append(case.U[0] @ pick)
        right.append(case.U[1])
        state = case.A @ state + case.B @ pick
    for F, g in [case.X] if target is None else [target]:
        rows.append(F @ state)
        right.append(g)
    return np.vstack(rows), np.concatenate(right)


def along(rows: Rows, start: Array, direction: Array) -> float:
    """Return the largest t with (start + t direction, ·) in the rows, −inf if there is none."""
    F, g = rows
    n = len(start)
    moving = np.column_stack([F[:, :n] @ direction, F[:, n:]])
    scale = np.maximum(np.abs(moving).max(axis=1), 1e-300)
    used = np.abs(moving).max(axis=1) > 1e-14
    if ((g - F[:, :n] @ start)[~used] < -1e-9).any():
        return -np.inf
    cost = np.zeros(moving.shape[1])
    cost[0] = 1.0
    return largest(cost, moving[used] / scale[used, None], (g - F[:, :n] @ start)[used] / scale[used])


def exit_of(rows: Rows, start: Array, direction: Array) -> float:
    """Return the largest t with start + t direction in {F x <= g}."""
    slope, room = rows[0] @ direction, rows[1] - rows[0] @ start
    return float((room[slope > 1e-14] / slope[slope > 1e-14]).min(initial=np.inf))


def inner_point(rows: Rows, n: int) -> tuple[Array, float] | None:
    """Return a point well inside the rows (the first n coordinates) and the radius there, None if empty."""
    F, g = rows
    norms = np.linalg.norm(F, axis=1)
    used = norms > 1e-14
    F, g = F[used] / norms[used, None], g[used] / norms[used]
    k = F.shape[1]
    cost = np.zeros(k + 1)
    cost[k] = -1.0
    answer = linprog(
        cost,
        A_ub=np.hstack([F, np.ones((len(F), 1))]),
        b_ub=g,
        bounds=[(None, None)] * k + [(None, 1.0)],
        method="highs-ds",
    )
    return None if answer.status != 0 or answer.x[k] < -1e-9 else (answer.x[:n], float(answer.x[k]))


def ranges(rows: Rows) -> Array:
    """Return the width of {F x <= g} along each of its rows, 1 where it has none."""
    F, g = rows
    width = np.array([largest(f, F, g) + largest(-f, F, g) for f in F])
    return np.where(np.isfinite(width) & (width > 1e-12), width, 1.0)


# --- plants ----------------------------------------------------------------------------------------------------


def box(lower: Array, upper: Array) -> Rows:
    """Return the rows of a box."""
    eye = np.eye(len(lower))
    return np.vstack([eye, -eye]), np.concatenate([upper, -np.asarray(lower)])


def spread(rng: np.random.Generator, n: int, decades: float) -> Array:
    """Return n units over the given number of decades on either side of one."""
    return 10.0 ** rng.uniform(-decades, decades, n)


def plant(rng: np.random.Generator, n: int, m: int, radius: tuple[float, float], held_out: bool) -> tuple[Array, Array]:
    """Return A with a spectral radius in the given range, and B."""
    kind = int(rng.integers(4)) if held_out else -1
    B = rng.normal(size=(n, m))
    size = rng.uniform(*radius)
    if kind == 0:  # a chain of integrators, stable or not
        A = min(size, 1.0) * np.eye(n) + 0.5 * np.eye(n, k=1)
    elif kind == 1:  # weakly damped modes
        angles = rng.uniform(0.2, 2.5, (n + 1) // 2)
        turns = [np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) for a in angles]
        mix = rng.normal(size=(n, n))
        A = mix @ (min(size, 0.97) * block_diag(*turns)[:n, :n]) @ np.linalg.inv(mix)
    elif kind == 2:  # nilpotent or singular
        A = np.triu(rng.normal(size=(n, n)), 1) + np.diag(rng.choice([0.0, 0.5 * size], n))
    elif kind == 3:  # symmetric, modes of either sign
        Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
        A = Q @ np.diag(rng.uniform(-size, size, n)) @ Q.T
    else:
        A = rng.normal(size=(n, n))
        A *= size / max(np.abs(np.linalg.eigvals(A)).max(), 1e-3)
    return A, B


def input_rows(rng: np.random.Generator, m: int) -> Rows:
    """Return a box, a box with a corner off, or a simplex, with zero inside or on the border now and then."""
    lower, upper = -rng.uniform(0.2, 2, m), rng.uniform(0.2, 2, m)
    F, g = box(lower, upper)
    if m > 1 and rng.random() < 0.4:
        d = rng.uniform(0.2, 1, m)
        F, g = np.vstack([F, d]), np.append(g, 0.6 * d @ upper)
    return F, g


def dressed(rng: np.random.Generator, rows: Rows, size: float) -> Rows:
    """Return the rows with copies, weakly redundant and far ones among them, shuffled."""
    F, g = rows
    draw = rng.random()
    if draw < 0.25:
        F, g = np.vstack([F, 3 * F[:1], F[-1:]]), np.concatenate([g, 3 * g[:1], g[-1:]])
    elif draw < 0.5:
        far = rng.normal(size=F.shape[1])
        F, g = np.vstack([F, far]), np.append(g, size * 10.0 ** rng.uniform(3, 18))
    order = rng.permutation(len(g))
    return F[order], g[order]


def positive_case(seed: int, held_out: bool = False) -> tuple[Case, Array, Rows]:
    """Return a stable plant, an output matrix and rows on one or two outputs."""
    rng = np.random.default_rng([1, seed, held_out])
    n, outputs = 2 + seed % 4, 1 + (seed // 4) % 2
    A, _ = plant(rng, n, 1, (0.4, 0.98), held_out)
    A *= min(1.0, 0.98 / max(np.abs(np.linalg.eigvals(A)).max(), 1e-9))
    C = rng.normal(size=(outputs, n))
    if rng.random() < 0.25:  # a mode that no output sees
        values = np.linalg.eigvals(A.T)
        hidden = int(np.flatnonzero(np.abs(values.imag) < 1e-12)[0]) if (np.abs(values.imag) < 1e-12).any() else -1
        if hidden >= 0:
            right = np.linalg.eig(A)[1][:, np.argmin(np.abs(np.linalg.eig(A)[0] - values[hidden]))].real
            C = C - np.outer(C @ right, right) / (right @ right)
    Y = box(-rng.uniform(0.2, 2, outputs), rng.uniform(0.2, 2, outputs))
    units = spread(rng, n, 3.0 * (seed % 3))
    return Case(A, np.zeros((n, 1)), (Y[0] @ C, Y[1]), box([-1.0], [1.0]), Y, units, np.ones(1)), C, Y


def controllable_case(seed: int, held_out: bool = False) -> Case:
    """Return a plant with 1 to 3 inputs and 1 to 4 states, a target and 1 to 4 steps."""
    rng = np.random.default_rng([2, seed, held_out])
    n, m = 1 + seed % 4, 1 + (seed // 4) % 3
    A, B = plant(rng, n, m, (0.3, 1.6), held_out)
    if m > 1 and rng.random() < 0.3:
        B[:, 1] = B[:, 0] * rng.uniform(-2, 2) + (1e-6 * rng.normal(size=n) if rng.random() < 0.5 else 0.0)
    X = dressed(rng, box(-rng.uniform(1, 4, n), rng.uniform(1, 4, n)), 4.0)
    if rng.random() < 0.5:
        target = box(-rng.uniform(0.1, 1, n), rng.uniform(0.1, 1, n))
    else:
        F = rng.normal(size=(2 * n + 1, n))
        around = box(-np.ones(n), np.ones(n))
        target = np.vstack([F, around[0]]), np.append(rng.uniform(0.3, 1, 2 * n + 1), around[1])
    decades = 2.0 * (seed % 3)
    U = dressed(rng, input_rows(rng, m), 2.0)
    state_units, input_units = spread(rng, n, decades), spread(rng, m, decades)
    return Case(A, B, X, U, target, state_units, input_units, int(rng.integers(1, 5 if n < 4 else 3)))


def control_case(seed: int, held_out: bool = False) -> Case:
    """Return a plant with 1 to 6 states and 1 to 3 inputs inside boxes."""
    rng = np.random.default_rng([3, seed, held_out])
    n, m = 1 + seed % 6, 1 + (seed // 6) % 3
    A, B = plant(rng, n, m, (0.5, 1.3), held_out)
    X = dressed(rng, box(-rng.uniform(1, 3, n), rng.uniform(1, 3, n)), 3.0)
    U = dressed(rng, input_rows(rng, m), 2.0)
    decades = 2.0 * (seed % 3)
    return Case(A, B, X, U, X, spread(rng, n, decades), spread(rng, m, decades))


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
