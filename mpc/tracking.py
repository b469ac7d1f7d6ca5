"""Offset-free tracking: a constant unknown disturbance is estimated and the target moved accordingly."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import null_space

from mpc.checks import Array, as_array
from mpc.dense_qp import DenseQP
from mpc.exceptions import InputError
from mpc.linear_mpc import LinearMPC
from mpc.plan import Plan


@dataclass(frozen=True, eq=False, repr=False)
class OffsetFreeMPC:
    """An MPC whose tracked outputs y = Cx settle on their reference in spite of constant disturbances.

    The object is not changed: `observe` returns the controller with the new estimate.

    Parameters
    ----------
    mpc : LinearMPC
        The regulator. Its E says where disturbances enter; without one they may enter every state.
    C : (ny, nx) array
        Tracked outputs.
    gain : float
        Share of the newest one-step error taken into the estimate, in (0, 1].
    disturbance : (nw,) array, optional
        Estimate w; zero at first.

    Raises
    ------
    InputError
        Wrong shapes, a gain outside (0, 1], or a target that is not determined.

    References
    ----------
    Pannocchia and Rawlings, *Disturbance models for offset-free MPC*, AIChE J. 49(2), 2003; with measured states the
    estimator reduces to a filter of the one-step error.

    Examples
    --------
    >>> controller = OffsetFreeMPC(mpc, [[1, 0]])
    >>> u = controller(x, reference=[2.0])
    >>> controller = controller.observe(x, u, x_next)
    """

    mpc: LinearMPC
    C: Any
    gain: float = field(default=0.5, kw_only=True)
    disturbance: Any = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        mpc = self.mpc if self.mpc.E is not None else replace(self.mpc, E=np.eye(self.mpc.nx), P=self.mpc.given_P)
        set_(self, "mpc", mpc)
        set_(self, "C", as_array("C", self.C, (None, mpc.nx)))
        if not 0 < self.gain <= 1:
            raise InputError(f"gain is {self.gain}, expected a number in (0, 1].")
        nw = mpc.E.shape[1]
        estimate = np.zeros(nw) if self.disturbance is None else self.disturbance
        set_(self, "disturbance", as_array("disturbance", estimate, (nw,)))

    def observe(self, x: ArrayLike, u: ArrayLike, x_next: ArrayLike) -> OffsetFreeMPC:
        """The controller after seeing one transition."""
        mpc = self.mpc
        x, x_next = as_array("x", x, (mpc.nx,)), as_array("x_next", x_next, (mpc.nx,))
        error = x_next - mpc.A @ x - mpc.B @ as_array("u", u, (mpc.nu,))
        seen = np.linalg.lstsq(mpc.E, error, rcond=None)[0]
        return replace(self, disturbance=self.disturbance + self.gain * (seen - self.disturbance))

    def target(self, reference: ArrayLike) -> tuple[Array, Array]:
        """Steady state (x, u) in X and U that brings Cx nearest to the reference (ny,), in least squares.

        Where several do, the one of least cost x'Qx + u'Ru.
        """
        mpc = self.mpc
        r = as_array("reference", reference, (len(self.C),))
        # all steady states: (A - I)x + Bu + Ew = 0
        M = np.hstack([mpc.A - np.eye(mpc.nx), mpc.B])
        particular, *_ = np.linalg.lstsq(M, -mpc.E @ self.disturbance, rcond=None)
        basis = null_space(M)
        output = np.hstack([self.C, np.zeros((len(self.C), mpc.nu))])
        T = output @ basis
        W = np.block([[mpc.Q, np.zeros((mpc.nx, mpc.nu))], [np.zeros((mpc.nu, mpc.nx)), mpc.R]])
        cost, size = basis.T @ W @ basis, float(np.trace(T.T @ T)) or 1.0
        share = 1e-8 * size / max(float(np.trace(cost)), np.finfo(float).tiny)
        H = T.T @ T + share * cost + 1e-14 * size * np.eye(basis.shape[1])
        q = T.T @ (output @ particular - r) + share * basis.T @ W @ particular
        (HX, hX), (HU, hU) = mpc.state_rows, mpc.input_rows
        rows = np.vstack([np.hstack([HX, np.zeros((len(HX), mpc.nu))]), np.hstack([np.zeros((len(HU), mpc.nx)), HU])])
        result = DenseQP(H, rows @ basis).solve(q, np.concatenate([hX, hU]) - rows @ particular, doubt=True)
        if result.infeasible:
            raise InputError("no steady state lies in X and U under the estimated disturbance; expected one.")
        steady = particular + basis @ result.z
        return steady[: mpc.nx], steady[mpc.nx :]

    def solve(self, x: ArrayLike, reference: ArrayLike, **signals: ArrayLike) -> Plan:
        """Plan from x towards the steady state that meets the reference, under the estimated disturbance."""
        state, action = self.target(reference)
        return self.mpc.solve(x, x_ref=state, u_ref=action, w=self.disturbance, **signals)

    def __call__(self, x: ArrayLike, reference: ArrayLike, **signals: ArrayLike) -> Array:
        """First input (nu,) of the plan."""
        return np.array(self.solve(x, reference, **signals).inputs[0])
