"""Pieces of one function become one piece: scenarios that differ in data, or in the constants of their functions."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from mpc.optimal_control.pieces import Piece

CONSTANT = re.compile(r"^(@\d+ = )[-+.\deinfa]+;$", re.MULTILINE)  # an instruction as CasADi prints it


def merged(pieces: Sequence[Piece]) -> tuple[Piece, ...]:
    """The pieces, with those of one function and the same factors as one.

    Then those of scalar instructions that differ in constants and factors alone: these become data. Constants that are
    the same everywhere, such as 0 and 1, stay, and with them what is known of derivatives that vanish.
    """
    same = _grouped(pieces, lambda piece: (_written(piece.function), piece.factors.tobytes(), piece.of_cost.tobytes()))
    alike = _grouped([_as_one(group) for group in same], _kind)
    found: list[Piece] = []
    for group in alike:
        found += [_lifted(few) for few in _grouped(group, _structure)] if len(group) > 1 else group
    return tuple(found)


def _grouped(pieces: Sequence[Piece], key: Callable[[Piece], Any]) -> list[list[Piece]]:
    """The pieces of each key."""
    groups: dict[Any, list[Piece]] = {}
    for piece in pieces:
        groups.setdefault(key(piece), []).append(piece)
    return list(groups.values())


def _as_one(group: list[Piece]) -> Piece:
    """One piece at the places of all."""
    if len(group) == 1:
        return group[0]
    unknowns, data, rows = (np.hstack([getattr(one, name) for one in group]) for name in ("unknowns", "data", "rows"))
    return Piece(group[0].function, unknowns, data, rows, group[0].factors)


def _written(function: ca.Function) -> Any:
    """What two functions have in common if they are the same."""
    try:
        return function.serialize()
    except RuntimeError:  # of a function that is no expression
        return id(function)


def _kind(piece: Piece) -> Any:
    """What pieces have in common that may differ in constants alone."""
    function = piece.function
    if not function.is_a("SXFunction"):
        return id(piece)
    return function.n_instructions(), len(piece.unknowns), len(piece.data), piece.of_cost.tobytes()


def _structure(piece: Piece) -> str:
    """The instructions of a function, without the values of constants."""
    return str(CONSTANT.sub(r"\1#", piece.function.str(True)))


def _lifted(group: list[Piece]) -> Piece:
    """One piece of functions that differ in constants and factors, which become data."""
    if len(group) == 1:
        return group[0]
    first = group[0]
    at = [i for i in range(first.function.n_instructions()) if first.function.instruction_id(i) == ca.OP_CONST]
    constants = np.array([[piece.function.instruction_constant(i) for i in at] for piece in group])
    factors = np.array([piece.factors for piece in group])
    own, weighed = (np.flatnonzero((values != values[0]).any(axis=0)) for values in (constants, factors))
    given = np.hstack([constants[:, own], factors[:, weighed]])
    function = _replayed(first, [at[i] for i in own], weighed.tolist())
    ones = first.factors.copy()
    ones[weighed] = 1.0
    return _as_one([
        Piece(function, piece.unknowns, np.vstack([piece.data, np.tile(values[:, None], (1, piece.places))]),
              piece.rows, ones)
        for piece, values in zip(group, given)
    ])  # fmt: skip


def _replayed(piece: Piece, constants: list[int], factors: list[int]) -> ca.Function:
    """The function of a piece, with the constants of some instructions and the factors of some values as data."""
    function, start = piece.function, len(piece.data)
    z, data = ca.SX.sym("z", len(piece.unknowns)), ca.SX.sym("data", start + len(constants) + len(factors))
    place = {i: start + k for k, i in enumerate(constants)}
    weight = {i: start + len(constants) + k for k, i in enumerate(factors)}
    work: list[Any] = [ca.SX(0)] * function.sz_w()
    values: list[Any] = [ca.SX(0)] * len(piece.factors)
    for i in range(function.n_instructions()):
        kind, into, of = function.instruction_id(i), function.instruction_output(i), function.instruction_input(i)
        if kind == ca.OP_INPUT:
            work[into[0]] = (z, data)[of[0]][of[1]]
        elif kind == ca.OP_OUTPUT:
            entry = into[1]
            values[entry] = work[of[0]] * data[weight[entry]] if entry in weight else work[of[0]]
        elif kind == ca.OP_CONST:
            work[into[0]] = data[place[i]] if i in place else ca.SX(function.instruction_constant(i))
        elif len(of) == 1:
            work[into[0]] = ca.SX.unary(kind, work[of[0]])
        else:
            work[into[0]] = ca.SX.binary(kind, work[of[0]], work[of[1]])
    return ca.Function("piece", [z, data], [ca.densify(ca.vertcat(*values))], ["z", "data"], ["value"], {"cse": True})
