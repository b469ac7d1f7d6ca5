"""Whole-number inputs from relaxed ones by sum-up rounding."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ccdtools_ground.door import brief
from mpc.checks import Array, as_array, as_count
from mpc.exceptions import InputError
from mpc.optimal_control.solution import Solution
from mpc.optimal_control.solving import solve
from mpc.tolerances import FEASIBLE


@dataclass(frozen=True, eq=False)
class Rounded:
    """Whole inputs (N, m), with the largest gap of an integral and its bound."""

    inputs: Array
    gap: float
    bound: float


def sum_up_rounding(relaxed: ArrayLike, durations: ArrayLike, *, one_of: bool = False) -> Rounded:
    """Whole inputs whose integrals follow relaxed ones.

    Parameters
    ----------
    relaxed, durations : (N, m) and (N,) arrays
        Means over intervals, rounded within the whole numbers about the extremes of a column; lengths of these [s].
    one_of : bool
        Whether exactly one of the m is 1 at a time, and the others 0.

    Returns
    -------
    Rounded
        max |∫(relaxed − whole) dt| is at most Δ/2, with `one_of` (m − 1) Δ; Δ is the longest interval.

    References
    ----------
    Sager, Bock and Diehl, "The integer approximation error in mixed-integer optimal control", Math. Program. 133, 2012.
    """
    a = as_array("relaxed", relaxed, (None, None))
    h = as_array("durations", durations, (len(a),))
    if not a.size or not (h > 0).all():
        raise InputError("durations", brief(repr(h)), "positive numbers, at least one")
    if one_of and not (np.abs(a.sum(axis=1) - 1).max() <= FEASIBLE and a.min() >= -FEASIBLE):
        raise InputError("relaxed", brief(repr(a)), "rows of shares ≥ 0 that sum to 1, as `one_of` asks")
    low, high = np.floor(a.min(axis=0) + FEASIBLE), np.ceil(a.max(axis=0) - FEASIBLE)
    whole, owed = np.zeros(a.shape), np.zeros(a.shape[1])
    for k, duration in enumerate(h):
        owed += duration * a[k]
        whole[k] = np.eye(len(owed))[owed.argmax()] if one_of else np.clip(np.floor(owed / duration + 0.5), low, high)
        owed -= duration * whole[k]
    gap = float(np.abs(np.cumsum(h[:, None] * (a - whole), axis=0)).max())
    return Rounded(whole, gap, float(h.max() * (len(owed) - 1 if one_of else 0.5)))


def round_inputs(solution: Solution, *, inputs: Sequence[int] | None = None, one_of: bool = False,
                 **options: Any) -> tuple[Rounded, Solution]:  # fmt: skip
    """Whole inputs for relaxed ones, and the solution with them.

    Parameters
    ----------
    solution : Solution
        Of one phase, whose inputs may jump: by `Radau`, by shooting or discrete. Whole inputs keep to its intervals.
    inputs, one_of : sequence of int, bool
        Which are whole, all by default; as in `sum_up_rounding`.
    **options
        For `solve`. All else is optimised anew: limits that no trajectory with whole inputs keeps are conflicts.
    """
    parts = solution.program.parts if isinstance(solution, Solution) else ()
    if len(parts) != 1 or parts[0].layout.node_inputs:
        raise InputError("solution", brief(repr(solution)), "a Solution of one phase, whose inputs may jump")
    (part,), (found,), program = parts, solution.phases, solution.program
    free = range(part.phase.inputs - part.phase.algebraics)
    given = free if inputs is None else np.ravel(np.array(inputs, dtype=object))
    own = [as_count("inputs", place, least=0) for place in given]
    bounds = np.array(part.phase.u_bounds)[:, own] if own and len({*own}) == len(own) and {*own} <= {*free} else np.nan
    if not (np.isfinite(bounds).all() and np.array_equal(bounds, np.round(bounds))):
        raise InputError("inputs", own, f"places of inputs with whole bounds, each once, below {len(free)}")
    lower, upper, points = program.lower.copy(), program.upper.copy(), len(part.layout.held)
    weights = part.scheme.matrix[-1] if points > 1 else np.ones(1)  # type: ignore[union-attr]  # shooting has 1 point
    relaxed = np.einsum("g,kgi->ki", weights, found.stages.inputs[:, :, own])
    rounded = sum_up_rounding(relaxed, np.diff(found.times), one_of=one_of)
    places = part.first + np.array([np.flatnonzero(part.coordinates[0] == part.layout.nx + i) for i in own]).T
    lower[places] = upper[places] = np.repeat(rounded.inputs, points, axis=0)
    return rounded, solve(replace(program, lower=lower, upper=upper), start=solution, **options)
