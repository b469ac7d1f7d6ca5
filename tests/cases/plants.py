"""Plants the tests share."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from scipy.linalg import expm


def box(half):
    """Any object with `.A` and `.b` is a set to `mpc`."""
    half = np.atleast_1d(np.asarray(half, dtype=float))
    eye = np.eye(len(half))
    return SimpleNamespace(A=np.vstack([eye, -eye]), b=np.concatenate([half, half]))


def double_integrator():
    return np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])


def suspension(ks=27692.0, cs=1906.5, dt=0.05):
    """Quarter car in SI units, zero-order hold."""
    ms, mu, kt = 325.0, 65.0, 232.5e3
    A = np.array(
        [[0, 1, 0, 0], [-kt / mu, -cs / mu, ks / mu, cs / mu], [0, -1, 0, 1], [0, cs / ms, -ks / ms, -cs / ms]]
    )
    B = np.array([[0.0], [-1 / mu], [0.0], [1 / ms]])
    E = np.array([[-1.0], [0.0], [0.0], [0.0]])
    block = np.zeros((6, 6))
    block[:4, :4], block[:4, 4:5], block[:4, 5:] = A, B, E
    M = expm(block * dt)
    return M[:4, :4], M[:4, 4:5], M[:4, 5:]


SUSPENSION = dict(
    Q=np.diag([10.0, 1.0, 50.0, 5.0]), R=[[1e-6]], X=box([0.25, 2.5, 0.5, 2.5]), U=box([1000.0])
)  # fmt: skip
