"""Small dense linear programs: DAQP, with HiGHS as a second opinion where its answer does not check out.

DAQP reads raw memory, so every array handed to it here is a C-contiguous float64 array.

References
----------
Arnström, Bemporad, Axehill (2022), A dual active-set solver for embedded quadratic programming using
recursive LDLᵀ updates, IEEE Trans. Automatic Control 67(8).
"""

from __future__ import annotations

import daqp
import numpy as np

from invariant_sets.exceptions import NumericalError

Array = np.ndarray
_RESIDUAL = 1e-9  # accepted primal residual and duality gap, relative to the size of the data


def minimise(c: Array, A: Array, b: Array) -> tuple[float, Array | None]:
    """Return the least cᵀx over A x <= b and a minimiser.

    Parameters
    ----------
    c : (n,) array
        Cost.
    A : (m, n) array
        Rows of Euclidean norm near one.
    b : (m,) array
        Right-hand side, of order one.

    Returns
    -------
    value : float
        +inf if infeasible, −inf if unbounded.
    x : (n,) array or None
        A minimiser, None where there is none.
    """
    c, A, b = (np.ascontiguousarray(array, dtype=np.float64) for array in (c, A, b))
    if not c.any():
        return _from_highs(c, A, b)
    x, _, flag, info = daqp.solve(None, c, A, b, primal_tol=1e-10)
    if flag == 1:
        x = np.array(x)
        size = 1.0 + np.abs(x).max() + np.abs(b).max(initial=0.0)
        dual = np.asarray(info["lam"])
        residual = max((A @ x - b).max(initial=0.0), np.abs(c + A.T @ dual).max(),
                       abs(float(c @ x) + float(b @ dual)))
        if residual <= _RESIDUAL * size:
            return float(c @ x), x
    return _from_highs(c, A, b)


def _from_highs(c: Array, A: Array, b: Array) -> tuple[float, Array | None]:
    from scipy.optimize import linprog

    for method in ("highs-ds", "highs-ipm"):
        answer = linprog(c, A_ub=A, b_ub=b, bounds=(None, None), method=method,
                         options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10})
        if answer.status == 0:
            return float(answer.fun), np.asarray(answer.x)
        if answer.status in (2, 3):
            zero = linprog(0 * c, A_ub=A, b_ub=b, bounds=(None, None), method="highs-ds")
            return (np.inf if zero.status == 2 else -np.inf), None
    if _has_ray(c, A) and inscribed_ball(A, b, cap=1.0)[0] >= 0:
        return -np.inf, None
    raise NumericalError(f"A linear program with {A.shape[0]} rows in {A.shape[1]} variables could not be "
                         f"solved by DAQP or HiGHS ({answer.message}). Rescale the data.")


def _has_ray(c: Array, A: Array) -> bool:
    """Return whether cᵀd < 0 for some d with A d <= 0: HiGHS gives up on some unbounded programs of a narrow cone."""
    from scipy.optimize import linprog

    ray = linprog(c, A_ub=A, b_ub=np.zeros(len(A)), bounds=(-1.0, 1.0), method="highs-ds",
                  options={"primal_feasibility_tolerance": 1e-10})
    return bool(ray.status == 0 and ray.fun < -1e-6 * np.abs(c).max())


def maximise_rows(D: Array, A: Array, b: Array) -> Array:
    """Return the (k,) maxima of the rows of D over A x <= b: +inf unbounded, −inf if empty."""
    return np.array([-minimise(-d, A, b)[0] for d in np.atleast_2d(D)])


def inscribed_ball(A: Array, b: Array, cap: float) -> tuple[float, Array]:
    """Return radius and centre of a largest ball in A x <= b (rows of unit norm), the radius at most `cap`.

    A negative radius is the least violation that every point must accept: the set is empty.
    """
    n = A.shape[1]
    rows = np.hstack([A, np.ones((A.shape[0], 1))])
    limit = np.zeros((1, n + 1))
    limit[0, n] = 1.0
    cost = np.zeros(n + 1)
    cost[n] = -1.0
    value, x = minimise(cost, np.vstack([rows, limit]), np.append(b, cap))
    if x is None:
        raise NumericalError("The largest inscribed ball could not be computed. Rescale the data.")
    return -value, x[:n]
