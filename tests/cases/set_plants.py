"""The two case studies, the reference figures that their sets must meet, and a small unstable plant with its sets."""

import numpy as np
from scipy.linalg import expm

from invariant_sets import Polytope

ILLUSTRATIVE_X = Polytope.from_bounds([-10, -5], [5, 2])
ILLUSTRATIVE_U = Polytope.from_bounds([-1], [1])
SUSPENSION_X = Polytope.from_bounds([-0.25, -2.5, -0.5, -2.5], [0.25, 2.5, 0.5, 2.5])
SUSPENSION_U = Polytope.from_bounds([-1000], [1000])
A, B = np.array([[1.2, 0.5], [0.0, 0.8]]), np.array([[0.5], [1.0]])  # the small plant: one mode grows
STABLE = 0.5 * A
X = Polytope.from_bounds([-5, -5], [5, 5])
U = Polytope.from_bounds([-1], [1])
W = Polytope.from_bounds([-0.1, -0.1], [0.1, 0.1])


def illustrative(p):
    """Return A and B(p) of the illustrative example."""
    return np.array([[0.8, 0.5], [0.5, 0.6]]), np.array([[0.5], [float(np.ravel(p)[0])]])


def suspension(p):
    """Return A(p) and B(p) of the quarter car, exact zero-order hold at 0.05 s."""
    spring, damper = p
    body, wheel, tyre = 325.0, 65.0, 232.5e3
    M = np.zeros((5, 5))
    M[:4, :4] = [
        [0, 1, 0, 0],
        [-tyre / wheel, -damper / wheel, spring / wheel, damper / wheel],
        [0, -1, 0, 1],
        [0, damper / body, -spring / body, -damper / body],
    ]
    M[:4, 4] = [0, -1 / wheel, 0, 1 / body]
    M = expm(M * 0.05)
    return M[:4, :4], M[:4, 4:]
