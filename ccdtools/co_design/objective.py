"""The quadratic objective of a control co-design problem."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ccdtools.arrays import ArrayField, Immutable
from ccdtools.checks import as_weight


@dataclass(frozen=True, eq=False, repr=False)
class QuadraticObjective(Immutable):
    """Reward r = −x⁺ᵀ Q x⁺ − uᵀ R u, with x⁺ the *next* state.

    A subclass may override `rewards`; it must then take NumPy arrays and torch tensors alike, and Q and R remain the
    weights of the LQR and MPC that it is compared with.

    Parameters
    ----------
    Q : (nx, nx) array_like
        State weight, symmetric positive semidefinite.
    R : (nu, nu) array_like
        Input weight, symmetric positive definite.

    Raises
    ------
    InputError
        If a weight is not square, not symmetric, not finite or not definite as stated.
    """

    Q: ArrayField
    R: ArrayField

    def __post_init__(self) -> None:
        object.__setattr__(self, "Q", as_weight("Q", self.Q))
        object.__setattr__(self, "R", as_weight("R", self.R, definite=True))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self.Q)} states, {len(self.R)} inputs)"

    def rewards(self, x_next: Any, u: Any) -> Any:
        """Rewards (...,) of next states (..., nx) and inputs (..., nu); NumPy arrays or torch tensors."""
        Q = self.Q
        R = self.R
        if not isinstance(x_next, np.ndarray):
            Q = x_next.new_tensor(Q.tolist())
            R = x_next.new_tensor(R.tolist())
        return -((x_next @ Q) * x_next).sum(-1) - ((u @ R) * u).sum(-1)
