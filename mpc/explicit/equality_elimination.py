"""Pairs of inequalities that make an equality, and their elimination: an exploration needs a set with an interior."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.linalg import null_space

from mpc.checks import Array
from mpc.exceptions import InputError
from mpc.parametric_qp import ParametricQP

Ints = np.ndarray[Any, np.dtype[np.int64]]


def equality_pairs(problem: ParametricQP) -> list[tuple[int, int]]:
    """Rows (i, j) with G_i = -G_j, S_i = -S_j and w_i = -w_j, up to their length."""
    rows = np.hstack([problem.G / np.sqrt(np.diag(problem.H)), problem.S, problem.w[:, None]])
    length = np.linalg.norm(rows[:, : problem.nz], axis=1)
    pairs, known = [], {}
    for i in np.flatnonzero(length > 0):
        row = np.round(rows[i] / length[i], 9) + 0.0
        known[row.tobytes()] = int(i)
        opposite = known.get((-row + 0.0).tobytes())
        if opposite is not None:
            pairs.append((opposite, int(i)))
    return pairs


def eliminate(problem: ParametricQP, pairs: list[tuple[int, int]]) -> tuple[ParametricQP, Array, Array, Ints]:
    """The problem in the free directions y of the equalities: z = N y + T [θ; 1].

    Returns
    -------
    reduced : ParametricQP
        Without the rows of the pairs.
    N, T : (nz, ny) and (nz, nt + 1) array
        How z follows.
    origin : int array
        Row of the original problem behind each row of the reduced one.

    Raises
    ------
    InputError
        The equalities leave no freedom in z, or restrict θ itself.
    """
    first = [i for i, _ in pairs]
    G, right = problem.G[first], np.hstack([problem.S[first], problem.w[first, None]])
    N: Array = np.asarray(null_space(G), dtype=np.float64)
    T: Array = np.asarray(np.linalg.lstsq(G, right, rcond=None)[0], dtype=np.float64)
    gap = float(np.abs(G @ T - right).max()) / max(1.0, float(np.abs(right).max()))
    if N.shape[1] == 0 or gap > 1e-9:
        raise InputError(
            f"the equality in constraints {pairs[0][0]} and {pairs[0][1]} "
            + ("leaves no input free" if gap <= 1e-9 else "cannot be met by the inputs for every parameter")
            + ": lengthen the horizon, or give the set a width."
        )
    Tt, tc = T[:, :-1], T[:, -1]
    dropped = {i for pair in pairs for i in pair}
    origin = np.array([i for i in range(problem.m) if i not in dropped], dtype=np.int64)
    p = problem.without(dropped)
    HT, cross = p.H @ Tt, Tt.T @ p.F
    reduced = replace(
        p, H=N.T @ p.H @ N, F=N.T @ (HT + p.F), f=N.T @ (p.H @ tc + p.f),
        Y=p.Y + Tt.T @ HT + cross + cross.T, y=p.y + Tt.T @ (p.H @ tc + p.f) + p.F.T @ tc,
        c=p.c + float(0.5 * tc @ p.H @ tc + p.f @ tc), G=p.G @ N, S=p.S - p.G @ Tt, w=p.w - p.G @ tc,
        Lz=p.Lz @ N, Lt=p.Lt + p.Lz @ Tt, l=p.l + p.Lz @ tc, Xz=p.Xz @ N, Xt=p.Xt + p.Xz @ Tt, x=p.x + p.Xz @ tc,
    )  # fmt: skip
    return reduced, N, T, origin
