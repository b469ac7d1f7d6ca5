"""Nonlinear model predictive control: sequential quadratic programming along the plan of the sample before."""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mpc.checks import Array, as_array, as_count, as_floats
from mpc.exceptions import InputError
from mpc.halfspaces import nearest_points
from mpc.linear_mpc import LinearMPC
from mpc.optimal_control.discrete_model import DiscreteModel
from mpc.optimal_control.functions import Statement, compiled
from mpc.optimal_control.model_derivatives import ModelDerivatives
from mpc.optimal_control.sqp import Sequential, Step
from mpc.plan import Plan, Residuals, Status
from mpc.rollout import Given, admissible, cost_of, violation_of
from mpc.sensitivities.along_plan import sensitivity_of
from mpc.sensitivities.changes import as_changes
from mpc.sensitivities.plan_sensitivity import PlanSensitivity
from mpc.solve_arguments import for_each_state, spread_signals

CONVERGED = 1e-7  # gaps in sizes of the states, and stationarity relative to the gradients that balance
REPORTED = 1e-5  # of the same, above which a plan is called inaccurate
FEASIBLE = 1e-6  # violation of a limit, in its unit, that is rounding
AT_REST = 1e-9  # how far a step may leave the rest
SHORTEST = 2.0**-10  # part of a step that is tried
DEAR = 100.0  # price of violating a hard limit by one unit where it must be, in costs of the first plan
ROUNDING = 1e-12  # of the merit
ENOUGH = 1e-4  # part of the promised decrease that is asked for


@dataclass(frozen=True, eq=False, repr=False)
class NonlinearMPC:
    """Model predictive controller of x⁺ = f(x, u, w, p), a callable u = controller(x).

    Minimises Σ_{k<N} x_k'Qx_k + 2 x_k'Su_k + u_k'Ru_k + x_N'Px_N subject to the model, x_k in X (k = 1 … N), u_k in U
    (k = 0 … N-1) and x_N in the terminal set. Limits, soft limits, rates, references and previews are stated as for
    `LinearMPC`, whose law of the linearisation at rest stands in where no plan is found.

    Parameters
    ----------
    step : function or casadi.Function
        The next state; its arguments are named after what they get: x, u, w, p.
    states, inputs : int
        nx and nu.
    Q, R, S, horizon, P, X, U, terminal_set, rate_limit, soft, uses
        See `LinearMPC`; P by default is the Riccati solution of the linearisation at rest.
    disturbances : int
        nw, of a disturbance w that `solve` is given over the horizon; 0 where it is not.
    p : (np,) array
        Parameters of the model; `with_parameters` changes them without building anew.
    iterations : int, optional
        Quadratic programs a sample: 1 is the real-time iteration, which follows the optimum from sample to sample. By
        default they go on until the optimality conditions hold.

    Raises
    ------
    InputError
        Besides those of `LinearMPC`: if the model does not rest at x = 0, u = 0, w = 0.

    References
    ----------
    Diehl, Bock and Schlöder, "A real-time iteration scheme for nonlinear optimization in optimal feedback control",
    SIAM Journal on Control and Optimization 43, 2005.
    """

    step: Statement
    states: int
    inputs: int
    Q: Any = field(kw_only=True)
    R: Any = field(kw_only=True)
    horizon: int = field(kw_only=True)
    S: Any = field(default=None, kw_only=True)
    P: Any = field(default=None, kw_only=True)
    X: Any = field(default=None, kw_only=True)
    U: Any = field(default=None, kw_only=True)
    terminal_set: Any = field(default=None, kw_only=True)
    rate_limit: Any = field(default=None, kw_only=True)
    soft: tuple[float, float] | None = field(default=None, kw_only=True)
    disturbances: int = field(default=0, kw_only=True)
    p: Any = field(default=(), kw_only=True)
    iterations: int | None = field(default=None, kw_only=True)
    most_iterations: int = field(default=100, kw_only=True)
    uses: tuple[str, ...] = field(default=(), kw_only=True)
    _model: DiscreteModel = field(init=False)
    _last: list[Plan] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        for name in ("states", "inputs", "horizon", "most_iterations"):
            set_(self, name, as_count(name, getattr(self, name)))
        if self.iterations is not None:
            set_(self, "iterations", as_count("iterations", self.iterations))
        nw = 0 if self.disturbances == 0 else as_count("disturbances", self.disturbances)
        set_(self, "disturbances", nw)
        set_(self, "p", as_array("p", self.p, (None,)))
        sizes = {"x": self.states, "u": self.inputs, "w": nw, "p": len(self.p)}
        set_(self, "_model", DiscreteModel(compiled("step", self.step, sizes, self.states), self.horizon))
        _ = self.linear

    @cached_property
    def linear(self) -> LinearMPC:
        """Linear MPC of the linearisation at rest, with the same weights and limits."""
        x, u, w = np.zeros(self.states), np.zeros(self.inputs), np.zeros(self.disturbances)
        f, A, B = self._model.linearised_at(x, u, w, self.p)
        for what, value in (("a next state", f), ("derivatives by x", A), ("derivatives by u", B)):
            if not np.isfinite(value).all():
                raise InputError("step", f"{what} that are not finite at rest", "finite ones at x = 0, u = 0, w = 0")
        if self.states and np.abs(f).max() > AT_REST:
            got, cure = f"a model that moves from rest to {f}", "State it in deviations from an equilibrium."
            raise InputError("step", got, "one that stays at x = 0 under u = 0, w = 0", cure)
        E = None
        if self.disturbances:
            E = np.zeros((self.states, self.disturbances))
            for i, unit in enumerate(np.eye(self.disturbances)):
                E[:, i] = 0.5 * (
                    self._model.linearised_at(x, u, unit, self.p)[0] - self._model.linearised_at(x, u, -unit, self.p)[0]
                )
        law = LinearMPC(
            A, B, Q=self.Q, R=self.R, S=self.S, horizon=self.horizon, P=self.P, X=self.X, U=self.U, E=E,
            terminal_set=self.terminal_set, rate_limit=self.rate_limit, soft=self.soft, uses=self.uses,
        )  # fmt: skip
        return law

    @cached_property
    def _sequence(self) -> Sequential:
        return Sequential(self.linear, self._model)

    def __repr__(self) -> str:
        how = "converged" if self.iterations is None else f"{self.iterations} a sample"
        return f"NonlinearMPC({self.states} states, {self.inputs} inputs, N={self.horizon}, {how})"

    @property
    def needs(self) -> frozenset[str]:
        """What a closed loop hands over at every step besides the state, see `LinearMPC.needs`."""
        return self.linear.needs

    def with_parameters(self, p: ArrayLike) -> NonlinearMPC:
        """The same controller for other parameters p (np,), without building the model anew."""
        value = as_array("p", p, (len(self.p),))
        other = copy.copy(self)
        for name in ("linear", "_sequence"):
            other.__dict__.pop(name, None)
        object.__setattr__(other, "p", value)
        object.__setattr__(other, "_last", [])
        _ = other.linear
        return other

    def reset(self, n: int | None = None) -> None:
        """Forget the plans of the last sample: what comes next are other runs, `n` of them."""
        self._last.clear()

    def __deepcopy__(self, memo: Any) -> NonlinearMPC:
        other = copy.copy(self)
        object.__setattr__(other, "_last", [])
        return other

    def solve(
        self, x: ArrayLike, *, start: Plan | None = None, u_prev: ArrayLike | None = None,
        x_ref: ArrayLike | None = None, u_ref: ArrayLike | None = None, w: ArrayLike | None = None,
    ) -> Plan:  # fmt: skip
        """Plan from the state x (nx,); the signals are those of `LinearMPC.solve`.

        Parameters
        ----------
        start : Plan, optional
            The plan to begin from, such as that of the sample before, `shifted`; by default the linear law's.
        """
        x = as_array("x", x, (self.states,))
        given = spread_signals(self.linear, {"u_prev": u_prev, "x_ref": x_ref, "u_ref": u_ref, "w": w})
        return self._plan(x, given, start)

    def sensitivity(
        self, x: ArrayLike, *, start: Plan | None = None, dQ: ArrayLike | None = None, dR: ArrayLike | None = None,
        dS: ArrayLike | None = None, dP: ArrayLike | None = None, dX: ArrayLike | None = None,
        dU: ArrayLike | None = None, d_terminal_set: ArrayLike | None = None, d_rate_limit: ArrayLike | None = None,
        **signals: ArrayLike,
    ) -> PlanSensitivity:  # fmt: skip
        """The optimum from x with its exact derivatives by x and the parameters p: ∂u_0/∂x, ∂u_0/∂p, ∂J*/∂p and more.

        Second derivatives are those of the Lagrangian, of the model's curvature too. The optimum is iterated to its
        end, also where `iterations` says otherwise.

        Parameters
        ----------
        x : (nx,) array
            State.
        start : Plan, optional
            See `solve`.
        dQ, dR, dS, dP, dX, dU, d_terminal_set, d_rate_limit : (…, np) arrays, optional
            Where weights and limits change with p, too: see `LinearMPC.sensitivity`.
        signals : arrays
            As in `solve`.

        Returns
        -------
        PlanSensitivity
            With a status: weakly active and dependent constraints are named.
        """
        converged = copy.copy(self)
        object.__setattr__(converged, "iterations", None)
        x = as_array("x", x, (self.states,))
        given = spread_signals(self.linear, dict(signals))
        plan = converged._plan(x, given, start)
        w = given["w"].reshape(self.horizon, -1) if "w" in given else np.zeros((self.horizon, self.disturbances))
        derivatives = self._model_derivatives
        at_rest = derivatives.at_rest(self.p)
        own = {"dQ": dQ, "dR": dR, "dS": dS, "dP": dP, "dX": dX, "dU": dU, "d_terminal_set": d_terminal_set,
               "d_rate_limit": d_rate_limit, "dA": at_rest[0], "dB": at_rest[1]}  # fmt: skip
        changes = as_changes(self.linear, own, len(self.p))
        return sensitivity_of(self.linear, derivatives.under(w, self.p), changes, plan, given)

    @cached_property
    def _model_derivatives(self) -> ModelDerivatives:
        return ModelDerivatives(self._model.step, self.horizon)

    def __call__(self, x: ArrayLike, **signals: ArrayLike) -> Array:
        """First input: (nx,) -> (nu,) or (n, nx) -> (n, nu), each row from its own plan of the sample before."""
        value = as_floats("x", x)
        rows = as_array("x", np.atleast_2d(value), (None, self.states))
        each = for_each_state(self.linear, dict(signals), len(rows))
        follow = self._last if len(self._last) == len(rows) else [None] * len(rows)
        plans = [
            self._plan(row, given, None if plan is None else shifted(plan, self.linear))
            for row, given, plan in zip(rows, each, follow)
        ]
        self._last[:] = plans
        first = np.array([plan.inputs[0] for plan in plans]).reshape(len(rows), self.inputs)
        return first if value.ndim == 2 else first[0]

    def _plan(self, x: Array, given: Given, start: Plan | None) -> Plan:
        """The plan from a state, begun at another or at that of the linear law."""
        began = time.perf_counter()
        N = self.horizon
        w = given["w"].reshape(N, -1) if "w" in given else np.zeros((N, self.disturbances))
        states, inputs = self._first(x, w) if start is None else (start.states.copy(), start.inputs.copy())
        inputs = admissible(self.linear, inputs, given)
        sequence = self._sequence
        last: Step | None = None
        gap_price = limit_price = 0.0
        dear = DEAR * max(cost_of(self.linear, inputs, states, given), float(np.finfo(float).tiny))
        for _ in range(self.iterations or self.most_iterations):
            last = sequence.step(x, states, inputs, w, self.p, given, dear)
            if not (last.solved and np.isfinite(last.inputs).all() and np.isfinite(last.states).all()):
                last = None
                break
            if self.iterations is not None:
                states, inputs = states + last.states, inputs + last.inputs
                continue
            if last.defects <= CONVERGED and last.stationarity <= CONVERGED:
                break
            gap_price, limit_price = max(gap_price, last.gap_price), max(limit_price, last.limit_price)
            part = self._length(last, x, states, inputs, w, given, (gap_price, limit_price))
            if part is None:
                break
            states, inputs = states + part * last.states, inputs + part * last.inputs
        return self._packed(x, states, inputs, w, given, last, began)

    def _first(self, x: Array, w: Array) -> tuple[Array, Array]:
        """States (N + 1, nx) and inputs (N, nu) of the linear law on the model itself."""
        gain = self.linear.gain
        states, inputs = np.empty((self.horizon + 1, self.states)), np.empty((self.horizon, self.inputs))
        states[0] = x
        for k in range(self.horizon):
            inputs[k] = nearest_points((-gain @ states[k])[None], *self.linear.input_rows)[0]
            after = np.asarray(self._model.step(states[k], inputs[k], w[k], self.p), dtype=float).ravel()
            states[k + 1] = after if np.isfinite(after).all() else states[k]
        return states, inputs

    def _length(self, step: Step, x: Array, states: Array, inputs: Array, w: Array, given: Given,
                prices: tuple[float, float]) -> float | None:  # fmt: skip
        """The part of a step that brings the merit down; None if none does."""
        merit = self._sequence.merit
        now = merit(x, states, inputs, w, self.p, given, prices)
        promised = ENOUGH * max(step.decrease, 0.0)
        part = 1.0
        while part >= SHORTEST:
            then = merit(x, states + part * step.states, inputs + part * step.inputs, w, self.p, given, prices)
            if np.isfinite(then) and then <= now - part * promised + ROUNDING * abs(now):
                return part
            part *= 0.5
        return None

    def _packed(self, x: Array, states: Array, inputs: Array, w: Array, given: Given, last: Step | None,
                began: float) -> Plan:  # fmt: skip
        """The plan, with the states that its inputs lead to on the model."""
        solver = "SQP" if self.iterations is None else "real-time iteration"
        inputs = admissible(self.linear, inputs, given)
        rolled = self._model.rolled(x, inputs, w, self.p)
        states = rolled if np.isfinite(rolled).all() else states
        violation = violation_of(self.linear, states)
        status = Status.INACCURATE
        residuals = Residuals(np.inf, np.inf, np.inf, np.inf)
        if last is not None:
            residuals = Residuals(last.stationarity, last.defects, 0.0, 0.0)
            if residuals.worst <= REPORTED:
                status = Status.SOFTENED if last.relaxed else Status.SOLVED
        cost = cost_of(self.linear, inputs, states, given)
        return Plan(inputs, states, cost, status, residuals, violation, time.perf_counter() - began, solver)


def shifted(plan: Plan, law: LinearMPC) -> Plan:
    """A plan one sample later: its last input is the linear law's, held in U."""
    end = nearest_points((-law.gain @ plan.states[-1])[None], *law.input_rows)[0]
    after = law.A @ plan.states[-1] + law.B @ end
    return replace(plan, inputs=np.vstack([plan.inputs[1:], end]), states=np.vstack([plan.states[1:], after]))
