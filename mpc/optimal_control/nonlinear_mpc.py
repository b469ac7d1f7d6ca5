"""Nonlinear model predictive control by sequential quadratic programming."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools_ground.door import as_flag, as_instance
from invariant_sets import Polytope, maximal_positively_invariant_set
from mpc.checks import Array, Immutable, as_array, as_count, as_floats, as_rate_limit, as_seconds
from mpc.exceptions import InputError, NotStabilisableError
from mpc.linear_mpc import LinearMPC
from mpc.optimal_control.c_code import write_c
from mpc.optimal_control.discrete_model import DiscreteModel
from mpc.optimal_control.functions import Statement, compiled, symbols_of
from mpc.optimal_control.ipopt import WARM
from mpc.optimal_control.loop_phase import LoopPhase, as_loop_phase
from mpc.optimal_control.loop_planner import LoopPlanner
from mpc.optimal_control.phase import Phase
from mpc.optimal_control.problem import OptimalControlProblem
from mpc.optimal_control.quadratic_planner import QuadraticPlanner
from mpc.plan import Plan
from mpc.problem import MPCProblem
from mpc.rollout import disturbance, spread_signals
from mpc.sensitivities.along_plan import sensitivity_of
from mpc.sensitivities.changes import as_changes
from mpc.sensitivities.plan_sensitivity import PlanSensitivity
from mpc.tolerances import SOLVERS, STEADY, TARGET_COST
from mpc.tracking import sizes_of


@dataclass(frozen=True, eq=False, repr=False)
class NonlinearMPC(Immutable):
    """Model predictive controller u = controller(x) of x⁺ = f(x, u, w, p).

    Minimises Σ_{k<N} x_k'Qx_k + 2 x_k'Su_k + u_k'Ru_k + x_N'Px_N subject to the model, x_k in X (k = 1 … N), u_k in U
    (k = 0 … N-1) and x_N in the terminal set. Limits, soft limits, rates, references and previews are stated as for
    `LinearMPC`. What is not solved is followed (`FOLLOWED`, a real-time iteration), or replaced by the best of what was
    reached, the plan of the sample before and the law of the linearisation (`LATE`, `REPLACED`), always in U but
    where the rate limit does not let inputs into it (`INFEASIBLE`).

    A `Phase` in place of the step states any costs, limits, conditions at the end and signals instead; then only
    `horizon` (of continuous time), `p`, `rate_limit`, `uses` and what is said of the solver stand beside it.

    Parameters
    ----------
    step : function, casadi.Function or Phase
        The next state; its arguments are named after what they get: x, u, w, p.
    states, inputs : int
        nx and nu.
    Q, R, S, horizon, P, X, U, rate_limit, soft, uses
        See `LinearMPC`; P by default is the Riccati solution of the linearisation at rest.
    terminal_set : "invariant", Polytope or (lower, upper), optional
        "invariant": the largest set in which the regulator of the linearisation keeps X and U for ever, without regard
        to rate limits; near rest it is so of the model, too, as far as that is linear.
    disturbances : int
        nw, of a disturbance w that `solve` is given over the horizon; 0 where it is not.
    mean : (nw,) array, optional
        Disturbance where a call names none; the rest that stands for 0 is that of the linearisation. See `LinearMPC`.
    p : (np,) array
        Parameters of the model; `with_parameters` changes them without building anew.
    iterations : int, optional
        Quadratic programs a sample: 1 is the real-time iteration, which follows the optimum from sample to sample; the
        first sample, with no plan to follow, goes to the optimum, and one whose program leaves hard limits or costs
        twice what would stand in. By default every sample does.
    most_iterations : int
        Of a solver, for one plan that goes to the optimum.
    starts : int
        Plans that a first sample begins at, until more than half of them have led to one optimum; the best is taken.
        They are that of the linear law, the straight way to the reference, the state held, then inputs by chance. They
        are tried again where a plan that is followed leads to no optimum, or to a worse one than the linear law's.
    time_limit : float, optional
        Wall time of a sample [s]. No program but the first is begun that would probably end later, and Ipopt stops
        where an iteration would; the plan is then `LATE`, and the next sample goes on from it.

    Raises
    ------
    InputError
        Besides those of `LinearMPC`: if the model does not rest at x = 0, u = 0, w = 0; of a phase, if something stands
        beside it, its cost falls without end, or `t` or `u_prev` that it depends on is not given with the state.
    NotStabilisableError
        No P is given, and the linearisation at rest has no regulator.

    Attributes
    ----------
    model : DiscreteModel
        The model along plans, with its derivatives.
    linear : LinearMPC
        Linear MPC of the linearisation at rest; of no phase.
    last_plans : tuple of Plan
        Of the last call.

    References
    ----------
    Diehl, Bock and Schlöder, "A real-time iteration scheme for nonlinear optimization in optimal feedback control",
    SIAM Journal on Control and Optimization 43, 2005.
    """

    step: Statement | Phase
    states: Any = None
    inputs: Any = None
    Q: Any = field(default=None, kw_only=True)
    R: Any = field(default=None, kw_only=True)
    horizon: Any = field(default=None, kw_only=True)
    S: Any = field(default=None, kw_only=True)
    P: Any = field(default=None, kw_only=True)
    X: Any = field(default=None, kw_only=True)
    U: Any = field(default=None, kw_only=True)
    terminal_set: Any = field(default=None, kw_only=True)
    rate_limit: Any = field(default=None, kw_only=True)
    soft: tuple[float, float] | None = field(default=None, kw_only=True)
    disturbances: int = field(default=0, kw_only=True)
    mean: Any = field(default=None, kw_only=True)
    p: Any = field(default=(), kw_only=True)
    iterations: int | None = field(default=None, kw_only=True)
    most_iterations: int = field(default=300, kw_only=True)
    starts: int = field(default=3, kw_only=True)
    time_limit: float | None = field(default=None, kw_only=True)
    uses: tuple[str, ...] = field(default=(), kw_only=True)
    model: DiscreteModel = field(init=False)
    _last: list[Plan] = field(init=False, default_factory=list)
    _loop: LoopPhase | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self._set(p=as_array("p", self.p, (None,)))
        for name in ("most_iterations", "starts"):
            self._set(**{name: as_count(name, getattr(self, name))})
        if isinstance(self.step, Phase):
            self._set_phase(self.step)
            return
        if isinstance(self.step, OptimalControlProblem):
            cure = "Give its phase, and its parameters as p=…."
            raise InputError("step", "an OptimalControlProblem", "a Phase, or the next state as a function", cure)
        for name in ("states", "inputs", "horizon"):
            self._set(**{name: as_count(name, getattr(self, name))})
        if self.iterations is not None:
            self._set(iterations=as_count("iterations", self.iterations))
        nw = as_count("disturbances", self.disturbances, least=0)
        self._set(disturbances=nw)
        sizes = {"x": self.states, "u": self.inputs, "w": nw, "p": len(self.p)}
        self._set(model=DiscreteModel(compiled("step", self.step, sizes, self.states), self.horizon))
        _ = self.planner

    def _set_phase(self, phase: Phase) -> None:
        """Take sizes, horizon and model from a phase, which states everything but rates."""
        own = ("states", "inputs", "Q", "R", "S", "P", "X", "U", "terminal_set", "soft", "iterations", "disturbances",
               "mean")  # fmt: skip
        for name in own:
            if getattr(self, name) is not type(self).__dataclass_fields__[name].default:
                raise InputError(name, "an argument beside a phase", "none", "State it in the phase.")
        if tuple(self.uses) not in ((), ("preview",)):
            raise InputError("uses", repr(self.uses), '("preview",), which hands w over, or nothing')
        horizon = None if self.horizon is None else as_count("horizon", self.horizon)
        rate_limit = None if self.rate_limit is None else as_rate_limit(self.rate_limit, phase.inputs)
        loop = as_loop_phase(phase, horizon, self.p, rate_limit)
        self._set(states=phase.states, inputs=phase.inputs, horizon=loop.horizon, disturbances=loop.functions.nw)
        self._set(_loop=loop)
        self._set(model=self.planner.model)

    @cached_property
    def linear(self) -> LinearMPC:
        """Linear MPC of the linearisation at rest."""
        stated = {one.name: getattr(self.problem, one.name) for one in fields(MPCProblem) if one.init}
        return LinearMPC(**stated | {"P": self.problem.given_P})

    @cached_property
    def problem(self) -> MPCProblem:
        """Statement of linear MPC for the linearisation at rest."""
        if self._loop is not None:
            cure = "State them: NonlinearMPC(step, nx, nu, Q=…, R=…, horizon=…)."
            expected = "quadratic costs and polytopes, for C code, derivatives, steady states and offset-free control"
            raise InputError("step", "a Phase", expected, cure)
        x, u, w = np.zeros(self.states), np.zeros(self.inputs), np.zeros(self.disturbances)
        f, A, B, E = self.model.linearised_at(x, u, w, self.p)
        for what, value in (("a next state", f), ("derivatives by x", A), ("derivatives by u", B)):
            if not np.isfinite(value).all():
                raise InputError("step", f"{what} that are not finite at rest", "finite ones at x = 0, u = 0, w = 0")
        n = self.states
        sizes = MPCProblem(A, B, Q=self.Q, R=self.R, horizon=n, P=np.eye(n), X=self.X, U=self.U).state_extent
        if np.abs(f / sizes).max() > STEADY:
            got, cure = f"a model that moves from rest to {f}", "State it in deviations from an equilibrium."
            raise InputError("step", got, "one that stays at x = 0 under u = 0, w = 0", cure)
        try:
            law = MPCProblem(
                A, B, Q=self.Q, R=self.R, S=self.S, horizon=self.horizon, P=self.P, X=self.X, U=self.U,
                E=E if self.disturbances else None,
                terminal_set=None if self._invariant else self.terminal_set, rate_limit=self.rate_limit, soft=self.soft,
                uses=self.uses, mean=self.mean,
            )  # fmt: skip
        except NotStabilisableError as error:
            if self.P is not None:
                raise
            cure = "Or give P, if only the linearisation at rest is the trouble."
            raise NotStabilisableError(f"{error.message} {cure}", error.eigenvalue) from None
        return replace(law, P=law.given_P, terminal_set=_invariant_set(law)) if self._invariant else law

    @property
    def _invariant(self) -> bool:
        """Whether the terminal set is the linearisation's."""
        return isinstance(self.terminal_set, str) and self.terminal_set == "invariant"

    @cached_property
    def planner(self) -> QuadraticPlanner | LoopPlanner:
        """Planner for these parameters."""
        limit = as_seconds("time_limit", self.time_limit)
        if self._loop is not None:
            planner = LoopPlanner(self._loop, self.p, self.most_iterations, self.starts, limit)
            _ = planner.stages
            return planner.built(planner.settings, replace(planner.settings, options=WARM | planner.settings.options))
        return QuadraticPlanner(
            self.problem, self.model, self.p, self.iterations, self.most_iterations, self.starts, limit
        )

    def __repr__(self) -> str:
        how = "converged" if self.iterations is None else f"{self.iterations} a sample"
        return f"NonlinearMPC({self.states} states, {self.inputs} inputs, N={self.horizon}, {how})"

    @property
    def needs(self) -> frozenset[str]:
        """Signals a closed loop hands over; see `LinearMPC.needs`."""
        if self._loop is not None:
            own = {"last_input": self._loop.carries, "time": self._loop.timed}
            return frozenset(self.uses) | {name for name, asked in own.items() if asked}
        return self.problem.needs

    @property
    def last_plans(self) -> tuple[Plan, ...]:
        """Plans of the last call, one for each row."""
        return tuple(self._last)

    def with_parameters(self, p: ArrayLike, *, follow: bool = False) -> NonlinearMPC:
        """Controller for other parameters p (np,), with the same model.

        Where asked to `follow` it goes on from the last plans, as where an estimator tells p anew at each sample.
        """
        value = as_array("p", p, (len(self.p),))
        other = copy.copy(self)
        for name in ("linear", "problem", "planner", "steady_solver"):
            other.__dict__.pop(name, None)
        for name, own in (("p", value), ("_last", list(self._last) if as_flag("follow", follow) else [])):
            object.__setattr__(other, name, own)
        if isinstance(self.planner, LoopPlanner):
            other.__dict__["planner"] = self.planner.with_parameters(value)
        _ = other.planner
        return other

    def reset(self, n: int | None = None) -> None:
        """Forget the plans of the last sample, before `n` other runs."""
        self._last.clear()

    def __copy__(self) -> NonlinearMPC:
        """Copy without plans of a last sample."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        other.__dict__["_last"] = []
        return other

    def __deepcopy__(self, memo: Any) -> NonlinearMPC:
        return copy.copy(self)

    def __getstate__(self) -> dict[str, Any]:
        """State with the model as CasADi stores it."""
        kept = {name: value for name, value in self.__dict__.items() if name != "steady_solver"}
        if self._loop is not None:
            return {name: value for name, value in kept.items() if name != "planner"}
        return kept | {"step": self.model.step}

    def solve(
        self, x: ArrayLike, *, start: Plan | None = None, u_prev: ArrayLike | None = None,
        x_ref: ArrayLike | None = None, u_ref: ArrayLike | None = None, w: ArrayLike | None = None,
        t: float | None = None,
    ) -> Plan:  # fmt: skip
        """Plan from the state x (nx,); the signals are those of `LinearMPC.solve`.

        With a phase they are `u_prev`, `t` and `w`, (N + 1, nw), (N, nw) or (nw,), where it depends on them. This
        w is held over each sample; in continuous time the phase's own signal is linear over it. It begins anew: in a
        loop call the controller, which follows its last plan, and read `last_plans`.

        Parameters
        ----------
        start : Plan, optional
            The plan to begin from, of the same time; by default the linear law's.
        """
        x = as_array("x", x, (self.states,))
        self._check_start(start)
        given = {"u_prev": u_prev, "x_ref": x_ref, "u_ref": u_ref, "w": w, "t": t}
        planner = self.planner
        return planner.plan(x, planner.signals(given), start)

    def sensitivity(
        self, x: ArrayLike, *, start: Plan | None = None, dQ: ArrayLike | None = None, dR: ArrayLike | None = None,
        dS: ArrayLike | None = None, dP: ArrayLike | None = None, dX: ArrayLike | None = None,
        dU: ArrayLike | None = None, d_terminal_set: ArrayLike | None = None, d_rate_limit: ArrayLike | None = None,
        **signals: ArrayLike,
    ) -> PlanSensitivity:  # fmt: skip
        """Optimum from x with its exact derivatives by x and p.

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
        x = as_array("x", x, (self.states,))
        self._check_start(start)
        given = spread_signals(self.problem, dict(signals))
        planner: Any = self.planner
        to_the_end = replace(planner, iterations=None, time_limit=np.inf)
        plan = to_the_end.plan(x, given, start)
        dA, dB, dE = self.model.at_rest(self.p)
        own = {"dQ": dQ, "dR": dR, "dS": dS, "dP": dP, "dX": dX, "dU": dU, "d_terminal_set": d_terminal_set,
               "d_rate_limit": d_rate_limit, "dA": dA, "dB": dB, "dE": dE if self.disturbances else None}  # fmt: skip
        changes = as_changes(self.problem, own, len(self.p), settles=self.problem.settles(signals))
        derivatives = self.model.along_signals(disturbance(self.problem, given), self.p)
        return sensitivity_of(self.problem, derivatives, changes, plan, given)

    @cached_property
    def steady_solver(self) -> ca.Function:
        """Ipopt for steady states nearest to a reference, in X and U.

        Its parameters are C'C, C'r, w and p; its unknowns states and inputs in their sizes, its rows the drift of the
        states, then those of X and U less their bounds.
        """
        law, model = self.problem, self.model
        size, nx = sizes_of(law), law.nx
        _, _, w, p = symbols_of(model.step).values()
        kind = type(w)
        z, squares, slope = kind.sym("z", len(size)), kind.sym("squares", nx, nx), kind.sym("slope", nx)
        x, u = ca.vertsplit(z * size, [0, nx, len(size)])
        cost = ca.bilin(law.Q, x) + ca.bilin(law.R, u) + 2 * ca.dot(x, ca.DM(law.cross) @ u)
        most = float(sum(np.diag(law.Q) * size[:nx] ** 2) + sum(np.diag(law.R) * size[nx:] ** 2)) or 1.0
        rows = [
            (ca.DM(H) @ value - h) / law.row_units[name]
            for name, value, (H, h) in (("state", x, law.state_rows), ("input", u, law.input_rows))
        ]
        drift = (model.step(x, u, w, p) - x) / law.state_extent
        program = {
            "x": z, "p": ca.vertcat(ca.vec(squares), slope, w, p), "g": ca.vertcat(drift, *rows),
            "f": ca.bilin(squares, x) - 2 * ca.dot(slope, x) + TARGET_COST * cost / most,
        }  # fmt: skip
        return ca.nlpsol("steady_state", "ipopt", program, {
            "ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "ipopt.tol": SOLVERS,
            "ipopt.max_iter": 200, "ipopt.bound_relax_factor": 0.0, "show_eval_warnings": False,
        })  # fmt: skip

    def _check_start(self, start: Any) -> None:
        """Raise unless it is None or a plan of this controller."""
        as_instance("start", start, (Plan, type(None)), "a Plan of this controller")
        if start is not None and (start.states.shape, start.inputs.shape) != (
            (self.horizon + 1, self.states), (self.horizon, self.inputs)
        ):  # fmt: skip
            got = f"a plan of {len(start.inputs)} steps, {start.states.shape[1]} states, {start.inputs.shape[1]} inputs"
            raise InputError("start", got, f"{self.horizon} steps, {self.states} states, {self.inputs} inputs")

    def __call__(self, x: ArrayLike, **signals: ArrayLike) -> Array:
        """First input: (nx,) -> (nu,) or (n, nx) -> (n, nu), row by row."""
        value = as_floats("x", x)
        rows = as_array("x", np.atleast_2d(value), (None, self.states))
        planner = self.planner
        each = planner.each(dict(signals), len(rows))
        follow = self._last if len(self._last) == len(rows) else [None] * len(rows)
        plans = [
            planner.plan(row, given, None if plan is None else planner.shifted(plan, given))
            for row, given, plan in zip(rows, each, follow)
        ]
        self._last[:] = plans
        first = np.array([plan.inputs[0] for plan in plans]).reshape(len(rows), self.inputs)
        return first if value.ndim == 2 else first[0]

    def to_c(self, folder: str | Path) -> Path:
        """Write a real-time iteration as C: `nonlinear_mpc.c` and header.

        It contains `iteration` (model, derivatives, quadratic program and an interior-point method), `step` and
        `derivatives`, called as CasADi calls C: `iteration_work` tells how long its four arrays are to be. Arguments of
        `iteration`, by columns, are state (nx), states (nx, N + 1) and inputs (nu, N) of the plan before as it was
        returned, then, where the law has them, disturbances (nw, N) and parameters (np), state_ref (nx, N + 1),
        input_ref (nu, N) and, with a rate limit, last_input (nu); NULL stands for zeros. Results are new_states,
        new_inputs, whose first column is to be applied, and residual. Left to the caller: the first plan, and what
        stands in where a plan is late or its residual above 1e-9, not solved, as may be far outside the limits.

        As the plan before is shifted within, a first plan comes of calls at the first state whose plans get their first
        columns twice and lose their last. For what is not solved the second column of the plan before may stand in; the
        next call gets that shifted by one, its last column twice. Where that lasts, begin anew. U is a box.

        Parameters
        ----------
        folder : str or Path
            Created when missing.

        Returns
        -------
        Path
            The C file; `casadi.external("iteration", …)` loads what a compiler makes of it.

        Raises
        ------
        InputError
            A folder that cannot be written; or U is no box.
        """
        return write_c(self.problem, self.model, folder)


def _invariant_set(law: MPCProblem) -> Polytope:
    """Largest set in which the linearisation keeps X and U under LQR."""
    (HX, hX), (HU, hU) = law.about_rest["state"], law.about_rest["input"]
    if not len(hX) + len(hU):
        raise InputError("terminal_set", "'invariant'", "a set, or None", "Without X and U every state is in it.")
    both = Polytope(np.vstack([HX, -HU @ law.gain]), np.concatenate([hX, hU]))
    found = maximal_positively_invariant_set(law.A - law.B @ law.gain, both)
    if found.set.is_empty:
        got = f"'invariant', of which none was found ({found.status.name})"
        raise InputError("terminal_set", got, "one about the rest, which is 0 without a mean", found.status.advice)
    return Polytope(found.set.A, found.set.b + found.set.A @ law.rest[0])
