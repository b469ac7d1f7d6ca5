"""Whether an estimate is a minimum, by second derivatives of its program."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import block_array, csc_matrix, triu
from scipy.sparse.linalg import splu

from mpc.budgets import SHAKEN
from mpc.checks import Array
from mpc.optimal_control.estimation.information import Information
from mpc.optimal_control.phase import interpolated
from mpc.optimal_control.problem import OptimalControlProblem
from mpc.optimal_control.solution import Solution
from mpc.tolerances import NEGLIGIBLE


def lagrangian(solution: Solution) -> tuple[csc_matrix, csc_matrix]:
    """Lagrangian's Hessian (n, n) and slopes (m, n) of the rows, in sizes."""
    program, v = solution.program, solution.unknowns
    size = program.scale
    upper = program.derivatives.hessian(v, 1.0, solution.multipliers["rows"]).sparse()
    W = csc_matrix(upper + triu(upper, 1).T).multiply(size[:, None]).multiply(size).tocsc()
    slopes = csc_matrix(program.derivatives.jacobian[1](v)[1].sparse())
    return W, slopes.multiply(size).multiply(1 / program.row_scale[:, None]).tocsc()


def tangents(solution: Solution, known: Information, W: csc_matrix, A: csc_matrix) -> Array:
    """Moves (n, k) of all unknowns, in sizes, by directions that are free."""
    program = solution.program
    rest = np.concatenate([np.arange(part.first + part.layout.nx, part.last) for part in program.parts])
    Z = np.zeros((len(program.lower), known.directions.shape[1]))
    Z[known.places] = known.directions * (known.units / program.scale[known.places])[:, None]
    K = block_array([[W[rest][:, rest], A[:, rest].T], [A[:, rest], None]], format="csc")
    Z[rest] = splu(K).solve(-np.vstack([W[rest] @ Z, A @ Z]))[: len(rest)]
    return Z


def downhill(solution: Solution, known: Information) -> Array | None:
    """Move (n,) from a maximum or saddle, None at a minimum.

    By second derivatives for the unknowns that are free. Falls that are rounding beside their terms and the cost are
    none.
    """
    W, A = lagrangian(solution)
    Z = tangents(solution, known, W, A)
    Z /= np.abs(Z[known.places]).max(axis=0, initial=0.0)
    terms = (np.abs(Z).T @ abs(W) @ np.abs(Z)).sum(axis=1) + abs(solution.cost)
    unit = np.sqrt(np.where(terms > 0, terms, 1.0))
    values, ways = np.linalg.eigh(Z.T @ (W @ Z) / unit / unit[:, None])
    falls = values < -NEGLIGIBLE
    if not falls.any():
        return None
    way = ways[:, falls].sum(axis=1) / unit
    way *= SHAKEN / way[np.argmax(np.abs(way))]
    return np.asarray(Z @ way * solution.program.scale)


def beside(problem: OptimalControlProblem, solution: Solution, move: Array) -> OptimalControlProblem:
    """Problem begun at moved parameters and states."""
    program, v, phases = solution.program, solution.unknowns, []
    for part, phase in zip(program.parts, problem.phases):
        times, x, u = phase.guess
        moves = part.unknowns(move)[0][: part.layout.nx].T
        phases.append(replace(phase, guess=(times, x + interpolated(times, part.mesh, moves), u)))
    p = np.clip(v + move, program.lower, program.upper)[program.parameters]
    return replace(problem, phases=phases, p_guess=p)
