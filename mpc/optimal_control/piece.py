"""A piece of a program: one function of a few unknowns, at many places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from mpc.checks import Array

Numbers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Piece:
    """One function of a few unknowns, at M places; each of its values is added to one row of [f; g].

    Attributes
    ----------
    function : casadi.Function
        (z (n,), data (d,)) → values (k,).
    unknowns : (n, M) array
        Which of all they are.
    data : (d, M) array
    rows : (k, M) array
        Where the values go: 0 is the cost f, 1 + i constraint i.
    factors : (k,) array
        That they are multiplied by.
    """

    function: ca.Function
    unknowns: Numbers
    data: Array
    rows: Numbers
    factors: Array

    @property
    def places(self) -> int:
        """M."""
        return int(self.unknowns.shape[1])

    @property
    def of_cost(self) -> NDArray[np.bool_]:
        """Which values (k,) are added to the cost."""
        return np.asarray(self.rows[:, 0] == 0)

    @cached_property
    def parts(self) -> dict[bool, ca.Function]:
        """Functions of the values that are added to the cost, and of the others."""
        z, data = self.symbols
        value = self.function(z, data)
        found = {of_cost: value[listed(self.of_cost == of_cost)] for of_cost in (True, False)}
        return {key: ca.Function("part", [z, data], [part], {"cse": True}) for key, part in found.items()}

    @property
    def symbols(self) -> tuple[Any, Any]:
        """z and data, of the kind of the function."""
        kind: Any = ca.SX if self.function.is_a("SXFunction") else ca.MX
        return kind.sym("z", self.unknowns.shape[0]), kind.sym("data", self.data.shape[0])

    def mapped(self, function: ca.Function, *columns: Any) -> Sequence[Any]:
        """Results of a function of columns, one a place."""
        found = function.map(self.places)(*columns) if self.places > 1 else function(*columns)
        return found if isinstance(found, list | tuple) else [found]

    def gathered(self, v: Any) -> Any:
        """Unknowns (n, M) out of those of all."""
        return ca.reshape(v[self.unknowns.ravel(order="F").tolist()], *self.unknowns.shape)


def listed(chosen: NDArray[np.bool_]) -> list[int]:
    """The numbers of what is chosen."""
    return [int(i) for i in np.flatnonzero(chosen)]
