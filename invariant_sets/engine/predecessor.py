"""The states from which some input reaches a set in one step.

References
----------
Blanchini, Miani (2015), Set-Theoretic Methods in Control, 2nd ed., section 5.1 and algorithm 5.1.
"""

from __future__ import annotations

import numpy as np

from invariant_sets.projection import eliminate_last, project_rows, unit
from invariant_sets.time_limits import NO_DEADLINE, Deadline

Array = np.ndarray
Rows = tuple[Array, Array]


def predecessor_rows(target: Rows, A: Array, B: Array, joint: Rows, *, fresh: Array | None = None,
                     deadline: Deadline = NO_DEADLINE) -> Rows:
    """Return unit rows (R, r) of {x : some u with H [x; u] <= h has F (A x + B u) <= g}.

    Parameters
    ----------
    target : (F, g)
        The target set, already tightened by the disturbance; unit rows.
    A, B : (n, n) and (n, nu) arrays
        Dynamics.
    joint : (H, h)
        Constraints on state and input together.
    fresh : (m,) bool array, optional
        Rows of the target that are new since the last call. With one input, only what follows from these is
        returned: a recursion that only shrinks its set has the rest already.
    deadline : Deadline
        When to stop.

    Notes
    -----
    Assumes coordinates of order one (scale by the bounding boxes first). Redundant rows are removed between
    the inputs, not after the last one. A set without points gives the row 0 x <= −1.
    """
    F, g = target
    H, h = joint
    nu = B.shape[1]
    R = np.vstack([np.hstack([F @ A, F @ B]), H])
    r = np.append(g, h)
    if nu == 1:
        R, r = unit(R, r)
        return eliminate_last(R, r, None if fresh is None else np.append(fresh, np.zeros(len(h), bool)))
    return project_rows(R, r, R.shape[1] - nu, deadline=deadline)
