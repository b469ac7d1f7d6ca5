"""Matrix exponential that is symbolic in the design, and inputs held between samples.

References
----------
Moler and Van Loan, "Nineteen dubious ways …, twenty-five years later", SIAM Review 45, 2003, method 3
(scaling and squaring), after balancing.
"""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
from scipy.linalg import matrix_balance

from ccdtools.arrays import Array
from ccdtools.plants.design_space import DesignSpace, sample_designs
from ccdtools.plants.tolerances import TAYLOR_DEGREE


def zero_order_hold(
    A: ca.SX, B: ca.SX, E: ca.SX, dt: float, *, symbols: ca.SX, design: DesignSpace | None
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Discrete A, B, E: exp([[A, B, E], [0, 0, 0]] dt) in `symbols`."""
    nx = A.shape[0]
    inputs = B.shape[1] + E.shape[1]
    M = ca.SX(nx + inputs, nx + inputs)
    M[:nx, :] = ca.horzcat(A, B, E) * dt
    F = exponential(M, symbols=symbols, design=design)
    return F[:nx, :nx], F[:nx, nx : nx + B.shape[1]], F[:nx, nx + B.shape[1] :]


def exponential(M: ca.SX, *, symbols: ca.SX, design: DesignSpace | None) -> ca.SX:
    """exp(M) of a matrix symbolic in the design."""
    scale, squarings = balanced(M, symbols=symbols, design=design)
    D = ca.diag(ca.DM(scale))
    D_inv = ca.diag(ca.DM(1 / scale))
    return D @ expm(D_inv @ M @ D, squarings=squarings) @ D_inv


def balanced(M: ca.SX, *, symbols: ca.SX, design: DesignSpace | None) -> tuple[Array, int]:
    """Diagonal similarity d (n,) and halvings for ‖D⁻¹ M D‖ ≤ 1/2.

    One fixed similarity for the whole box is symbolic in p, and keeps the norm, hence the rounding, small.
    """
    function = ca.Function("M", [symbols], [ca.densify(M)])
    samples = np.array([np.asarray(function(p), dtype=float) for p in sample_designs(design)])
    _, (scale, _) = matrix_balance(np.max(np.abs(samples), axis=0), permute=False, separate=True)
    norm = max(float(np.linalg.norm(S / scale[:, None] * scale[None, :], 1)) for S in samples)
    return scale, max(0, math.ceil(math.log2(max(norm, np.finfo(float).tiny))) + 2)


def expm(M: ca.SX, *, squarings: int) -> ca.SX:
    """exp(M) by Taylor expansion and s squarings; accurate for ‖M‖₁ ≤ 2ˢ⁻¹."""
    eye = ca.SX.eye(M.shape[0])
    S = M / 2.0**squarings
    F = eye
    for k in range(TAYLOR_DEGREE, 0, -1):
        F = eye + (S @ F) / k
    for _ in range(squarings):
        F = F @ F
    return F
