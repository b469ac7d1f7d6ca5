"""Radau IIA collocation over one held sample."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.plants.budgets import NEWTON_ITERATIONS
from ccdtools.plants.casadi_arrays import Vectorised, check_sizes
from ccdtools.plants.tolerances import CLOSE, CONVERGED, STAGES, STALLED


class ImplicitStep:
    """Implicit step (x, u, w, p) → x⁺ by collocation, for all runs at once.

    Z_i = x + h Σ_j a_ij f(Z_j), x⁺ = Z_3, of each of `substeps` equal parts. A run for which Newton's method does not
    converge gets NaN. `scale` (nx,) is the extent of each state, for tolerances. Single precision is stepped in double.

    References
    ----------
    Hairer and Wanner, "Solving ordinary differential equations II", 2nd ed., 1996, section IV.5 and table 5.6.
    """

    def __init__(self, f: ca.Function, dt: float, substeps: int, scale: Array | None = None) -> None:
        self.f = f
        self.dt = dt
        self.substeps = substeps
        self.weights = radau_weights()
        self.scale = np.ones(f.numel_out(0)) if scale is None else scale
        arguments = f.sx_in()
        J = ca.jacobian(f(*arguments), arguments[0])
        self._dynamics = Vectorised(f)
        self._jacobian = Vectorised(ca.Function("jacobian", arguments, [ca.densify(ca.vec(J.T))]))  # ∂f/∂x by rows

    @cached_property
    def function(self) -> ca.Function:
        """The step by CasADi's Newton solver, differentiable (implicit function theorem)."""
        nx = self.f.numel_out(0)
        h = self.dt / self.substeps
        x, u, w, p = (ca.SX.sym(name, *self.f.size_in(i)) for i, name in enumerate("xuwp"))
        unit = ca.DM(self.scale)
        z = ca.SX.sym("z", nx, STAGES)  # stages in units of the scale
        rates = ca.horzcat(*(self.f(unit * z[:, j], u, w, p) for j in range(STAGES)))
        residual = z - ca.repmat(x / unit, 1, STAGES) - h * (rates / ca.repmat(unit, 1, STAGES)) @ ca.DM(self.weights).T
        equations = {"x": ca.vec(z), "p": ca.vertcat(x, u, w, p), "g": ca.vec(residual)}
        options = {"max_iter": NEWTON_ITERATIONS, "error_on_fail": False, "abstol": CONVERGED, "abstolStep": CONVERGED}
        solve = ca.rootfinder("stages", "newton", equations, options)
        given = [ca.MX.sym(name, *self.f.size_in(i)) for i, name in enumerate("xuwp")]
        after = given[0]
        for _ in range(self.substeps):
            after = unit * solve(ca.repmat(after / unit, STAGES, 1), ca.vertcat(after, *given[1:]))[-nx:]
        return ca.Function("step", given, [after], list("xuwp"), ["x_next"])

    def __call__(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """x⁺ (..., nx) of arrays or tensors (..., n); leading shapes broadcast."""
        check_sizes([self.f.numel_in(i) for i in range(4)], (x, u, w, p))
        if isinstance(x, np.ndarray):
            double = [np.asarray(a, dtype=float) for a in (x, u, w, p)]
            with np.errstate(all="ignore"):
                after = self._parts(np, double[0], tuple(double[1:]))
            return after.astype(np.result_type(x, np.float32), copy=False)
        import torch

        # Newton's method comes no nearer than rounding, which of single precision is more than a step may be wrong by
        after = self._parts(torch, x.double(), (u.double(), w.double(), p.double()))
        return after.to(x.dtype)

    def _parts(self, xp: Any, x: Any, held: tuple[Any, ...]) -> Any:
        """x⁺ with the functions of NumPy or torch."""
        batch = np.broadcast_shapes(*(tuple(a.shape[:-1]) for a in (x, *held)))
        x = xp.broadcast_to(x, (*batch, x.shape[-1]))
        along = tuple(a[..., None, :] for a in held)  # the same for every stage
        for _ in range(self.substeps):
            if xp is np:
                Z = self._solved(xp, x, along)
            else:
                with xp.no_grad():
                    Z = self._solved(xp, x.detach(), tuple(a.detach() for a in along))
                for _ in range(2):  # one gives the first derivatives, two the second and third
                    Z = Z - self._newton(xp, Z, x, along)
            x = Z[..., -1, :]
        return x

    def _solved(self, xp: Any, x: Any, along: tuple[Any, ...]) -> Any:
        """Stages Z (..., 3, nx); NaN where Newton's method does not converge."""
        Z = xp.stack([x] * STAGES, -2)
        scale = self.scale if xp is np else x.new_tensor(self.scale.tolist())
        largest = abs(Z)
        before = float("inf")
        done = ~xp.isfinite(Z).all(-1).all(-1)
        for _ in range(NEWTON_ITERATIONS):
            step = self._newton(xp, Z, x, along)
            Z = Z - step
            largest = xp.maximum(largest, xp.maximum(abs(step), abs(Z)))
            size = largest.max(-2, keepdims=True) if xp is np else largest.amax(-2, keepdim=True)
            left = (abs(step) / scale).max((-2, -1)) if xp is np else (abs(step) / scale).amax((-2, -1))
            stalled = (left <= STALLED) & (left > 0.5 * before)  # it no longer shrinks
            done = done | stalled | (abs(step) <= CLOSE * size).all(-1).all(-1)
            before = left
            if bool((done | ~xp.isfinite(Z).all(-1).all(-1)).all()):
                break
        Z = Z - self._newton(xp, Z, x, along)
        return xp.where(done[..., None, None], Z, Z * float("nan"))

    def _newton(self, xp: Any, Z: Any, x: Any, along: tuple[Any, ...]) -> Any:
        """Newton's step (..., 3, nx) at stages Z."""
        nx = x.shape[-1]
        h = self.dt / self.substeps
        weights = h * self.weights if xp is np else Z.new_tensor((h * self.weights).tolist())
        rates = self._dynamics(Z, *along)
        J = self._jacobian(Z, *along).reshape(*Z.shape, nx)
        residual = Z - x[..., None, :] - weights @ rates
        blocks = -weights[:, None, :, None] * xp.swapaxes(J, -3, -2)[..., None, :, :, :]
        M = blocks.reshape(*Z.shape[:-2], STAGES * nx, STAGES * nx)
        eye = np.eye(STAGES * nx) if xp is np else xp.eye(STAGES * nx, dtype=Z.dtype, device=Z.device)
        flat = residual.reshape(*Z.shape[:-2], STAGES * nx, 1)
        if xp is np:
            return _solved_or_nan(eye + M, flat).reshape(Z.shape)
        return xp.linalg.solve_ex(eye + M, flat)[0].reshape(Z.shape)


def radau_weights() -> Array:
    """Weights a_ij (3, 3) of Radau IIA: integrals of the Lagrange polynomials."""
    points = np.array(ca.collocation_points(STAGES, "radau"))
    powers = np.vander(points, increasing=True)  # (i, k): c_i^k
    integrals = np.array([[c ** (k + 1) / (k + 1) for k in range(STAGES)] for c in points])
    return np.asarray(np.linalg.solve(powers.T, integrals.T).T)


def _solved_or_nan(M: Array, b: Array) -> Array:
    """M⁻¹ b of every run; NaN where M is not finite."""
    bad = ~(np.isfinite(M).all((-1, -2), keepdims=True) & np.isfinite(b).all((-1, -2), keepdims=True))
    safe = np.where(bad, np.eye(M.shape[-1]), M)
    try:
        found = np.linalg.solve(safe, b)
    except np.linalg.LinAlgError:  # one of them is singular
        found = np.linalg.pinv(safe) @ b
    return np.where(bad, np.nan, found)
