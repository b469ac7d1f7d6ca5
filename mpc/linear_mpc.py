"""Linear model predictive control as one convex QP per step."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from mpc.checks import Array, as_array, as_floats
from mpc.condensing import condense
from mpc.exceptions import InputError
from mpc.parametric_qp import ParametricQP
from mpc.plan import Plan
from mpc.problem import MPCProblem
from mpc.rollout import Given, for_each_state, spread_signals
from mpc.solving import CondensedSolver
from mpc.sparse_qp import SparseSolver

if TYPE_CHECKING:
    from mpc.explicit.explicit import ExplicitMPC
    from mpc.infeasibility import Explanation
    from mpc.sensitivities.plan_sensitivity import PlanSensitivity

SOLVERS = ("daqp", "osqp", "clarabel")


@dataclass(frozen=True, eq=False, repr=False)
class LinearMPC(MPCProblem):
    """Model predictive controller u = controller(x) of x⁺ = Ax + Bu (+ Ew).

    Minimises Σ_{k<N} x_k'Qx_k + 2 x_k'Su_k + u_k'Ru_k + x_N'Px_N subject to x_k in X (k = 1 … N), u_k in U
    (k = 0 … N-1) and x_N in the terminal set (Borrelli, Bemporad and Morari, *Predictive Control*, 2017, eq. 12.6).

    Parameters
    ----------
    A : (nx, nx) array, or a discrete-time `control.StateSpace` (then B is None)
        State matrix [-].
    B : (nx, nu) array
        Input matrix [-].
    Q, R : (nx, nx) and (nu, nu) array, or their diagonals, or numbers
        Weights, symmetric positive semidefinite; R may be singular while the condensed Hessian is definite.
    S : (nx, nu) array, optional
        Cross weight, `N` in python-control and MATLAB, with [Q S; S' R] positive semidefinite: outputs y = Cx + Du of
        weight W have Q = C'WC, S = C'WD, R = D'WD. With references it weighs (x - x_ref)'S(u - u_ref).
    horizon : int
        N [steps].
    P : (nx, nx) array, optional
        Terminal weight; by default the solution of the Riccati equation.
    X, U : Polytope or (lower, upper), optional
        State set (imposed at k = 1 … N) and input set (k = 0 … N-1), in the units of x and u.
    terminal_set : Polytope or (lower, upper), optional
        Set for x_N, beside X.
    E : (nx, nw) array, optional
        Disturbance matrix, for disturbances known ahead, and for W.
    mean : (nw,) array, optional
        Disturbance where a call names none, as of a model with a constant part. Without references the plan then costs
        least with the state and input in which LQR would settle under it as 0, which are those of least cost at rest:
        so without limits it is LQR with an offset.
    W : Polytope or (lower, upper), optional
        Set of disturbances that nobody knows: x⁺ = Ax + Bu + Ew with any w in W, or a `mean` and any w in W (without E,
        what is added to each state). Limits are tightened along the plan by what they can do under u = v - Kx with
        K = `tube_gain`, and the terminal set is the largest robust invariant one if none is given, so that a loop that
        begins with a plan has one at every step and keeps X and U (Chisci, Rossiter and Zappa, Automatica 37(7), 2001).
        A given `terminal_set` must be robustly invariant under `tube_gain` for that, and no known or estimated `w` may
        change from step to step. Not beside `rate_limit` or `blocks`.
    rate_limit : float or (nu,) array, optional
        Largest |u_k - u_{k-1}| per step, in the units of u; `solve` then needs `u_prev`.
    soft : (linear, quadratic), optional
        Makes state and terminal constraints soft: each step costs linear * s + quadratic * s², where s is the largest
        violation of that step relative to the bound (of a bound that is zero: to the extent of the set along it; where
        it has none, to what limited inputs move in a step, else to 1). A limit that stands for none is better left
        infinite: 1e7 would price violations of a zero bound in units of 1e7. linear >= 0, quadratic > 0.
    blocks : tuple of int, optional
        Move blocking: lengths of the blocks over which the input is held, summing to N.
    solver : str
        "daqp": active-set, on the condensed QP, fastest for up to some hundred inputs over the horizon. "osqp" or
        "clarabel": with the states kept, for long horizons and many states. Each with a second solver behind it.
    uses : tuple of str, optional
        "reference" or "preview": what a closed loop is to hand over at every step, see `needs`.

    Raises
    ------
    InputError, NotConvexError, NotStabilisableError, InfeasibleError
        Bad shapes or values; an indefinite weight or Hessian; no stabilising terminal weight; too large a W.

    Examples
    --------
    >>> controller = LinearMPC(A, B, Q=Q, R=R, horizon=20, X=X, U=U)
    >>> u = controller(x)
    """

    solver: str = field(default="daqp", kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.solver, str) or self.solver not in SOLVERS:
            raise InputError("solver", repr(self.solver), f"one of {SOLVERS}")
        self._solver_for(("u_prev",) if self.rate_limit is not None else ())  # builds the QP: fails here

    def __repr__(self) -> str:
        size = f"{self.nx} states, {self.nu} inputs, N={self.horizon}"
        if self.solver != "daqp":
            return f"LinearMPC({size}, {self.solver})"
        qp = self._condensed(("u_prev",) if self.rate_limit is not None else ()).qp
        return f"LinearMPC({size}, {qp.nz} variables, {qp.m} constraints)"

    def build(self, *parameters: str) -> ParametricQP:
        """QP with the state and named parameters left open.

        Parameters
        ----------
        parameters : str
            Any of "u_prev" (always present with a rate limit), "x_ref", "u_ref", "w".
        """
        lasting = self.lasting_beside(parameters)
        return condense(self, (*parameters, *lasting)).fix(**lasting)

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
        return self._solver_for(tuple(sorted(given))).plan(x, given, start)

    def solve_many(self, X: ArrayLike, **signals: ArrayLike) -> list[Plan]:
        """Plans for the rows of X (n, nx), each warm-started.

        The signals are those of `solve`, the same for all rows; or one for each: `u_prev` as (n, nu), the others with
        a first axis of length n, for example `w` as (n, N, nw). Each starts from the one before.
        """
        rows = as_array("X", X, (None, self.nx))
        each = for_each_state(self, signals, len(rows))
        return [
            self._solver_for(tuple(sorted(given))).plan(x, given, time.perf_counter()) for x, given in zip(rows, each)
        ]

    def __call__(self, x: ArrayLike, **signals: ArrayLike) -> Array:
        """First input: (nx,) -> (nu,) or (n, nx) -> (n, nu), always finite."""
        x = as_floats("x", x)
        if x.ndim == 2:
            rows = as_array("X", x, (None, self.nx))
            return self._first_inputs(rows, for_each_state(self, signals, len(rows)))
        given = spread_signals(self, dict(signals))
        return np.asarray(self._first_inputs(as_array("x", x, (self.nx,))[None], [given])[0])

    def _first_inputs(self, states: Array, given: list[Given]) -> Array:
        """First inputs (n, nu) from states (n, nx)."""
        if not given:
            return np.zeros((0, self.nu))
        return self._solver_for(tuple(sorted(given[0]))).first_inputs(states, given)

    def explain(self, x: ArrayLike, **signals: ArrayLike) -> Explanation:
        """Explanation why the problem from x is infeasible.

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
        solver = self._condensed(tuple(sorted(given)))
        return explain_infeasibility(self, solver.qp, solver.theta(x, given), solver.runaway(x, given))

    def sensitivity(
        self, x: ArrayLike, *, dA: ArrayLike | None = None, dB: ArrayLike | None = None, dE: ArrayLike | None = None,
        dQ: ArrayLike | None = None, dR: ArrayLike | None = None, dS: ArrayLike | None = None,
        dP: ArrayLike | None = None, dX: ArrayLike | None = None, dU: ArrayLike | None = None,
        d_terminal_set: ArrayLike | None = None, d_rate_limit: ArrayLike | None = None, **signals: ArrayLike,
    ) -> PlanSensitivity:  # fmt: skip
        """Plan from x with its exact derivatives by state and parameters.

        Parameters
        ----------
        x : (nx,) array
            State.
        dA, dB, dE, dQ, dR, dS, dP : (·, ·, np) arrays, optional
            ∂A/∂p and so on, the last axis that of the parameters; 0 where they are left out. A terminal weight that is
            the Riccati solution changes with A, B, Q, R and S by itself, as does the rest under a mean; dP is for one
            that was given.
        dX, dU, d_terminal_set : (rows, np) arrays, optional
            ∂h/∂p of the half-spaces {v : Hv <= h} in `state_rows`, `input_rows` and `terminal_rows`.
        d_rate_limit : (nu, np) array, optional
        signals : arrays
            As in `solve`.

        Returns
        -------
        PlanSensitivity
            With a status: weakly active and dependent constraints are named.

        Examples
        --------
        >>> found = controller.sensitivity(x, dA=dA, dB=dB)
        >>> found.input_by_state, found.cost_by_parameters, found.status.advice
        """
        from mpc.sensitivities.along_plan import sensitivity_of
        from mpc.sensitivities.changes import as_changes, linear_model

        given = spread_signals(self, dict(signals))
        plan = self.solve(x, **signals)
        derivatives = {"dA": dA, "dB": dB, "dE": dE, "dQ": dQ, "dR": dR, "dS": dS, "dP": dP, "dX": dX, "dU": dU,
                       "d_terminal_set": d_terminal_set, "d_rate_limit": d_rate_limit}  # fmt: skip
        changes = as_changes(self, derivatives, settles=self.settles(signals))
        return sensitivity_of(self, linear_model(self, given, changes.model), changes, plan, given)

    def explicit(
        self, theta_set: Any = None, *, parameters: tuple[str, ...] = (), max_regions: int = 100_000,
        time_limit: float | None = None, method: str = "tree", tree_time_limit: float | None = 10.0,
    ) -> ExplicitMPC:  # fmt: skip
        """Explicit law as a function of the state.

        Parameters
        ----------
        theta_set : Polytope, optional
            States (and other open parameters, in the order of `build(*parameters).parameters`) of interest; X by
            default, or X × U when a rate limit makes the last input a parameter.
        parameters : tuple of str
            Further quantities to leave open, see `build`.
        max_regions, time_limit : int and float
            Limits on the regions, see `solve_mpqp`.
        method : "tree" or "sequential"
            How regions are found, see `ExplicitMPC.from_partition`.
        tree_time_limit : float
            Wall time for the search tree [s]; a tree that is stopped gives the same law, more slowly.

        Raises
        ------
        InfeasibleError
            No parameter of the set is feasible.
        """
        from mpc.explicit.explicit import ExplicitMPC, default_parameters
        from mpc.explicit.mpqp import solve_mpqp

        if not isinstance(parameters, (str, tuple, list)):
            raise InputError("parameters", repr(parameters), "a tuple of names")
        problem = self.build(*((parameters,) if isinstance(parameters, str) else parameters))
        if theta_set is None:
            theta_set = default_parameters(self, problem)
        partition = solve_mpqp(problem, theta_set, max_regions=max_regions, time_limit=time_limit)
        return ExplicitMPC.from_partition(partition, self.input_rows, method=method, tree_time_limit=tree_time_limit)

    def _solver_for(self, parameters: tuple[str, ...]) -> CondensedSolver | SparseSolver:
        """Solver for a combination of signals, built on demand."""
        return self._condensed(parameters) if self.solver == "daqp" else self._sparse(parameters)

    @cached_property
    def _condensed(self) -> Callable[[tuple[str, ...]], CondensedSolver]:
        """Signals → solver of the condensed QP."""
        return cache(partial(CondensedSolver, self))

    @cached_property
    def _sparse(self) -> Callable[[tuple[str, ...]], SparseSolver]:
        """Signals → solver with the states kept."""
        return cache(partial(SparseSolver, self, solver=self.solver))
