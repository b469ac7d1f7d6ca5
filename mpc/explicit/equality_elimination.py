"""Detection and elimination of inequalities that always hold with equality."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from mpc.checks import Array, Ints
from mpc.dense_qp import DenseQP
from mpc.exceptions import InputError
from mpc.explicit.linear_programs import INFEASIBLE, SOLVED, proves_infeasible, solve_exactly
from mpc.explicit.partition import MPQPStatus
from mpc.explicit.scaled_qp import ScaledQP, widths, with_parameter_rows
from mpc.parametric_qp import Constraint
from mpc.tolerances import FAR_OPTIMUM, IMPLIED_EQUALITY, KKT, PRIMAL

Limits = list[tuple[float | None, float | None]]
_NO_ROWS = np.broadcast_to(np.int64(0), 0)
_NO_PARAMETERS = np.broadcast_to(0.0, (0, 0))


class FlatParameters(InputError):
    """Equalities that hold on a flat parameter set only."""


class ImpliedEqualities(NamedTuple):
    """Rows of M that hold with equality at every feasible point.

    parameters : (k, nt) that are feasible, the last as far as can be from what the other rows forbid; status : COMPLETE
    where settled, INFEASIBLE where no point is feasible, else TIME_LIMIT or INACCURATE; of_parameters : whether a row
    of the parameter set does, too; exact : whether the little slack of the rows moves the optimum by rounding only.
    """

    status: MPQPStatus
    rows: Ints = _NO_ROWS
    of_parameters: bool = False
    parameters: Array = _NO_PARAMETERS
    exact: bool = True


def implied_equalities(qp: ScaledQP, deadline: float = np.inf) -> ImpliedEqualities:
    """Rows that hold with equality everywhere, for variables within `qp.reach`.

    A linear program finds a point where the sum of the slacks, each counted up to a tenth, is largest. A row without
    slack there may have given it up for the others, so the sum of these rows alone is asked for, until none has any.
    """
    J, h = qp.joint
    nt = qp.D.shape[1] - 1
    nothing = np.zeros(J.shape[1])
    sizes: Limits = [(None, None)] * nt + [(-qp.reach, qp.reach)] * (J.shape[1] - nt)  # without any HiGHS may not end
    verdict = DenseQP(np.eye(J.shape[1]), J).solve(nothing, h, confirm_infeasible=True)
    if verdict.infeasible and proves_infeasible(verdict.multipliers, J, h, qp.reach):
        return ImpliedEqualities(MPQPStatus.INFEASIBLE)
    if qp.far > FAR_OPTIMUM:
        return ImpliedEqualities(MPQPStatus.INACCURATE)
    tight = np.arange(len(h))
    points: list[Array] = []
    while len(tight):
        program = _most_slack(J, h, tight, sizes, deadline)
        if program.status == INFEASIBLE and not points:
            return ImpliedEqualities(MPQPStatus.INFEASIBLE)
        if program.status != SOLVED:
            return _unsettled(deadline)
        point = program.x[: J.shape[1]]
        points.append(point)
        slack = h - J @ point
        loose = slack[tight] > IMPLIED_EQUALITY
        if not loose.any() and slack[tight].sum() > IMPLIED_EQUALITY:  # together they have some: which one has?
            own = [_most_slack(J, h, np.array([i]), sizes, deadline) for i in tight]
            if any(program.status != SOLVED for program in own):
                return _unsettled(deadline)
            loose = np.array([-program.fun > IMPLIED_EQUALITY for program in own])
        if not loose.any():
            break
        tight = tight[~loose]
    rows = tight[tight < len(qp.M)]
    # the slack must not let v move by more than rounding
    sizes_of_rows = np.linalg.svd(qp.M[rows], compute_uv=False) if len(rows) else np.ones(1)
    least = float(sizes_of_rows[sizes_of_rows > PRIMAL * sizes_of_rows[0]].min())
    exact = float(slack[tight].max(initial=0.0)) * max(1.0, qp.far) <= KKT * least
    wide = widths(qp.gram, np.abs(qp.own).sum(axis=1) * qp.own_unit)[rows]
    # no slab that is only thin beside others
    exact &= bool((slack[rows] <= np.maximum(KKT * wide, PRIMAL)).all())
    points += _deepest(J, h, tight, sizes, deadline)
    parameters = np.array([point[:nt] for point in points])
    return ImpliedEqualities(MPQPStatus.COMPLETE, rows, len(rows) < len(tight), parameters, exact)


def _unsettled(deadline: float) -> ImpliedEqualities:
    """Outcome of an unfinished program: TIME_LIMIT or INACCURATE."""
    late = time.perf_counter() > deadline
    return ImpliedEqualities(MPQPStatus.TIME_LIMIT if late else MPQPStatus.INACCURATE)


def _most_slack(J: Array, h: Array, counted: Ints, sizes: Limits, deadline: float) -> Any:
    """Program of most slack in the counted rows, each up to 0.1."""
    rows, columns = J.shape
    slack = np.zeros((rows, len(counted)))
    slack[counted, np.arange(len(counted))] = 1.0
    cost = np.concatenate([np.zeros(columns), -np.ones(len(counted))])
    limits = [*sizes, *[(0.0, 0.1)] * len(counted)]
    return solve_exactly(cost, np.hstack([J, slack]), h, limits, deadline)


def _deepest(J: Array, h: Array, tight: Ints, sizes: Limits, deadline: float) -> list[Array]:
    """Point (t, v) of largest least slack in loose rows, or none."""
    loose = np.ones((len(J), 1))
    loose[tight] = 0.0
    cost = np.append(np.zeros(J.shape[1]), -1.0)
    limits = [*sizes, (0.0, 1.0)]
    program = solve_exactly(cost, np.hstack([J, loose]), h, limits, deadline)
    return [program.x[:-1]] if program.status == SOLVED else []


def eliminate(qp: ScaledQP, equalities: list[int], labels: tuple[Constraint, ...]) -> ScaledQP:
    """Problem in y, v = P y + (least-norm solution) [t; 1].

    The least-norm solution is orthogonal to P, so that the cost stays ½|y|² up to a constant. Rows of M that hold with
    equality are refused, named by `labels`, where they leave no freedom in v, or restrict the parameter.
    """
    M = qp.M[equalities]
    D = qp.D[equalities]
    U, s, Vt = np.linalg.svd(M)
    rank = int((s > PRIMAL * s[0]).sum())
    solution = Vt[:rank].T @ ((U[:, :rank].T @ D) / s[:rank, None])
    gap = float((np.abs(M @ solution - D).max(axis=1) / np.maximum(1.0, np.abs(D).max(axis=1))).max())
    met = gap <= 10 * IMPLIED_EQUALITY
    if rank == qp.M.shape[1] or not met:
        names = ", ".join(str(labels[qp.origin[i]]) for i in equalities[:3])
        trouble = "leaves no input free" if met else "cannot be met by the inputs for every parameter"
        cure = "Lengthen the horizon; give the set a width, and one that is not nothing beside `theta_set`."
        kind = InputError if met else FlatParameters
        raise kind("problem", f"an equality ({names}) that {trouble}", "freedom for the inputs", cure)
    P = Vt[rank:].T
    M = qp.M @ P
    D = qp.D - qp.M @ solution
    length = np.linalg.norm(M, axis=1)
    inside = length > PRIMAL
    beside = D[~inside & (np.abs(D).max(axis=1) > IMPLIED_EQUALITY)]  # these rows restrict the parameter
    TA, Tb = with_parameter_rows(qp.TA, qp.Tb, beside)
    M = np.ascontiguousarray(M[inside] / length[inside, None])
    return replace(
        qp, M=M, D=np.ascontiguousarray(D[inside] / length[inside, None]), tie=qp.tie[inside], gram=M @ M.T, TA=TA,
        Tb=Tb, origin=qp.origin[inside], back=qp.back @ P, free=qp.free + qp.back @ solution, own=qp.own[inside],
    )  # fmt: skip
