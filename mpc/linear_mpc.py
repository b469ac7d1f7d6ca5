"""Linear model predictive control as one convex QP per step."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from mpc.checks import (
    Array,
    as_array,
    as_blocks,
    as_floats,
    as_halfspaces,
    as_horizon,
    as_pair,
    as_rate_limit,
    as_soft,
    as_weight,
)
from mpc.condensing import condense
from mpc.dense_qp import DenseQP
from mpc.exceptions import InputError
from mpc.fallback import cost_of, excess, relax, rollout, saturated_regulator
from mpc.lqr import lqr
from mpc.parametric_qp import ParametricQP
from mpc.plan import Plan, Status
from mpc.relaxation import nearest_points
from mpc.solve_arguments import for_each_state, spread_signals

if TYPE_CHECKING:
    from mpc.explicit.explicit import ExplicitMPC
    from mpc.infeasibility import Explanation

_OVERFLOW = 1e100  # data beyond this are answered by the saturated regulator


@dataclass(frozen=True, eq=False, repr=False)
class LinearMPC:
    """Model predictive controller of x⁺ = Ax + Bu (+ Ew), a callable u = controller(x).

    Minimises Σ_{k<N} x_k'Qx_k + u_k'Ru_k + x_N'Px_N subject to x_k in X (k = 1 … N), u_k in U (k = 0 … N-1) and
    x_N in the terminal set (Borrelli, Bemporad and Morari, *Predictive Control*, 2017, eq. 12.6).

    Parameters
    ----------
    A : (nx, nx) array, or a discrete-time `control.StateSpace` (then B is None)
        State matrix [-].
    B : (nx, nu) array
        Input matrix [-].
    Q, R : (nx, nx) and (nu, nu) array, or their diagonals
        Weights, symmetric positive semidefinite; R may be singular while the condensed Hessian is definite.
    horizon : int
        N [steps].
    P : (nx, nx) array, optional
        Terminal weight; by default the solution of the Riccati equation.
    X, U : Polytope, optional
        State set (imposed at k = 1 … N) and input set (k = 0 … N-1), in the units of x and u.
    terminal_set : Polytope, optional
        Set for x_N, beside X.
    E : (nx, nw) array, optional
        Disturbance matrix, for disturbances known ahead.
    rate_limit : float or (nu,) array, optional
        Largest |u_k - u_{k-1}| per step, in the units of u; `solve` then needs `u_prev`.
    soft : (linear, quadratic), optional
        Makes state and terminal constraints soft: each step costs linear * s + quadratic * s², where s is the largest
        violation of that step relative to the bound; linear >= 0, quadratic > 0.
    blocks : tuple of int, optional
        Move blocking: lengths of the blocks over which the input is held, summing to N.

    Raises
    ------
    InputError, NotConvexError, NotStabilisableError
        Bad shapes or values; an indefinite weight or Hessian; no stabilising terminal weight.

    Examples
    --------
    >>> controller = LinearMPC(A, B, Q=Q, R=R, horizon=20, X=X, U=U)
    >>> u = controller(x)
    """

    A: Any
    B: Any = None
    Q: ArrayLike = field(kw_only=True)
    R: ArrayLike = field(kw_only=True)
    horizon: int = field(kw_only=True)
    P: Any = field(default=None, kw_only=True)
    X: Any = field(default=None, kw_only=True)
    U: Any = field(default=None, kw_only=True)
    terminal_set: Any = field(default=None, kw_only=True)
    E: Any = field(default=None, kw_only=True)
    rate_limit: Any = field(default=None, kw_only=True)
    soft: tuple[float, float] | None = field(default=None, kw_only=True)
    blocks: tuple[int, ...] | None = field(default=None, kw_only=True)
    state_rows: tuple[Array, Array] = field(init=False)
    input_rows: tuple[Array, Array] = field(init=False)
    terminal_rows: tuple[Array, Array] = field(init=False)

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        A, B = as_pair(self.A, self.B)
        nx, nu = B.shape
        set_(self, "A", A)
        set_(self, "B", B)
        set_(self, "Q", as_weight("Q", self.Q, nx))
        set_(self, "R", as_weight("R", self.R, nu))
        set_(self, "horizon", as_horizon(self.horizon))
        set_(self, "state_rows", as_halfspaces("X", self.X, nx))
        set_(self, "input_rows", as_halfspaces("U", self.U, nu))
        set_(self, "terminal_rows", as_halfspaces("terminal_set", self.terminal_set, nx))
        _refuse_empty("X", *self.state_rows)
        _refuse_empty("U", *self.input_rows)
        _refuse_empty("terminal_set", *self.terminal_rows)
        if self.E is not None:
            set_(self, "E", as_array("E", self.E, (nx, None)))
        if self.rate_limit is not None:
            set_(self, "rate_limit", as_rate_limit(self.rate_limit, nu))
        if self.soft is not None:
            set_(self, "soft", as_soft(self.soft))
        if self.blocks is not None:
            set_(self, "blocks", as_blocks(self.blocks, self.horizon))
        if self.P is None:
            gain, P = lqr(A, B, Q=self.Q, R=self.R)
            set_(self, "_lqr_gain", gain)
            set_(self, "P", P)
        else:
            set_(self, "P", as_weight("P", self.P, nx))
        self._problems[()]  # builds the QP: fails here, not in the loop

    def __repr__(self) -> str:
        problem, _ = self._problems[("u_prev",) if self.rate_limit is not None else ()]
        size = f"{problem.nz} variables, {problem.m} constraints"
        return f"LinearMPC({self.nx} states, {self.nu} inputs, N={self.horizon}, {size})"

    @property
    def nx(self) -> int:
        """Number of states."""
        return int(self.B.shape[0])

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return int(self.B.shape[1])

    @cached_property
    def gain(self) -> Array:
        """Gain K (nu, nx) of the unconstrained regulator u = -K x, see `lqr`."""
        known = getattr(self, "_lqr_gain", None)
        return known if known is not None else lqr(self.A, self.B, Q=self.Q, R=self.R)[0]

    def build(self, *parameters: str) -> ParametricQP:
        """The QP with the state and the named quantities left open, to inspect or to hand to another solver.

        Parameters
        ----------
        parameters : str
            Any of "u_prev" (always present with a rate limit), "x_ref", "u_ref", "w".
        """
        return condense(self, parameters)

    def with_model(
        self, A: Any, B: ArrayLike | None = None, E: ArrayLike | None = None, *, P: ArrayLike | None = None
    ) -> LinearMPC:
        """The same controller for another design of the plant.

        Parameters
        ----------
        A, B : arrays, or a discrete-time `control.StateSpace` and None
            The new model.
        E : (nx, nw) array, optional
            By default the present one.
        P : (nx, nx) array, optional
            By default the one that was given to this controller; where none was, the Riccati solution of the new model.
        """
        return replace(self, A=A, B=B, E=self.E if E is None else E, P=self.given_P if P is None else P)

    @property
    def given_P(self) -> Array | None:
        """The terminal weight, if it was given; None where it is the solution of the Riccati equation."""
        return None if hasattr(self, "_lqr_gain") else self.P

    def solve(
        self, x: ArrayLike, *, u_prev: ArrayLike | None = None, x_ref: ArrayLike | None = None,
        u_ref: ArrayLike | None = None, w: ArrayLike | None = None,
    ) -> Plan:  # fmt: skip
        """Optimal plan from the state x.

        Parameters
        ----------
        x : (nx,) array
            State, in the units of the plant.
        u_prev : (nu,) array
            Input applied one step ago; needed with a rate limit only.
        x_ref : (nx,) or (N + 1, nx) array, optional
            State reference.
        u_ref : (nu,) or (N, nu) array, optional
            The input that belongs to it.
        w : (nw,) or (N, nw) array, optional
            Disturbance known ahead; a single row is held over the horizon.

        Returns
        -------
        Plan
            Inputs and states are always finite. The status says whether state constraints had to be relaxed.

        Raises
        ------
        InputError
            Wrong shape, NaN, or an argument the controller was not built for.
        """
        start = time.perf_counter()
        x = as_array("x", x, (self.nx,))
        given = spread_signals(self, {"u_prev": u_prev, "x_ref": x_ref, "u_ref": u_ref, "w": w})
        return self._solve(x, given, start)

    def solve_many(self, X: ArrayLike, **signals: ArrayLike) -> list[Plan]:
        """One plan per row of X (n, nx), in order, each warm-started from the one before it.

        The signals are those of `solve`, the same for all rows; `u_prev` may be (n, nu), one row for each.
        """
        rows = as_array("X", X, (None, self.nx))
        each = for_each_state(self, signals, len(rows))
        return [self._solve(x, given, time.perf_counter()) for x, given in zip(rows, each)]

    def __call__(self, x: ArrayLike, **signals: ArrayLike) -> Array:
        """First input: (nx,) -> (nu,) or (n, nx) -> (n, nu); finite for every finite x."""
        x = as_floats("x", x)
        if x.ndim == 2:
            return np.array([plan.inputs[0] for plan in self.solve_many(x, **signals)]).reshape(len(x), self.nu)
        return np.array(self.solve(x, **signals).inputs[0])

    def explain(self, x: ArrayLike, **signals: ArrayLike) -> Explanation:
        """Why the problem is infeasible from x: what has to give, by how much, and what contradicts what.

        Parameters
        ----------
        x : (nx,) array
            State.
        signals : arrays
            As in `solve`.

        Returns
        -------
        Explanation
            Prints as one sentence; empty when the problem is feasible.
        """
        from mpc.infeasibility import explain_infeasibility

        x = as_array("x", x, (self.nx,))
        given = spread_signals(self, dict(signals))
        problem, _ = self._problems[tuple(sorted(given))]
        return explain_infeasibility(self, problem, self._theta(problem, x, given))

    def explicit(
        self, theta_set: Any = None, *, parameters: tuple[str, ...] = (), max_regions: int = 100_000,
        time_limit: float = np.inf,
    ) -> ExplicitMPC:  # fmt: skip
        """The same law as a function of the state, computed for every state in advance.

        Parameters
        ----------
        theta_set : Polytope, optional
            States (and other open parameters, in the order of `build(*parameters).parameters`) of interest; X by
            default, or X × U when a rate limit makes the last input a parameter.
        parameters : tuple of str
            Further quantities to leave open, see `build`.
        max_regions, time_limit : int and float
            Limits, see `solve_mpqp`. The search tree that follows is not limited: 3 s for 800 regions in four
            parameters, growing with the square of their number.

        Raises
        ------
        InfeasibleError
            No parameter of the set is feasible.
        """
        from mpc.explicit.explicit import ExplicitMPC, default_parameters
        from mpc.explicit.mpqp import solve_mpqp

        problem = self.build(*parameters)
        if theta_set is None:
            theta_set = default_parameters(self, problem)
        partition = solve_mpqp(problem, theta_set, max_regions=max_regions, time_limit=time_limit)
        return ExplicitMPC.from_partition(partition, self.input_rows)

    @cached_property
    def _problems(self) -> _Problems:
        return _Problems(self)

    @staticmethod
    def _theta(problem: ParametricQP, x: Array, given: dict[str, Array]) -> Array:
        return np.concatenate([x if name == "x" else given[name] for name, _ in problem.parameters])

    def _solve(self, x: Array, given: dict[str, Array], start: float) -> Plan:
        problem, solver = self._problems[tuple(sorted(given))]
        theta = self._theta(problem, x, given)
        with np.errstate(over="ignore", invalid="ignore"):
            q, b = problem.at(theta)
            if not max(np.abs(q).max(), np.abs(b).max(initial=0.0)) < _OVERFLOW:
                return saturated_regulator(self, x, start)
            result, status, violation = solver.solve(q, b), Status.SOLVED, 0.0
            if result.infeasible:
                relaxed = relax(self, problem, solver, q, b)
                if relaxed is None:
                    return saturated_regulator(self, x, start)
                result, status, violation = relaxed
            if not result.residuals.worst <= 1e-6:
                status = Status.INACCURATE
            inputs, states = problem.inputs(result.z, theta), problem.states(result.z, theta)
            if not np.isfinite(inputs).all():
                return saturated_regulator(self, x, start)
            cost = problem.cost(result.z, theta)
            if status is Status.INACCURATE:
                inputs = nearest_points(inputs, *self.input_rows)
                states = rollout(self, x, inputs, given.get("w"))
                cost = cost_of(self, inputs, states, given)
            if self.soft is not None or status is Status.INACCURATE:
                violation = excess(self, states)
        duration = time.perf_counter() - start
        return Plan(inputs, states, cost, status, result.residuals, violation, duration, result.solver)


def _refuse_empty(name: str, H: Array, h: Array) -> None:
    if len(h) and DenseQP(np.eye(H.shape[1]), H).solve(np.zeros(H.shape[1]), h, doubt=True).infeasible:
        raise InputError(f"{name} is empty: no point satisfies its {len(h)} rows (is a lower bound too high?).")


class _Problems(dict[tuple[str, ...], tuple[ParametricQP, DenseQP]]):
    """QP and solver for each combination of signals, built when first asked for."""

    def __init__(self, mpc: LinearMPC):
        super().__init__()
        self._mpc = mpc

    def __missing__(self, parameters: tuple[str, ...]) -> tuple[ParametricQP, DenseQP]:
        problem = condense(self._mpc, parameters)
        self[parameters] = problem, DenseQP(problem.H, problem.G)
        return self[parameters]
