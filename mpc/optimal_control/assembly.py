"""Collection of the parts of a nonlinear program."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from mpc.checks import Array
from mpc.optimal_control.derivatives import Derivatives
from mpc.optimal_control.interval import size_of
from mpc.optimal_control.notes import check_at_guess
from mpc.optimal_control.pieces import Numbers, Piece
from mpc.optimal_control.problem import OptimalControlProblem
from mpc.optimal_control.program import NonlinearProgram, PhasePart, Rows, with_costs_of_scenarios, with_sizes_of_rows


class Assembly:
    """Collection of unknowns, constraints and pieces."""

    def __init__(self) -> None:
        self.lower: list[Array] = []
        self.upper: list[Array] = []
        self.guess: list[Array] = []
        self.scale: list[Array] = []
        self.kinds: list[Rows] = []
        self.bounds: list[tuple[Array, Array, Array]] = []
        self.pieces: list[Piece] = []
        self.height = 0

    @property
    def width(self) -> int:
        """Number of unknowns so far."""
        return sum(map(len, self.lower))

    def unknown(self, lower: Array, upper: Array, guess: Array, scale: Array | None = None) -> None:
        """Append unknowns."""
        self.lower.append(lower)
        self.upper.append(upper)
        self.guess.append(guess)
        self.scale.append(size_of(lower, upper, guess) if scale is None else scale)

    def piece(self, function: ca.Function, unknowns: Numbers, rows: Numbers, factors: Array,
              data: Array | None = None) -> None:  # fmt: skip
        """Append a piece."""
        given = np.zeros((0, unknowns.shape[1])) if data is None else data
        self.pieces.append(Piece(function, unknowns, given, rows, factors))

    def rows(self, name: str, phase: int, entries: Sequence[str], points: int, low: Any, high: Any, scale: Any,
             fractions: Any) -> slice:  # fmt: skip
        """Append constraints `entries` at so many points; return their places."""
        count = len(entries) * points
        first, last = self.height, self.height + count
        low, high, scale, places = (
            np.array(np.broadcast_to(np.asarray(b, dtype=float), (count,))) for b in (low, high, scale, fractions)
        )
        self.bounds.append((low, high, scale))
        if count:
            self.kinds.append(Rows(name, phase, first, last, places, tuple(entries)))
        self.height = last
        return slice(first, last)

    def program(self, problem: OptimalControlProblem, parts: tuple[PhasePart, ...], parameters: slice,
                costs: slice) -> NonlinearProgram:  # fmt: skip
        """Program collected, sized at the guess."""
        none = [np.zeros(0)]
        low, high, scale = (np.concatenate([sides[i] for sides in self.bounds] + none) for i in range(3))
        derivatives = Derivatives(self.pieces, self.width, self.height)
        v = ca.MX.sym("v", self.width)
        f, g = derivatives.expressions(v)
        program = NonlinearProgram(
            problem=problem,
            v=v,
            f=f,
            g=g,
            lower=np.concatenate(self.lower),
            upper=np.concatenate(self.upper),
            guess=np.concatenate(self.guess),
            scale=np.concatenate(self.scale),
            row_lower=low,
            row_upper=high,
            row_scale=scale,
            rows=tuple(self.kinds),
            parts=parts,
            parameters=parameters,
            costs=costs,
            derivatives=derivatives,
        )
        check_at_guess(program)
        return with_sizes_of_rows(with_costs_of_scenarios(program))
