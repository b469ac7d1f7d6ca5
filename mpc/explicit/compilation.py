"""Compiles the exploration of explicit laws before a clock runs: half a minute after an installation, once."""

from __future__ import annotations

from functools import cache

import numpy as np

from mpc.explicit.exploration import Limits, explore_compiled
from mpc.explicit.scaled_qp import ParameterSet, scale_qp
from mpc.parametric_qp import Constraint, ParametricQP


@cache
def compile_exploration() -> None:
    """Explore min ½ z'z − θ'z over the square |z| ≤ 1, whose nine regions take every kernel through its work.

    numba keeps what it has compiled on disk; a later process reads it in a second.
    """
    one, none = np.eye(2), np.zeros((2, 2))
    rows = np.vstack([one, -one])
    square = ParametricQP(
        H=one, F=-one, f=np.zeros(2), Y=none, y=np.zeros(2), c=0.0, G=rows, w=np.ones(4), S=np.zeros((4, 2)), Lz=one,
        Lt=none, l=np.zeros(2), Xz=none, Xt=one, x=np.zeros(2), nu=2, parameters=(("x", 2),),
        labels=tuple(Constraint("input", 0, i) for i in range(4)),
    )  # fmt: skip
    twice = ParameterSet(rows, np.ones(4), np.zeros(2), np.full(2, 2.0))
    explore_compiled(scale_qp(square, twice), Limits(100, np.inf))
