"""Moving-horizon estimation of states and parameters within limits."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from ccdtools_ground.door import as_record, as_share, brief
from ccdtools_ground.outcome import Outcome
from mpc.checks import Array, as_array, as_count, as_floats
from mpc.exceptions import InputError
from mpc.optimal_control.bounds import as_bounds, check_within
from mpc.optimal_control.estimation.parameter_estimation import as_covariance, moved_by_noise
from mpc.optimal_control.estimation.window import NoisyModel, Window, WindowProgram
from mpc.optimal_control.functions import Statement, compiled, symbols_of


class WindowStatus(Outcome):
    """Outcome of a sample; the value is the advice."""

    SOLVED = (
        "Solved: a locally most likely course within the limits, checked apart from the solver. Another may lie "
        "elsewhere."
    )
    FILTERED = (
        "No optimum of the window was confirmed: the estimate is the extended Kalman filter's, which knows no limits. "
        "Check that limits on states and disturbances can hold together, and that the model is finite within them."
    )
    HELD = (
        "Outputs or inputs led to where the model or its slopes are not finite: the window begins anew without them. "
        "Look for outliers, give an `x0` at which the model is finite, and `x_bounds` within which it is."
    )


@dataclass(frozen=True, eq=False)
class MovingHorizonBelief:
    """Estimates of n runs.

    Attributes
    ----------
    mean, covariance : (n, nx) and (n, nx, nx) arrays
        Of the state; the covariance by linearisation, without regard to limits.
    parameters : (n, np) array
    status : tuple of WindowStatus
        What the last call came to, of each run.
    windows : tuple of Window
    """

    mean: Array
    covariance: Array
    parameters: Array
    status: tuple[WindowStatus, ...]
    windows: tuple[Window, ...]


@dataclass(frozen=True, eq=False)
class MovingHorizonEstimates:
    """Estimates along a record of n runs and T samples.

    Attributes
    ----------
    means, covariances : (n, T, nx) and (n, T, nx, nx) arrays
    parameters : (n, T, np) array
    status : list of tuples of WindowStatus
        What each sample came to, of each run.
    """

    means: Array
    covariances: Array
    parameters: Array
    status: list[tuple[WindowStatus, ...]]


@dataclass(frozen=True, eq=False, repr=False)
class MovingHorizonEstimator:
    """Most likely states and parameters over the last samples, within limits.

    Of x⁺ = f(x, u, w, p), y_k = h(x_k, u_{k-1}, p) + v_k.
    What came before the window is kept as mean and covariance, which an extended Kalman filter carries
    on, linearised at the smoothed states (arrival cost). On a linear model without limits it is the Kalman filter.
    It has no memory itself and is called like one: ``Observed(controller, estimator)`` closes the loop.

    Parameters
    ----------
    step : function or casadi.Function
        The next state; its arguments are named after what they get: x, u, w, p. As for `NonlinearMPC`.
    output : function of x, u, p
        y, in CasADi.
    states, inputs : int
        nx and nu.
    window : int
        Samples, the present one among them.
    W : (nw, nw) or (nw,) array
        Covariance of the disturbance w of a sample, or its variances.
    V : (ny, ny) or (ny,) array
        Covariance of the measurement noise, or its variances.
    P0 : (nx, nx) or (nx,) array
        Covariance of the first state about `x0`, before the first measurement; may be singular.
    x0 : (nx,) array, optional
        0 by default.
    p : (np,) array
        First estimate of the parameters.
    P_p : (np, np) or (np,) array, optional
        Its covariance; known parameters by default.
    p_drift : (np,) array, optional
        Variances by which parameters drift in a sample; constant by default.
    x_bounds, w_bounds, p_bounds : (lower, upper), optional
        Limits, kept at every sample of the window.
    tolerance : float
        Of the solver, on scaled unknowns.

    Raises
    ------
    InputError
        If functions, sizes or covariances cannot be meant; while it runs, if outputs are infinite.

    References
    ----------
    Rao, Rawlings and Mayne, "Constrained state estimation for nonlinear discrete-time systems: stability and moving
    horizon approximations", IEEE Transactions on Automatic Control 48, 2003.

    Examples
    --------
    >>> estimator = MovingHorizonEstimator(step, lambda x: x[0], 2, 1, window=10, W=[1e-4], V=[1e-2], P0=[1, 1])
    >>> controller = Observed(law, estimator)  # doctest: +SKIP
    """

    step: Statement
    output: Statement
    states: int
    inputs: int
    window: int = field(kw_only=True)
    W: Any = field(kw_only=True)
    V: Any = field(kw_only=True)
    P0: Any = field(kw_only=True)
    x0: Any = field(default=None, kw_only=True)
    p: Any = field(default=(), kw_only=True)
    P_p: Any = field(default=None, kw_only=True)
    p_drift: Any = field(default=None, kw_only=True)
    x_bounds: Any = field(default=None, kw_only=True)
    w_bounds: Any = field(default=None, kw_only=True)
    p_bounds: Any = field(default=None, kw_only=True)
    tolerance: float = field(default=1e-10, kw_only=True)
    _programs: dict[int, WindowProgram] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        for name in ("states", "window"):
            set_(self, name, as_count(name, getattr(self, name)))
        set_(self, "inputs", as_count("inputs", self.inputs, least=0))
        nx = self.states
        set_(self, "x0", as_array("x0", np.zeros(nx) if self.x0 is None else self.x0, (nx,)))
        set_(self, "p", as_array("p", self.p, (None,)))
        set_(self, "P0", as_covariance("P0", self.P0, nx, singular=True))
        count = len(self.p)
        given = np.zeros(count) if self.P_p is None else self.P_p
        set_(self, "P_p", as_covariance("P_p", given, count, singular=True))
        drift = as_array("p_drift", np.zeros(count) if self.p_drift is None else self.p_drift, (count,))
        if (drift < 0).any():
            raise InputError("p_drift", drift, "variances ≥ 0")
        set_(self, "p_drift", drift)
        set_(self, "W", as_covariance("W", self.W, None))
        set_(self, "V", as_covariance("V", self.V, None))
        for name, size in (("x_bounds", nx), ("w_bounds", len(self.W)), ("p_bounds", count)):
            set_(self, name, as_bounds(name, getattr(self, name), size))
        for name, limits in (("x0", "x_bounds"), ("p", "p_bounds")):
            check_within(name, getattr(self, name), limits, getattr(self, limits))
        set_(self, "tolerance", as_share("tolerance", self.tolerance))
        _ = self.model

    def __repr__(self) -> str:
        sizes = f"{self.states} states, {len(self.p)} parameters, {self.inputs} inputs, {self.ny} outputs"
        return f"MovingHorizonEstimator({sizes}, window of {self.window})"

    def __deepcopy__(self, memo: Any) -> MovingHorizonEstimator:
        """The estimator itself, which has no memory."""
        return self

    @property
    def nx(self) -> int:
        """Number of states."""
        return self.states

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self.inputs

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return len(self.V)

    @cached_property
    def model(self) -> NoisyModel:
        """Model of z = (x, p) with unit noise."""
        nx, count, nw = self.states, len(self.p), len(self.W)
        f = moved_by_noise("step", compiled("step", self.step, {"x": nx, "u": self.inputs, "w": nw, "p": count}, nx))
        h = compiled("output", self.output, {"x": nx, "u": self.inputs, "p": count}, self.ny)
        moving = np.flatnonzero(self.p_drift > 0)
        of_w, drift = np.linalg.cholesky(self.W), np.diag(np.sqrt(self.p_drift))[:, moving]
        kind = type(symbols_of(f)["x"])
        z, u, v = (
            kind.sym(name, size) for name, size in (("z", nx + count), ("u", self.inputs), ("v", nw + len(moving)))
        )
        after = f(z[:nx], u, ca.mtimes(ca.DM(of_w), v[:nw]), z[nx:])
        moved = ca.mtimes(ca.DM(drift), v[nw:]) if len(moving) else 0
        whole = ca.vertcat(after, z[nx:] + moved) if count else after
        other = type(symbols_of(h)["x"])
        seen, held = other.sym("z", nx + count), other.sym("u", self.inputs)
        sizes = np.abs(np.concatenate([self.x0, self.p])) + np.sqrt(np.diag(self._first_covariance))
        low, high = (np.concatenate(sides) for sides in zip(self.x_bounds, self.p_bounds))
        return NoisyModel(
            ca.Function("f", [z, u, v], [ca.densify(whole)], ["z", "u", "v"], ["after"]),
            ca.Function("h", [seen, held], [ca.densify(h(seen[:nx], held, seen[nx:]))], ["z", "u"], ["y"]),
            self.V, (low, high),
            np.hstack([of_w, np.zeros((nw, len(moving)))]), self.w_bounds, np.where(sizes > 0, sizes, 1.0),
        )  # fmt: skip

    @property
    def _first_covariance(self) -> Array:
        """Covariance of the first x and p."""
        return np.asarray(block_diag(self.P0, self.P_p))

    def start(self, n: int) -> MovingHorizonBelief:
        """Belief of n runs before the first measurement."""
        z = np.concatenate([self.x0, self.p])
        P = self._first_covariance
        return self._belief([(self._begun(z, P), WindowStatus.SOLVED)] * as_count("n", n))

    def _begun(self, z: Array, P: Array) -> Window:
        """Window without samples."""
        return Window(z, P, np.zeros((0, self.ny)), np.zeros((0, self.inputs)), z[None], P, (z, P), z)

    def predict(self, belief: MovingHorizonBelief, u: ArrayLike) -> MovingHorizonBelief:
        """Belief one sample later, after inputs (n, nu)."""
        inputs = self._inputs_of(belief, u, ahead=0)
        return self._belief([self._ahead(window, row) for window, row in zip(belief.windows, inputs)])

    def _ahead(self, window: Window, u: Array) -> tuple[Window, WindowStatus]:
        """Window with the state one sample later, and its status.

        Outputs or inputs may have led to where there is no step: then it is that from before them, or none.
        """
        y, (left_out, still) = window.outputs[-1], window.without_the_last()
        for one in (window, left_out, still):
            before = one.course[-1]
            mean, P = self.model.predicted(before, u, before, one.last)
            mean = np.where(np.isfinite(mean), np.clip(mean, *self.model.bounds), mean)
            P = P if np.isfinite(P).all() else one.last
            if one is still or not np.isfinite(mean).all():
                continue
            if self.model.told(before, u, y) <= self.model.told(mean, u, y):
                met = before if np.isfinite(y).any() else one.met
                ahead = replace(one, course=np.vstack([one.course, mean]), last=P, foretold=(mean, P), met=met)
                return ahead, WindowStatus.SOLVED if one is window else WindowStatus.HELD
        return self._begun(before, P), WindowStatus.HELD

    def update(self, belief: MovingHorizonBelief, y: ArrayLike, u: ArrayLike) -> MovingHorizonBelief:
        """Belief after outputs (n, ny), or NaN, of inputs (n, nu)."""
        inputs, outputs = self._inputs_of(belief, u, ahead=1), as_floats("y", y)
        if outputs.shape != (len(belief.windows), self.ny) or np.isinf(outputs).any():
            got = "infinite values" if np.isinf(outputs).any() else f"shape {outputs.shape}"
            raise InputError("y", got, f"({len(belief.windows)}, {self.ny}), finite, NaN where there is none")
        return self._belief([self._updated(*row) for row in zip(belief.windows, belief.status, outputs, inputs)])

    def filter(self, outputs: ArrayLike, inputs: ArrayLike) -> MovingHorizonEstimates:
        """Estimates along outputs ([n,] T, ny), or NaN, and inputs ([n,] T, nu).

        ``inputs[k]`` is held from sample k to k + 1; before the first the input is 0.
        """
        y, u = as_record("outputs", outputs, self.ny), as_record("inputs", inputs, self.nu)
        if u.shape[:2] != y.shape[:2]:
            raise InputError("inputs", f"shape {u.shape}", f"{(*y.shape[:2], self.nu)}, as many as outputs")
        last = np.zeros((len(y), self.nu))
        beliefs = [self.update(self.start(len(y)), y[:, 0], last)]
        for k in range(1, y.shape[1]):
            beliefs.append(self.update(self.predict(beliefs[-1], u[:, k - 1]), y[:, k], u[:, k - 1]))
        means, covariances, parameters = (
            np.stack([getattr(one, name) for one in beliefs], axis=1) for name in ("mean", "covariance", "parameters")
        )
        return MovingHorizonEstimates(means, covariances, parameters, [one.status for one in beliefs])

    def _inputs_of(self, belief: MovingHorizonBelief, u: ArrayLike, *, ahead: int) -> Array:
        """Inputs (n, nu), for states that many samples ahead of outputs."""
        if not isinstance(belief, MovingHorizonBelief):
            raise InputError("belief", brief(repr(belief)), "one of `start`, `predict` or `update`")
        if any(len(window.course) != len(window.outputs) + ahead for window in belief.windows):
            after = "`start` or `predict`" if ahead else "`update`"
            cure = "Update with NaN where nothing was measured."
            raise InputError("belief", "one out of turn", f"one after {after}", cure)
        return as_array("u", u, (len(belief.windows), self.inputs))

    def _updated(self, window: Window, led: WindowStatus, y: Array, u: Array) -> tuple[Window, WindowStatus]:
        """Window with one more sample, and its status."""
        longer = replace(window, outputs=np.vstack([window.outputs, y]), inputs=np.vstack([window.inputs, u]))
        if len(longer.outputs) > self.window:
            longer = longer.shortened(self.model)
        count = len(longer.outputs)
        if count not in self._programs:
            self._programs[count] = WindowProgram(self.model, count)
        course, good = self._programs[count].solved(longer, self.tolerance)
        longer = replace(longer, course=course) if good else longer
        z, P = longer.filtered(self.model)
        status = led if led is WindowStatus.HELD or good else WindowStatus.FILTERED
        course = longer.course if good else np.vstack([longer.course[:-1], z])
        others = longer.without_the_last()
        told = [self.model.told(at, u, y) for at in (course[-1], *(one.course[-1] for one in others))]
        if np.isfinite(course[-1]).all() and np.isfinite(P).all() and told[0] >= max(told):
            return replace(longer, course=course, last=P), status
        return others[int(np.argmax(told[1:]))], WindowStatus.HELD

    def _belief(self, runs: list[tuple[Window, WindowStatus]]) -> MovingHorizonBelief:
        """Belief of runs: window and status of each."""
        nx = self.states
        windows, status = zip(*runs)
        z, P = (np.stack(part) for part in zip(*((window.course[-1], window.last) for window in windows)))
        return MovingHorizonBelief(z[:, :nx], P[:, :nx, :nx], z[:, nx:], status, windows)
