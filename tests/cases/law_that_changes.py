"""An unstable law of linear MPC, and how its model changes with parameters."""

import numpy as np

A = np.array([[1.0, 0.1], [0.05, 1.1]])
B = np.array([[0.005], [0.1]])
E = np.array([[0.0], [0.1]])
STATEMENT = {"Q": [1.0, 0.1], "R": 0.1, "horizon": 12}
START = np.array([0.4, -0.25])


def family(seed, count=3):
    """How A, B and E change with parameters."""
    rng = np.random.default_rng(seed)
    return {f"d{name}": 0.1 * np.abs(M).max() * rng.normal(size=(*M.shape, count)) for name, M in
            (("A", A), ("B", B), ("E", E))}  # fmt: skip
