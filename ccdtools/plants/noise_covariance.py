"""The covariance that white noise adds to the states in a sample, symbolic in the design."""

from __future__ import annotations

import casadi as ca
from numpy.typing import ArrayLike

from ccdtools.checks import as_instance, as_positive, as_weight
from ccdtools.exceptions import InputError
from ccdtools.plants.plant import Plant, linear_matrices
from ccdtools.plants.zero_order_hold import TAYLOR_DEGREE, balanced, expm


def noise_covariance(plant: Plant, intensity: ArrayLike, dt: float | None = None) -> ca.Function:
    """∫₀^dt e^{Aτ} E S Eᵀ e^{Aᵀτ} dτ: the covariance of what continuous white noise w adds to the states in a sample.

    A disturbance that is held over a sample adds E(p) W E(p)ᵀ instead, with the discrete E and its covariance W.

    Parameters
    ----------
    plant : Plant
        Continuous, linear in x, u and w.
    intensity : (nw, nw) array_like
        S, the two-sided spectral density of w, in its unit squared per Hz.
    dt : float, optional
        Sampling time [s]; the plant's own by default.

    Returns
    -------
    casadi.Function
        p (np,) → (nx, nx).

    Raises
    ------
    InputError
        If the plant is discrete or nonlinear, or S is not symmetric and positive semidefinite.

    References
    ----------
    Van Loan, "Computing integrals involving the matrix exponential", IEEE TAC 23(3), 1978. Its one exponential holds
    e^{−A dt}, which overflows for stiff plants; here the integral of a short time is doubled, Q(2h) = Q(h) + Φ Q(h) Φᵀ.
    """
    as_instance("plant", plant, Plant, "a Plant")
    if not plant.continuous:
        raise InputError("plant", "a discrete plant", "a continuous one", "Its noise is E(p) W E(p)ᵀ.")
    S = as_weight("intensity", intensity, plant.nw)
    dt = as_positive("dt", plant.dt if dt is None else dt, unit="s")
    A, _, E, _ = linear_matrices(plant)
    scale, squarings = balanced(A * dt, symbols=plant.p, design=plant.design)
    D = ca.diag(ca.DM(scale))
    D_inv = ca.diag(ca.DM(1 / scale))
    h = dt / 2.0**squarings
    own = D_inv @ A @ D * h
    term = D_inv @ E @ ca.DM(S) @ E.T @ D_inv * h
    Q = term
    for k in range(2, TAYLOR_DEGREE + 2):
        term = (own @ term + term @ own.T) / k
        Q = Q + term
    transition = expm(own, squarings=0)
    for _ in range(squarings):
        Q = Q + transition @ Q @ transition.T
        transition = transition @ transition
    Q = D @ (Q + Q.T) @ D / 2
    return ca.Function("noise_covariance", [plant.p], [ca.densify(Q)], ["p"], ["Q"])
