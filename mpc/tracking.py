"""Offset-free tracking by an estimated constant disturbance."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag, null_space

from mpc.checks import Array, Immutable, as_array, as_count, as_floats
from mpc.dense_qp import DenseQP
from mpc.exceptions import InputError
from mpc.linear_mpc import LinearMPC
from mpc.plan import Plan
from mpc.problem import MPCProblem
from mpc.tolerances import NEGLIGIBLE, STEADY, TARGET_COST


@dataclass(frozen=True, eq=False, repr=False)
class OffsetFreeMPC:
    """MPC that tracks outputs y = Cx without offset.

    The object is not changed: `observe` returns the controller with the new estimate, and `loop` a controller with
    memory for a closed-loop simulation. Constant disturbances are allowed for.

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
    reference : (ny,) array, optional
        What the outputs are to reach where a call names none; a loop then asks for none.

    Raises
    ------
    InputError
        Wrong shapes, or a gain outside (0, 1].

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
    reference: Any = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        object.__setattr__(self, "mpc", self._disturbed())
        problem = self.problem
        gain = as_array("gain", self.gain, ())
        if not 0 < gain <= 1:
            raise InputError("gain", self.gain, "a number in (0, 1]")
        estimate = np.zeros(problem.nw) if self.disturbance is None else self.disturbance
        for name, value in (
            ("C", as_array("C", self.C, (None, problem.nx))), ("gain", float(gain)),
            ("disturbance", as_array("disturbance", estimate, (problem.nw,))),
        ):  # fmt: skip
            object.__setattr__(self, name, value)
        if self.reference is not None:
            object.__setattr__(self, "reference", as_array("reference", self.reference, (len(self.C),)))

    def _disturbed(self) -> Any:
        """Regulator, checked, of a model with disturbances."""
        if not isinstance(self.mpc, LinearMPC):
            raise InputError("mpc", type(self.mpc).__name__, "a LinearMPC")
        return self.mpc if self.mpc.E is not None else self.mpc.with_model(self.mpc.A, self.mpc.B, np.eye(self.mpc.nx))

    @property
    def problem(self) -> MPCProblem:
        """Sizes, weights and sets."""
        return self.mpc

    def alone(self) -> OffsetFreeMPC:
        """Controller of one run among others."""
        return self

    def __repr__(self) -> str:
        size = f"{len(self.C)} outputs, gain={self.gain:.3g}, disturbance={self.disturbance}"
        return f"{type(self).__name__}({size}, {self.mpc!r})"

    @property
    def needs(self) -> frozenset[str]:
        """Signals a closed loop hands over; see `LinearMPC.needs`."""
        return self.mpc.needs | ({"reference"} if self.reference is None else set())

    def observe(self, x: ArrayLike, u: ArrayLike, x_next: ArrayLike) -> OffsetFreeMPC:
        """Controller after one observed transition."""
        mpc = self.mpc
        x = as_array("x", x, (mpc.nx,))
        u = as_array("u", u, (mpc.nu,))
        seen = self._seen @ (as_array("x_next", x_next, (mpc.nx,)) - mpc.A @ x - mpc.B @ u)
        after = copy.copy(self)  # with what is known of the steady states
        object.__setattr__(after, "disturbance", self.disturbance + self.gain * (seen - self.disturbance))
        return after

    @cached_property
    def _seen(self) -> Array:
        """Disturbance of a one-step error, (nw, nx)."""
        scale = 1 / self.mpc.state_extent
        return np.asarray(np.linalg.pinv(self.mpc.E * scale[:, None]) * scale)

    @cached_property
    def _steady(self) -> SteadyStates:
        """Steady states of the model."""
        return SteadyStates(self.mpc, self.mpc.A, self.mpc.B, self.C)

    def target(self, reference: ArrayLike) -> tuple[Array, Array]:
        """Steady state (x, u) with Cx nearest to `reference` (ny,).

        Where several do, the one of least cost x'Qx + 2 x'Su + u'Ru.

        Raises
        ------
        InputError
            No state in X stays where it is under an input in U and the estimated disturbance; the message says how far
            the best one drifts. `nearest_target` returns that one.
        """
        found = self.nearest_target(reference)
        if not found.steady:
            raise InputError(
                "disturbance", f"no steady state in X and U under {self.disturbance}, the best drifts by {found.drift}",
                "one that an input in U can balance", "Lower the gain, check E, or widen X and U.",
            )  # fmt: skip
        return found.state, found.input

    def nearest_target(self, reference: ArrayLike) -> Target:
        """Target, or the least drifting state and input."""
        return self._steady.nearest(self.mpc.E @ self.disturbance, as_array("reference", reference, (len(self.C),)))

    def solve(self, x: ArrayLike, reference: ArrayLike, **signals: ArrayLike) -> Plan:
        """Plan from x towards the `nearest_target` of `reference`.

        Of the other signals only `u_prev` is open: references and disturbance are the controller's own.
        """
        _refuse_own(signals)
        target = self.nearest_target(reference)
        return self.mpc.solve(x, x_ref=target.state, u_ref=target.input, w=self.disturbance, **signals)

    def __call__(self, x: ArrayLike, reference: ArrayLike | None = None, **signals: ArrayLike) -> Array:
        """First input: (nx,) -> (nu,) or (n, nx) -> (n, nu).

        The reference of the outputs may be replaced by one of the states, `x_ref` (nx,), which stands for C x_ref.
        """
        r = self._reference(reference, signals.pop("x_ref", None))
        signals.pop("u_ref", None)
        _refuse_own(signals)
        states = as_floats("x", x)
        target = self.nearest_target(r)
        return self.mpc(states, x_ref=target.state, u_ref=target.input, w=self.disturbance, **signals)

    def loop(self, n: int = 1) -> OffsetFreeLoop:
        """Controller with memory for n runs, which observes every step."""
        return OffsetFreeLoop(self, n)

    def _reference(self, reference: ArrayLike | None, x_ref: ArrayLike | None) -> ArrayLike:
        """Output reference, given itself or by a state's first row."""
        if reference is None and x_ref is None:
            reference = self.reference
        if reference is not None:
            return np.asarray(reference)
        if x_ref is None:
            raise InputError("reference", "nothing", "the outputs to reach, or x_ref")
        state = as_floats("x_ref", x_ref)
        return np.asarray(self.C @ as_array("x_ref", state[0] if state.ndim == 2 else state, (self.problem.nx,)))


def _refuse_own(signals: dict[str, Any]) -> None:
    """Raise for signals other than `u_prev`."""
    for name in signals:
        if name != "u_prev":
            raise InputError(name, "a signal", "none but u_prev", "References and disturbance are set by the target.")


class OffsetFreeLoop:
    """`OffsetFreeMPC` with memory for n runs of a closed loop."""

    def __init__(self, controller: OffsetFreeMPC, n: int = 1):
        self.controller = controller
        self.reset(n)

    def __repr__(self) -> str:
        return f"OffsetFreeLoop({len(self._each)} runs, {self.controller!r})"

    @property
    def needs(self) -> frozenset[str]:
        """Signals a closed loop hands over: applied input and reference."""
        return self.controller.needs | {"last_input"}

    def reset(self, n: int = 1) -> None:
        """Forget the last states and estimates."""
        self._each = [self.controller.alone() for _ in range(as_count("n", n))]
        self._last: Array | None = None

    def __call__(self, x: ArrayLike, **signals: Any) -> Array:
        """Inputs (n, nu) for states (n, nx), or (nu,) for (nx,)."""
        states = as_floats("x", x)
        single = states.ndim == 1
        states = as_array("x", np.atleast_2d(states), (len(self._each), self.controller.problem.nx))
        if signals.get("u_prev") is None:
            raise InputError("u_prev", "nothing", "the input that was applied one step ago", "Before the first: zeros.")
        last = np.atleast_2d(as_floats("u_prev", signals.pop("u_prev")))
        applied = as_array("u_prev", last, (len(self._each), self.controller.problem.nu))
        if self._last is not None:
            self._each = [c.observe(*step) for c, *step in zip(self._each, self._last, applied, states)]
        self._last = states
        limited = self.controller.problem.rate_limit is not None
        own = [{"u_prev": u} if limited else {} for u in applied]  # references are shared, the last input is not
        u = np.array([c(s, **signals, **mine) for c, s, mine in zip(self._each, states, own)])
        return u[0] if single else u


@dataclass(frozen=True, eq=False)
class Target(Immutable):
    """State and input to aim at.

    Attributes
    ----------
    state, input : (nx,) and (nu,) array
    drift : (nx,) array
        By how much the state moves away in one step under the input and the estimated disturbance.
    steady : bool
        Whether the drift is rounding; False where no state in X with an input in U stays where it is.
    """

    state: Array
    input: Array
    drift: Array
    steady: bool


class SteadyStates:
    """Steady states within the sets of a problem.

    They are those of x⁺ = Ax + Bu + push, chosen by outputs Cx and the problem's weights.
    """

    def __init__(self, problem: MPCProblem, A: Array, B: Array, C: Array):
        self.problem = problem
        self.size = sizes_of(problem)
        # (A - I)x + Bu + push = 0, states and inputs in units of their limits
        self._M = np.hstack([A - np.eye(problem.nx), B]) / problem.state_extent[:, None] * self.size
        self._particular = -np.linalg.pinv(self._M)
        self._residue = np.eye(problem.nx) + self._M @ self._particular
        output = np.hstack([C, np.zeros((len(C), problem.nu))]) * self.size
        unit = max(float(np.linalg.norm(output)), np.finfo(float).tiny)
        W = problem.stage_weight * self.size * self.size[:, None]
        W = W / max(float(np.trace(W)), np.finfo(float).tiny) + NEGLIGIBLE * np.eye(len(self.size))
        self._cost = (output / unit).T @ (output / unit) + TARGET_COST * W
        self._aim = output.T / unit**2
        (HX, hX), (HU, hU) = problem.state_rows, problem.input_rows
        self._rows = block_diag(HX, HU) * self.size
        self._right = np.concatenate([hX, hU])

    def nearest(self, push: Array, r: Array) -> Target:
        """Target whose outputs are nearest to r, steady or least drifting."""
        scaled = push / self.problem.state_extent
        particular = self._particular @ scaled
        steady = np.abs(self._residue @ scaled).max() <= STEADY * max(1.0, np.abs(scaled).max())
        # the particular solution has the least drift, so the drift has no slope there
        slope = self._cost @ particular - self._aim @ r
        right = self._right - self._rows @ particular
        basis, qp = self._kept_steady
        result = None if qp is None else qp.solve(basis.T @ slope, right, confirm_infeasible=True)
        if result is None or result.infeasible or not steady:
            basis, qp = self._drifting
            steady = False
            result = qp.solve(slope, right, confirm_infeasible=True)
        point = particular + basis @ result.z
        drift = (self._M @ point + scaled) * self.problem.state_extent
        nx = self.problem.nx
        return Target(point[:nx] * self.size[:nx], point[nx:] * self.size[nx:], drift, bool(steady))

    @cached_property
    def _kept_steady(self) -> tuple[Array, DenseQP | None]:
        """Basis of the steady states, and the QP over it unless there is one alone."""
        basis = null_space(self._M)
        basis[np.abs(basis) < STEADY] = 0.0  # what rounding left of a zero would count as a direction
        return basis, self._over(basis, np.zeros((len(self.size), len(self.size)))) if basis.shape[1] else None

    @cached_property
    def _drifting(self) -> tuple[Array, DenseQP]:
        """Basis of all states and inputs, and the QP over it with a price on drift."""
        basis = np.eye(len(self.size))
        return basis, self._over(basis, self._M.T @ self._M / NEGLIGIBLE)

    def _over(self, basis: Array, drift: Array) -> DenseQP:
        """QP over particular + basis z: output error, cost and drift."""
        units = np.concatenate([self.problem.row_units["state"], self.problem.row_units["input"]])
        return DenseQP(basis.T @ (self._cost + drift) @ basis, self._rows @ basis, units)


def sizes_of(problem: MPCProblem) -> Array:
    """Sizes (nx + nu,) of states and inputs, 1 without limits."""
    return np.concatenate([problem.state_extent, np.where(problem.input_extent > 0, problem.input_extent, 1.0)])
