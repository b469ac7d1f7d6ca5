"""The linear law that stands in where a nonlinear plan is missing."""

from __future__ import annotations

import numpy as np

from mpc.checks import Array
from mpc.exceptions import NotStabilisableError
from mpc.linear_mpc import LinearMPC
from mpc.optimal_control.condensing import gains_along


def gain_at_rest(law: LinearMPC) -> Array:
    """Gain (nu, nx) of the regulator of the linearisation; where there is none, of its first step of the horizon.

    Vehicles that cannot move sideways are such: at rest their linearisation cannot be stabilised.
    """
    try:
        return law.gain
    except NotStabilisableError:
        A, B = (np.tile(matrix, (law.horizon, 1, 1)) for matrix in (law.A, law.B))
        S = np.zeros((law.nx, law.nu)) if law.S is None else law.S
        weights = (np.array(weight, order="C") for weight in (law.Q, law.R, S, law.P))
        gains, _ = gains_along(A, B, *weights)
        return np.asarray(gains[0])
