"""Modes of a pair (A, B) and how strongly they are reached."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from scipy.linalg import matrix_balance

from mpc.checks import Array
from mpc.tolerances import REACH


class Mode(NamedTuple):
    """Mode of A: eigenvalue, strength [-] and |w| (nx,) of its left vector."""

    eigenvalue: complex
    strength: float
    parts: Array

    @property
    def value(self) -> str:
        """Eigenvalue in four digits."""
        real = abs(self.eigenvalue.imag) < REACH
        return f"{self.eigenvalue.real:.4g}" if real else f"{self.eigenvalue:.4g}"


def least_reached(A: Array, B: Array, eigenvalues: Iterable[complex], *units: Array) -> Mode:
    """Mode reached least at some eigenvalues; infinitely strong without eigenvalues.

    How strongly is σ_min [A - λI, B] relative to A, for columns of B as large as A: how strong an actuator is, is a
    matter of its cost. It depends on the units of the states: of given ones, and of those that balance A, those count
    in which it is largest.

    References
    ----------
    Hautus, *Controllability and observability conditions of linear autonomous systems*, 1969.
    """
    found = []
    scaled = [_relative(A, B, own) for own in units_of(A, *units)]
    for eigenvalue in eigenvalues:
        best = Mode(complex(eigenvalue), -1.0, np.ones(len(A)))
        for (F, G), size in scaled:
            U, strengths, _ = np.linalg.svd(np.hstack([F - eigenvalue * np.eye(len(F)), G]))
            if strengths[-1] / size > best.strength:
                best = Mode(complex(eigenvalue), float(strengths[-1] / size), np.abs(U[:, -1]))
        found.append(best)
    return min(found, key=lambda mode: mode.strength, default=Mode(complex(np.nan), np.inf, np.ones(len(A))))


def units_of(A: Array, *units: Array) -> Iterator[Array]:
    """Factors (nx,) of the states: `units`, then those that balance A."""
    yield from units
    yield 1 / np.asarray(matrix_balance(A, permute=False, separate=True)[1][0])


def _relative(A: Array, B: Array, unit: Array) -> tuple[tuple[Array, Array], float]:
    """Scaled A and B, and the size of A, at least one."""
    F = A * unit[:, None] / unit
    G = B * unit[:, None]
    size = max(1.0, float(np.linalg.norm(F, 2)))
    length = np.linalg.norm(G, axis=0)
    return (F, G * size / np.where(length > 0, length, 1.0)), size
