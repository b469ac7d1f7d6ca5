"""Inputs that keep the state on a flat affine hull.

References
----------
Basile, Marro (1969), Controlled and conditioned invariant subspaces in linear system theory, JOTA 3(5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from invariant_sets.interior_form import normals
from invariant_sets.tolerances import NEGLIGIBLE, TINY

Array = np.ndarray


@dataclass(frozen=True)
class InputMap:
    """Input map u = offset + states y + inputs v."""

    offset: Array
    states: Array
    inputs: Array

    def about(self, y: Array, v: Array) -> InputMap:
        """Map with y and v counted from this point."""
        return InputMap(self.offset + self.states @ y + self.inputs @ v, self.states, self.inputs)


@dataclass(frozen=True)
class Motion:
    """Motion x⁺ − centre = states y + inputs v + drift, with joint rows."""

    # where the state goes, in the units of x
    states: Array  # (n, k)
    inputs: Array  # (n, q)
    drift: Array  # (n,)
    # constraints on both together
    state_rows: Array  # (m, k)
    input_rows: Array  # (m, q)
    right: Array  # (m,)
    input_map: InputMap  # the input that belongs to y and v


def stay_on_hull(motion: Motion, basis: Array, spread: Array | None,
                 size: Array) -> Motion | tuple[Array, Array] | None:
    """Motion under the inputs that keep the state on the hull of `basis`, or why there are none.

    Equalities rows y = values come where y has to meet them before any input can, None where no y can. `spread` (k, n)
    are the vertices of the disturbance about its mean, `size` (n,) what counts as one in each coordinate of x. A
    disturbance that leaves the hull leaves nothing.
    """
    normal = normals(basis)
    P = normal @ motion.states
    Q = normal @ motion.inputs
    s = -normal @ motion.drift
    size = np.maximum(np.maximum(np.abs(normal) @ size, np.abs(s)), TINY)
    if spread is not None and (np.abs(spread @ normal.T).max(axis=0) > NEGLIGIBLE * np.maximum(
            size, np.abs(spread).max() + TINY)).any():
        return None
    P = P / size[:, None]
    Q = Q / size[:, None]
    s = s / size
    left, values, vt = np.linalg.svd(Q, full_matrices=True)
    rank = int((values > NEGLIGIBLE).sum())
    rest_P = left[:, rank:].T @ P
    rest_s = left[:, rank:].T @ s
    bound = np.abs(rest_P).max(axis=1, initial=0.0) > NEGLIGIBLE
    if (np.abs(rest_s[~bound]) > NEGLIGIBLE).any():
        return None
    if bound.any():
        return rest_P[bound], rest_s[bound]
    pseudo = vt[:rank].T @ (left[:, :rank].T / values[:rank, None])  # v = pseudo (s − P y) + free v'
    fixed = pseudo @ s
    follow = -pseudo @ P
    free = vt[rank:].T
    law = motion.input_map
    return Motion(
        states=motion.states + motion.inputs @ follow, inputs=motion.inputs @ free,
        drift=motion.drift + motion.inputs @ fixed, state_rows=motion.state_rows + motion.input_rows @ follow,
        input_rows=motion.input_rows @ free, right=motion.right - motion.input_rows @ fixed,
        input_map=InputMap(law.offset + law.inputs @ fixed, law.states + law.inputs @ follow, law.inputs @ free))
