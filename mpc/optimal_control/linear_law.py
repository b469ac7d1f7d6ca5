"""Linear law at rest, its gain and terminal set."""

from __future__ import annotations

import numpy as np

from invariant_sets import Polytope, maximal_positively_invariant_set
from mpc.checks import Array
from mpc.exceptions import InputError, NotStabilisableError
from mpc.linear_mpc import LinearMPC
from mpc.optimal_control.condensing import gains_along

INVARIANT = "invariant"


def gain_at_rest(law: LinearMPC) -> Array:
    """Gain (nu, nx) of the regulator, else of the horizon's first step.

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


def invariant_set(law: LinearMPC) -> Polytope:
    """Largest set in which the linearisation keeps X and U under u = -Kx.

    Raises
    ------
    InputError
        There are no limits, or the computation found no such set; the message says why.
    """
    (HX, hX), (HU, hU) = law.state_rows, law.input_rows
    if not len(hX) + len(hU):
        raise InputError("terminal_set", repr(INVARIANT), "a set, or None", "Without X and U every state is in it.")
    both = Polytope(np.vstack([HX, -HU @ law.gain]), np.concatenate([hX, hU]))
    found = maximal_positively_invariant_set(law.A - law.B @ law.gain, both)
    if found.set.is_empty:
        got = f"{INVARIANT!r}, of which none was found ({found.status.name})"
        raise InputError("terminal_set", got, "one about the origin", found.status.advice)
    return found.set
