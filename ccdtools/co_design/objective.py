"""The quadratic objective of a control co-design problem."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ccdtools.arrays import ArrayField
from ccdtools.exceptions import InputError


@dataclass(frozen=True, eq=False)
class QuadraticObjective:
    """Reward r = −x⁺ᵀ Q x⁺ − uᵀ R u, with x⁺ the *next* state.

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
        for name, strict in (("Q", False), ("R", True)):
            M = np.atleast_2d(np.array(getattr(self, name), dtype=float))
            if M.ndim != 2 or M.shape[0] != M.shape[1] or not np.isfinite(M).all():
                raise InputError(f"{name}: got shape {M.shape}, expected a square matrix of finite numbers.")
            if not np.allclose(M, M.T):
                raise InputError(f"{name}: got a matrix that is not symmetric, expected {name} = {name}ᵀ.")
            smallest = float(np.linalg.eigvalsh(M)[0])
            if smallest < -1e-12 * np.abs(M).max() or (strict and smallest <= 0):
                kind = "positive definite" if strict else "positive semidefinite"
                raise InputError(f"{name}: got smallest eigenvalue {smallest:.3g}, expected a {kind} matrix.")
            M.setflags(write=False)
            object.__setattr__(self, name, M)

    def rewards(self, x_next: Any, u: Any) -> Any:
        """Rewards (...,) of next states (..., nx) and inputs (..., nu); NumPy arrays or torch tensors."""
        if isinstance(x_next, np.ndarray):
            Q, R = self.Q, self.R
        else:
            Q, R = x_next.new_tensor(self.Q.tolist()), x_next.new_tensor(self.R.tolist())
        return -((x_next @ Q) * x_next).sum(-1) - ((u @ R) * u).sum(-1)
