"""Whether a problem has a feasible trajectory at all: the least violation of its constraints, from several starts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from mpc.checks import Array
from mpc.optimal_control.derivatives import Derivatives
from mpc.optimal_control.piece import Piece
from mpc.optimal_control.pieces import piece_function
from mpc.optimal_control.program import NonlinearProgram
from mpc.optimal_control.unknowns import coordinates

SHAKEN = 0.3  # part of the sizes of unknowns by which a second start is moved


def elastic(program: NonlinearProgram, start: Array) -> NonlinearProgram:
    """The program whose every constraint may be violated, and whose cost is the sum of the violations, in sizes."""
    n, m = len(program.lower), len(program.row_lower)
    pieces = [
        replace(piece, factors=np.where(piece.of_cost, 0.0, piece.factors)) for piece in program.derivatives.pieces
    ]
    weighed = piece_function(
        lambda above, below, data: [(above + below) / data, above - below], True, {"above": 1, "below": 1}, 1
    )
    places = np.arange(m)
    pieces.append(
        Piece(weighed, n + np.vstack([places, m + places]), program.row_scale[None],
              np.vstack([np.zeros(m, dtype=int), 1 + places]), np.array([1.0, -1.0]))
    )  # fmt: skip
    derivatives = Derivatives(pieces, n + 2 * m, m)
    g = np.asarray(program.derivatives.values(start)[1], dtype=float).ravel()
    g = np.where(np.isfinite(g), g, 0.0)
    above, below = np.maximum(g - program.row_upper, 0.0), np.maximum(program.row_lower - g, 0.0)
    return replace(
        program, derivatives=derivatives, costs=slice(0, 0), cost_scale=1.0,
        lower=np.concatenate([program.lower, np.zeros(2 * m)]),
        upper=np.concatenate([program.upper, np.full(2 * m, np.inf)]),
        guess=np.concatenate([start, above, below]),
        scale=np.concatenate([program.scale, program.row_scale, program.row_scale]),
    )  # fmt: skip


def starts(program: NonlinearProgram, stopped: Array, lower: Array, upper: Array) -> Iterator[Array]:
    """Where the least violation is looked for: where the solver stopped, the guess, and the guess shaken."""
    yield stopped
    yield np.clip(program.guess, lower, upper)
    yield shaken(program, lower, upper)


def shaken(program: NonlinearProgram, lower: Array, upper: Array, seed: int = 0) -> Array:
    """The guess, each state and input of it moved along a line of its own, by a part of its size."""
    random = np.random.default_rng(seed)
    move = random.uniform(-SHAKEN, SHAKEN, len(lower))
    for part in program.parts:
        numbers, fractions = coordinates(part.layout, part.mesh)
        begin, rise = random.uniform(-SHAKEN, SHAKEN, (2, part.layout.nx + part.layout.nu))
        of = numbers.astype(int)
        move[part.first : part.last] = begin[of] + rise[of] * fractions
    return np.clip(program.guess + move * program.scale, lower, upper)
