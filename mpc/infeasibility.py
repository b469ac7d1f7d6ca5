"""Explanations of infeasible MPC problems."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpc.checks import Array
from mpc.condensing import row_units
from mpc.dense_qp import DenseQP
from mpc.exceptions import InputError
from mpc.parametric_qp import Constraint, ParametricQP
from mpc.problem import MPCProblem
from mpc.tolerances import EPS, FEASIBLE, KKT_REPORTED, LP_OPTIONS, OVERFLOW, RUNAWAY, SOLVERS

Rows = list[int]


@dataclass(frozen=True)
class Violation:
    """Constraint that has to give.

    constraint : where it comes from; meaning : it in words; amount : by how much, in its own units; row : of the QP.
    """

    constraint: Constraint
    meaning: str
    amount: float
    row: int


@dataclass(frozen=True, repr=False)
class Explanation:
    """Why there is no admissible input sequence, printed as one sentence.

    Attributes
    ----------
    violations : tuple of Violation
        Constraints that have to give and by how much; without them the problem is feasible, and none can be spared.
        Empty for a feasible problem.
    conflict : tuple of Constraint
        A minimal contradiction: these constraints cannot hold together, any of them left out they can.
    conflict_rows : tuple of int
        Their rows in the QP.
    text : str
        The sentence.
    """

    violations: tuple[Violation, ...]
    conflict: tuple[Constraint, ...]
    conflict_rows: tuple[int, ...]
    text: str

    @property
    def feasible(self) -> bool:
        """True when nothing has to give."""
        return not self.violations

    def __str__(self) -> str:
        return self.text

    def __repr__(self) -> str:
        return f"Explanation({len(self.violations)} constraints give, {len(self.conflict)} contradict each other)"


def explain_infeasibility(
    problem: MPCProblem, qp: ParametricQP, theta: Array, runaway: Array | None = None
) -> Explanation:
    """Explanation of the QP at one parameter.

    The least sum of relative violations (a linear program) says what has to give; it is thinned until every member is
    needed. A minimal contradiction is found by a deletion filter on the support of a Farkas certificate.

    Where the states (N + 1, nx) of the relaxed plan run away, they say what gives, and the contradiction is looked for
    among as few first steps as have one: linear programs over the whole horizon would have no digits left (Chinneck,
    *Feasibility and Infeasibility in Optimization*, Springer 2008, chapters 6 and 7).
    """
    units = row_units(problem, qp.labels)
    with np.errstate(over="ignore", invalid="ignore"):
        _, b = qp.at(theta)
    if not np.abs(b).max(initial=0.0) < OVERFLOW:
        raise InputError(
            "x", f"bounds of the QP that exceed {OVERFLOW:.0e}", "a state that is not too large to explain"
        )
    scale = 1 / np.sqrt(np.diag(qp.H))
    G = qp.G * scale / units[:, None]
    b = b / units
    # the LP solver takes 1e20 for infinite: far away, bounds are compared in units of the largest
    far = max(1.0, float(np.abs(b).max(initial=0.0)) / RUNAWAY)
    b = b / far
    everything = list(range(qp.m))
    if runaway is None and not _impossible(G, b, everything):
        return Explanation((), (), (), "Feasible: nothing has to give.")
    givable = [i for i in everything if qp.labels[i].kind in ("state", "terminal")]
    fixed = [i for i in everything if i not in set(givable)]
    if runaway is not None:
        amounts = _what_gave(problem, qp.labels, runaway, far * units)
        everything = _first_steps(G, b, qp.labels)
    else:
        amounts = _what_gives(G, b, everything if _impossible(G, b, fixed) else givable)
    violations = tuple(
        Violation(qp.labels[i], describe(problem, qp.labels[i]), float(amounts[i] * far * units[i]), i)
        for i in sorted(amounts, key=lambda i: (qp.labels[i].step, i))
    )
    rows = tuple(_contradiction(G, b, everything))
    conflict = tuple(qp.labels[i] for i in rows)
    return Explanation(violations, conflict, rows, _sentence(problem, violations, conflict))


def _least_maximum(G: Array, b: Array, rows: Rows) -> tuple[float, Array]:
    """Least t >= 0 with Gz <= b + t, and the multipliers."""
    if not rows:
        return 0.0, np.zeros(0)
    from scipy.optimize import linprog

    n = G.shape[1]
    matrix = np.hstack([G[rows], -np.ones((len(rows), 1))])
    result = linprog(
        np.eye(n + 1)[n], A_ub=matrix, b_ub=b[rows], bounds=[(None, None)] * n + [(0, None)], options=LP_OPTIONS
    )
    if result.status != 0:  # the other solver decides
        return _least_by_qp(G, b, rows), np.ones(len(rows))
    return float(result.fun), -result.ineqlin.marginals


def _impossible(G: Array, b: Array, rows: Rows) -> bool:
    """Whether no z satisfies the rows, confirmed by a QP."""
    return _least_maximum(G, b, rows)[0] > FEASIBLE and _least_by_qp(G, b, rows) > FEASIBLE / 2


def _least_by_qp(G: Array, b: Array, rows: Rows) -> float:
    """Least t >= 0 with Gz <= b + t, by a QP."""
    if not rows:
        return 0.0
    n = G.shape[1]
    matrix = np.vstack([np.hstack([G[rows], -np.ones((len(rows), 1))]), -np.eye(n + 1)[n]])
    H = np.diag(np.concatenate([np.full(n, EPS), [1.0]]))
    result = DenseQP(H, matrix, np.ones(len(matrix))).solve(np.zeros(n + 1), np.append(b[rows], 0.0))
    return float(result.z[n]) if result.residuals.worst <= KKT_REPORTED else np.inf


def _what_gave(problem: MPCProblem, labels: tuple[Constraint, ...], states: Array, units: Array) -> dict[int, float]:
    """Rows violated by the states, with their violations in `units`."""
    sets = problem.limits.sets
    amounts = {}
    for i, (kind, step, row) in enumerate(labels):
        if kind in ("state", "terminal"):
            H, h = sets[kind]
            amounts[i] = float(H[row] @ states[step] - h[row]) / units[i]
    return {i: amount for i, amount in amounts.items() if amount > FEASIBLE}


def _first_steps(G: Array, b: Array, labels: tuple[Constraint, ...]) -> Rows:
    """Rows of the first 1, 2, 4 … steps, until they contradict."""
    last = max(label.step for label in labels)
    length = 1
    while True:
        rows = [i for i, label in enumerate(labels) if label.step <= length]
        if length >= last or _impossible(G, b, rows):
            return rows
        length *= 2


def _what_gives(G: Array, b: Array, givable: Rows) -> dict[int, float]:
    """Rows with their relative violations, thinned until none can be spared."""
    amounts = _least_sum(G, b, givable)
    chosen = sorted(amounts, key=lambda i: amounts[i])
    for i in list(chosen):
        fewer = [j for j in chosen if j != i]
        if fewer and _least_maximum(G, b, [j for j in range(len(b)) if j not in set(fewer)])[0] <= FEASIBLE:
            chosen = fewer
    thinned = _least_sum(G, b, chosen)
    if not all(np.isfinite(s) for s in thinned.values()):  # the first answer was enough
        return amounts
    return {i: thinned.get(i, 0.0) for i in chosen}


def _least_sum(G: Array, b: Array, givable: Rows) -> dict[int, float]:
    """Violations of least sum among `givable`."""
    from scipy.optimize import linprog

    m, n = G.shape
    relax = np.zeros((m, len(givable)))
    relax[givable, np.arange(len(givable))] = -1.0
    cost = np.concatenate([np.zeros(n), np.ones(len(givable))])
    bounds = [(None, None)] * n + [(0, None)] * len(givable)
    for method in ("highs", "highs-ds", "highs-ipm"):  # unstable plants over long horizons defeat one or the other
        result = linprog(cost, A_ub=np.hstack([G, relax]), b_ub=b, bounds=bounds, method=method, options=LP_OPTIONS)
        if result.status == 0:
            return {i: float(s) for i, s in zip(givable, result.x[n:]) if s > FEASIBLE}
    return {i: np.inf for i in givable}


def _contradiction(G: Array, b: Array, rows: Rows) -> Rows:
    """Minimal infeasible subset of the rows."""
    _, proof = _least_maximum(G, b, rows)
    support = [i for i, y in zip(rows, proof) if y > SOLVERS]
    current = support if _least_maximum(G, b, support)[0] > FEASIBLE else list(rows)
    for i in list(current):
        without = [j for j in current if j != i]
        if _least_maximum(G, b, without)[0] > FEASIBLE:
            current = without
    return current


def describe(problem: MPCProblem, label: Constraint) -> str:
    """Constraint in words, for instance "x[0] <= 5"."""
    if label.kind == "rate":
        j = label.row % problem.nu
        sign = label.row < problem.nu
        return f"Δu[{j}] {'<=' if sign else '>='} {problem.rate_limit[j] if sign else -problem.rate_limit[j]:.6g}"
    if label.kind == "slack":
        return f"slack {label.step} >= 0"
    H, h = problem.rows_at(label.kind, label.step)
    name = "u" if label.kind == "input" else "x"
    used = np.flatnonzero(H[label.row])
    if len(used) == 1:
        a = H[label.row, used[0]]
        return f"{name}[{used[0]}] {'<=' if a > 0 else '>='} {h[label.row] / a:.6g}"
    return f"row {label.row} of the {label.kind} set"


def _sentence(problem: MPCProblem, violations: tuple[Violation, ...], conflict: tuple[Constraint, ...]) -> str:
    """Sentence on what gives and what contradicts."""
    gives = ", ".join(f"{v.meaning} by {v.amount:.3g} at step {v.constraint.step}" for v in violations)
    steps: dict[str, list[int]] = {}
    for label in conflict:
        steps.setdefault(describe(problem, label), []).append(label.step)
    clash = " and ".join(f"{meaning} ({_ranges(at)})" for meaning, at in steps.items())
    return f"Infeasible: the least relaxation is {gives}; cannot hold together: {clash}."


def _ranges(steps: list[int]) -> str:
    """Steps as "step 3" or "steps 0-4, 6"."""
    runs: list[list[int]] = []
    for k in sorted(steps):
        if runs and k == runs[-1][1] + 1:
            runs[-1][1] = k
        else:
            runs.append([k, k])
    text = ", ".join(f"{a}" if a == b else f"{a}-{b}" for a, b in runs)
    return f"step{'s' if len(steps) > 1 else ''} {text}"
