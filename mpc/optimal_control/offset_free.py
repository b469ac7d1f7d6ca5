"""Nonlinear MPC that tracks without offset."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools_ground.door import as_instance
from mpc.checks import Array, as_array
from mpc.optimal_control.functions import symbols_of
from mpc.optimal_control.nonlinear_mpc import NonlinearMPC
from mpc.problem import MPCProblem
from mpc.tolerances import PRIMAL, TARGET_STEADY
from mpc.tracking import OffsetFreeMPC, SteadyStates, Target, sizes_of


@dataclass(frozen=True, eq=False, repr=False)
class OffsetFreeNonlinearMPC(OffsetFreeMPC):
    """Nonlinear MPC whose tracked outputs y = Cx settle on their reference although the model is wrong.

    The whole state must be measured: there is no observer of states. The disturbance that explains the last transitions
    is estimated, the steady state of the nonlinear model under it whose outputs come nearest to the reference is found,
    and the plan goes there. Used as `OffsetFreeMPC`: `observe` returns the controller with the new estimate, `loop` one
    with memory for a closed loop.

    Parameters
    ----------
    mpc : NonlinearMPC
        The regulator. Its w is what is estimated; without one, what is added to each next state.
    C, gain, disturbance
        See `OffsetFreeMPC`.

    Raises
    ------
    InputError
        Wrong shapes, or a gain outside (0, 1].

    References
    ----------
    Morari and Maeder, "Nonlinear offset-free model predictive control", Automatica 48(9), 2012; with measured states
    the estimator reduces to a filter of the one-step error.

    Examples
    --------
    >>> law = OffsetFreeNonlinearMPC(NonlinearMPC(step, 2, 1, Q=Q, R=R, horizon=20, U=(-5, 5)), [[1, 0]]).loop()
    >>> u = law(x, reference=[2.0], u_prev=u)
    """

    mpc: Any

    def _disturbed(self) -> NonlinearMPC:
        """Regulator, checked, of a model that disturbances move."""
        mpc: NonlinearMPC = as_instance("mpc", self.mpc, NonlinearMPC, "a NonlinearMPC")
        _ = mpc.problem  # which a phase has not
        if mpc.disturbances:
            return mpc
        step, size = mpc.model.step, mpc.states
        x, u, none, p = symbols_of(step).values()
        w = type(x).sym("w", size)
        moved = ca.Function("step", [x, u, w, p], [step(x, u, none, p) + w], ["x", "u", "w", "p"], ["next"])
        return replace(mpc, step=moved, disturbances=size)

    @property
    def problem(self) -> MPCProblem:
        """Sizes, weights and sets."""
        problem: MPCProblem = self.mpc.problem
        return problem

    def alone(self) -> OffsetFreeNonlinearMPC:
        """Controller of one run among others, with its own memory."""
        return replace(self, mpc=copy.deepcopy(self.mpc))

    def observe(self, x: ArrayLike, u: ArrayLike, x_next: ArrayLike) -> OffsetFreeNonlinearMPC:
        """Controller after one observed transition."""
        problem, model, p = self.problem, self.mpc.model, self.mpc.p
        x = as_array("x", x, (problem.nx,))
        u = as_array("u", u, (problem.nu,))
        after, _, _, E = model.linearised_at(x, u, self.disturbance, p)
        error, scale = as_array("x_next", x_next, (problem.nx,)) - after, 1 / problem.state_extent
        if not (np.isfinite(error).all() and np.isfinite(E).all()):
            return self
        seen = np.linalg.lstsq(E * scale[:, None], error * scale, rcond=None)[0]
        return replace(self, disturbance=self.disturbance + self.gain * seen)

    def nearest_target(self, reference: ArrayLike) -> Target:
        """Steady state (x, u) with Cx nearest to `reference` (ny,).

        By Newton's method, and by Ipopt where that leads nowhere, as beyond the top of a curve of steady states. Where
        neither finds one, what drifts least under the last linearisation; its drift is that of the model.
        """
        problem, model, p, w = self.problem, self.mpc.model, self.mpc.p, self.disturbance
        r = as_array("reference", reference, (len(self.C),))
        found, settled = self._by_newton(r)
        if not settled:
            found = self._by_ipopt(r, found)
        x, u = np.split(found, [problem.nx])
        drift = model.next(x, u, w, p) - x
        return Target(x, u, drift, bool(np.abs(drift / problem.state_extent).max() <= TARGET_STEADY))

    def _by_newton(self, r: Array) -> tuple[Array, bool]:
        """Target (nx + nu,) by Newton's method, and whether it settles."""
        problem, model, p, w = self.problem, self.mpc.model, self.mpc.p, self.disturbance
        size = sizes_of(problem)
        at = np.zeros(len(size))
        for _ in range(20):  # Newton steps
            x, u = np.split(at, [problem.nx])
            after, A, B, _ = model.linearised_at(x, u, w, p)
            if not (np.isfinite(after).all() and np.isfinite(A).all() and np.isfinite(B).all()):
                return np.zeros(len(size)), False
            found = SteadyStates(problem, A, B, self.C).nearest(after - A @ x - B @ u, r)
            then = np.concatenate([found.state, found.input])
            moved = float(np.abs((then - at) / size).max())
            at = then
            if moved <= PRIMAL:
                return at, found.steady
        return at, False

    def _by_ipopt(self, r: Array, otherwise: Array) -> Array:
        """Target (nx + nu,) by Ipopt, where that finds one."""
        size, nx = sizes_of(self.problem), self.problem.nx
        unit = max(float(np.linalg.norm(self.C * size[:nx])), np.finfo(float).tiny) ** 2
        squares, slope = (self.C.T @ self.C).ravel() / unit, self.C.T @ r / unit
        data = np.concatenate([squares, slope, self.disturbance, self.mpc.p])
        solver = self.mpc.steady_solver
        least = np.where(np.arange(solver.numel_out("g")) < nx, 0.0, -np.inf)
        found = solver(x0=0, p=data, lbg=least, ubg=0)
        return np.asarray(found["x"]).ravel() * size if solver.stats()["success"] else otherwise
