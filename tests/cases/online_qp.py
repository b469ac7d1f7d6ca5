"""The QP of one parameter, solved by DAQP as it is called in its manual: nothing here comes from `mpc`."""

import daqp
import numpy as np


def minimiser(problem, theta):
    """Return z that minimises ½ z'Hz + q'z subject to Gz <= b at the parameter, or None where nothing does.

    Rows are scaled to length one; rows that no variable reaches are looked at by hand.
    """
    q, b = problem.at(theta)
    length = np.linalg.norm(problem.G, axis=1)
    if (b[length == 0] < 0).any():
        return None
    rows = length > 0
    G, b = problem.G[rows] / length[rows, None], b[rows] / length[rows]
    if not len(b):
        return np.linalg.solve(problem.H, -q)
    sense = np.zeros(len(b), dtype=np.int32)
    z, _, flag, _ = daqp.solve(np.array(problem.H), q, G, b, np.full(len(b), -1e30), sense, primal_tol=1e-9)
    assert flag in (1, -1)
    return z if flag == 1 else None
