"""The terminal set of a nonlinear MPC from its linearisation."""

from __future__ import annotations

import numpy as np

from invariant_sets import Polytope, maximal_positively_invariant_set
from mpc.exceptions import InputError
from mpc.linear_mpc import LinearMPC

INVARIANT = "invariant"


def invariant_set(law: LinearMPC) -> Polytope:
    """The largest set of states from which the regulator u = -Kx keeps X and U for ever, on the linearisation.

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
