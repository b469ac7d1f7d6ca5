"""Whether a problem has a feasible trajectory at all: the least violation of its constraints, from several starts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from mpc.checks import Array
from mpc.optimal_control.derivatives import Derivatives, Piece
from mpc.optimal_control.pieces import piece_function
from mpc.optimal_control.program import NonlinearProgram, describe_row
from mpc.optimal_control.unknowns import coordinates

HOLDS = 0.01  # multiplier, beside the largest, of a limit that stands in the way
SHAKEN = 0.3  # part of the sizes of unknowns by which a second start is moved
NEARLY = 1e-6  # of an unknown's size: what two bounds that count as one differ by


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


def shaken(program: NonlinearProgram, lower: Array, upper: Array) -> Array:
    """The guess, each state and input of it moved along a line of its own, by a part of its size."""
    random = np.random.default_rng(0)
    move = random.uniform(-SHAKEN, SHAKEN, len(lower))
    for part in program.parts:
        numbers, fractions = coordinates(part.layout, part.mesh)
        begin, rise = random.uniform(-SHAKEN, SHAKEN, (2, part.layout.nx + part.layout.nu))
        of = numbers.astype(int)
        move[part.first : part.last] = begin[of] + rise[of] * fractions
    return np.clip(program.guess + move * program.scale, lower, upper)


def contradiction(program: NonlinearProgram, v: Array, on_rows: Array, on_bounds: Array, violations: Array,
                  feasible: float, shown: int) -> tuple[str, ...]:  # fmt: skip
    """What cannot hold together, of the unknowns with the least violations and the multipliers there.

    First the constraints that are violated most, then those and the bounds whose multipliers hold against them.
    """
    worst = [int(i) for i in np.argsort(-violations)[:shown] if violations[i] > feasible]
    found = [f"{describe_row(program, i, v)}, by {violations[i] * program.row_scale[i]:.3g}" for i in worst]
    pushing = np.abs(on_rows * program.row_scale)
    for rows in program.rows:
        own = pushing[rows.first : rows.last]
        if rows.name == "dynamics" or set(range(rows.first, rows.last)) & set(worst):
            continue
        if own.max(initial=0.0) > HOLDS * pushing.max(initial=0.0):
            found.append(describe_row(program, rows.first + int(own.argmax()), v))
    return (*found, *_bounds_in_the_way(program, v, on_bounds))


def _bounds_in_the_way(program: NonlinearProgram, v: Array, on_bounds: Array) -> Iterator[str]:
    """Bounds that a violation would fall with, in words: each limit of each entry once."""
    weights = on_bounds[: len(v)] * program.scale
    groups: dict[str, float] = {}
    for i, text in _texts(program, v, weights):
        groups[text] = groups.get(text, 0.0) + abs(weights[i])
    largest = max(groups.values(), default=0.0)
    yield from (text for text, weight in groups.items() if weight > HOLDS * largest)


def _texts(program: NonlinearProgram, v: Array, weights: Array) -> Iterator[tuple[int, str]]:
    """What the bound of each unknown with a multiplier is called."""
    for k, part in enumerate(program.parts):
        of_phase = f" of phase {k + 1}" if len(program.parts) > 1 else ""
        numbers, _ = coordinates(part.layout, part.mesh)
        names = (*part.phase.state_names, *part.phase.input_names)
        ends = {part.first: "start of ", part.last - part.layout.node: "end of "}
        whole = part.phase.x_bounds
        for i in range(part.first, part.last):
            entry = int(numbers[i - part.first])
            where = next((ends[i - n] for n in (entry,) if i - n in ends and entry < part.layout.nx), "")
            if where and (program.lower[i], program.upper[i]) == (whole[0][entry], whole[1][entry]):
                where = ""
            if weights[i]:
                yield i, f"{where}{names[entry]} {_side(program, i, weights[i], v[i])}{of_phase}"
        if part.duration >= 0:
            i = part.duration
            yield i, f"duration {_side(program, i, weights[i], v[i])}{of_phase}"
    for number, i in enumerate(range(program.parameters.start, program.parameters.stop)):
        yield i, f"p{number + 1} {_side(program, i, weights[i], v[i])}"


def _side(program: NonlinearProgram, i: int, weight: float, value: float) -> str:
    """Which bound of an unknown a multiplier is of, and the bound; where one is held besides, its value."""
    low, high = program.lower[i], program.upper[i]
    if high - low <= NEARLY * program.scale[i]:
        return f"= {high:.6g}"
    bound = high if weight > 0 else low
    if abs(bound - value) > HOLDS * program.scale[i]:
        return f"= {value:.6g}"
    return f"{'≤' if weight > 0 else '≥'} {bound:.6g}"
