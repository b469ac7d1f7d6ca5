"""Cubature Kalman filter, whose slopes are those over its own belief."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array, ArrayField, frozen
from ccdtools.estimation.belief import Belief, Filter, as_covariance, as_noise_covariances, as_start, settled_plant
from ccdtools.estimation.measurement import as_measurement
from ccdtools.estimation.outputs import Output
from ccdtools.estimation.regression import Regressed, points, regressed, regressed_step, regression, root
from ccdtools.estimation.steady_state import Detectability, detectability
from ccdtools.exceptions import InputError
from ccdtools.plants.casadi_arrays import Vectorised, function_of
from ccdtools.plants.linear_model import LinearModel
from ccdtools.plants.plant import Plant
from ccdtools.plants.sampled_model import SampledModel
from ccdtools_ground.door import as_instance, as_vector, shown

KNOWN = ("W", "V", "P0", "x0", "c")  # what a file holds beside the expressions


@dataclass(frozen=True, eq=False, repr=False)
class CubatureKalmanFilter(Filter):
    """Kalman filter of x⁺ = f(x, u, p) + c + w, y_k = h(x_k, u_{k-1}, p) + v_k, by cubature points of its belief.

    In current form: x̂_{k|k} has y_k in it. Slopes are those of least squares over the belief, and what they miss counts
    as noise; of what is linear they are exact, so that it is the time-varying `KalmanFilter` there. It is no optimal
    filter, and may diverge where the first estimate is far off.

    Parameters
    ----------
    model : Plant, SampledModel or LinearModel
        f, at w = 0 or with its `disturbance`.
    output : (ny, nx) array_like, Plant, callable, or Measurement
        h, as in `Measurement`; the model's own outputs where it is nothing. Its noise plays no part.
    W, V : (nx, nx) and (ny, ny) array_like
        Covariances of the process noise of a sample and of the measurement noise, or their diagonals.
    P0 : (nx, nx) or (nx,) array_like
        Covariance of the first state about `x0`.
    x0 : (nx,) array_like, optional
        Estimate before the first measurement; 0 by default.
    c : (nx,) array_like, optional
        Mean of the process noise of a sample; 0 by default.
    disturbance : ((nw,), (nw, nw)) array_like, optional
        Mean and covariance of the model's own w, held over a sample, which cubature points carry through f; 0 by
        default.
    design : (np,) array_like
        p, where the model has design parameters.

    Attributes
    ----------
    detectability : Detectability
        What the outputs see of the modes that do not decay at `x0` and, by chance, about it: SEEN, SEEN_AWAY, DRIFTING
        or UNKNOWN, with `advice`. It is a hint, not a proof: a linearisation says little of a plant far away.

    Raises
    ------
    InputError
        If `model` is of another kind, sizes disagree, a covariance is indefinite or missing, or no design is given.
    NotDetectableError
        If nowhere about `x0` the outputs depend on the state, or see a mode that grows.

    References
    ----------
    Arasaratnam and Haykin, "Cubature Kalman filters", IEEE Transactions on Automatic Control 54, 2009; Bucy, Joseph
    (1968) for the update of covariances.

    Examples
    --------
    >>> estimator = CubatureKalmanFilter(plant, [[1.0, 0.0]], W=[1e-6, 1e-4], V=[1e-4], P0=[0.1, 1.0], design=p)
    >>> controller = Observed(policy, estimator)
    """

    model: Any
    output: Any = None
    W: ArrayField = field(kw_only=True)
    V: ArrayField = field(kw_only=True)
    P0: ArrayField = field(kw_only=True)
    x0: ArrayField = field(default=None, kw_only=True)
    c: ArrayField = field(default=None, kw_only=True)
    disturbance: Any = field(default=None, kw_only=True)
    design: ArrayField = field(default=None, kw_only=True)
    detectability: Detectability = field(init=False)

    def __post_init__(self) -> None:
        as_instance("model", self.model, (Plant, SampledModel, LinearModel), "a Plant, a SampledModel or a LinearModel")
        own = self.model if isinstance(self.model, Plant) else getattr(self.model, "plant", None)
        if self.output is None and own is None:
            cure = "A LinearModel has no outputs of its own."
            raise InputError("output", "nothing", "what is measured, such as a matrix C (ny, nx)", cure)
        self._set(output=as_measurement(own if self.output is None else self.output))
        self._set(design=self._checked_design())
        x0, P0 = as_start(self.x0, self.P0, self.model.nx)
        self._set(x0=x0, P0=P0)
        c = np.zeros(self.nx) if self.c is None else as_vector("c", self.c, self.nx, of="one per state")
        self._set(c=c)
        nw = self.model.nw
        told = (np.zeros(nw), np.zeros(nw)) if self.disturbance is None else self.disturbance
        if not isinstance(told, Sequence) or len(told) != 2:
            raise InputError("disturbance", shown(told), f"a mean ({nw},) and a covariance ({nw}, {nw})")
        mean, S = told
        of = "one per disturbance of the model"
        self._set(disturbance=(as_vector("disturbance", mean, nw, of=of), as_covariance("disturbance", S, nw)))
        ny = self._h.of(x0[None], np.zeros((1, self.nu))).shape[1]
        W, V = as_noise_covariances(self.W, self.V, self.nx, ny)
        self._set(W=W, V=V)
        self._set(detectability=detectability(self._slopes, self.x0, self.P0))

    def _slopes(self, x: Array) -> tuple[Array, Array]:
        """Slopes ∂x⁺/∂x (n, nx, nx) and ∂h/∂x (n, ny, nx) without input."""
        u, spread = np.zeros((len(x), self.nu)), np.sqrt(np.maximum(np.diag(self.P0), 0.0))
        at, _, held = self._symbols
        slope = ca.jacobian(self._step(at, held, ca.DM(self.disturbance[0])), at)
        F = ca.Function("F", [at, held], [ca.densify(slope)])(x.T, u.T)
        H = self._h.slope(x, u, np.tile(np.where(spread > 0, spread, 1.0), (len(x), 1)))
        every = np.asarray(F, dtype=float).reshape(self.nx, len(x), self.nx).swapaxes(0, 1)
        return every, np.broadcast_to(H, (len(x), *H.shape[-2:]))

    def _checked_design(self) -> Array:
        """Design (np,), empty where the model has none."""
        space = self.model.design
        if space is None or space.dim == 0:
            if self.design is not None and np.size(self.design) > 0:
                raise InputError("design", "values", "nothing, because the model has no design parameters")
            return np.zeros(0)
        if self.design is None:
            raise InputError("design", "nothing", f"values for {', '.join(space.names)}")
        return np.asarray(space.check_one(self.design))

    def __repr__(self) -> str:
        said = "" if self.detectability is Detectability.SEEN else f", {self.detectability.value}"
        return f"CubatureKalmanFilter({self.nx} states, {self.nu} inputs, {self.ny} outputs, {self.model!r}{said})"

    def expressed(self) -> Plant:
        """Plant of predicted states, without c, and outputs at the design.

        Raises
        ------
        InputError
            If the output is a function in Python, or the step is implicit: neither is an expression.
        """
        model, stated = self.model, self.output.output
        plant = getattr(model, "plant", model)
        implicit = isinstance(model, SampledModel) and plant.continuous and model.method != "rk4"
        if implicit or not isinstance(stated, Plant | np.ndarray):
            got = "an implicit step" if implicit else "outputs by a function in Python"
            cure = "Such a filter stays in Python: save the policy, and put the filter around it again."
            raise InputError("estimator", got, "expressions: explicit steps, and a Plant or a matrix as outputs", cure)
        x, u, p = ca.SX.sym("x", self.nx), ca.SX.sym("u", self.nu), ca.DM(self.design)
        w = ca.SX.sym("w", model.nw)
        timing = {"dt": model.dt, "continuous": False, "outputs": self._seen(x, u)}
        if isinstance(model, LinearModel):
            return settled_plant(x, u, w, self._step(x, u, w), **timing)
        timing |= {"continuous": plant.continuous, "substeps": model.substeps}
        return settled_plant(x, u, w, plant.right_hand_side(x, u, w, p), **timing)

    def _seen(self, x: Any, u: Any) -> Any:
        """Outputs as expressions at the design."""
        stated = self.output.output
        return stated.output(x, u, self.design) if isinstance(stated, Plant) else ca.DM(stated) @ x

    @cached_property
    def _step(self) -> Callable[[Any, Any, Any], Any]:
        """Step (x, u, w) → x⁺ of expressions at the design."""
        model = self.model
        if isinstance(model, LinearModel):
            A, B, E = map(ca.DM, model.matrices(self.design))
            constant = ca.DM(model.constant(self.design))
            return lambda x, u, w: A @ x + B @ u + E @ w + constant
        whole = model.step
        with contextlib.suppress(RuntimeError):  # an implicit step has no scalar instructions, which are faster
            whole = whole.expand()
        return lambda x, u, w: whole(x, u, w, self.design)

    def to_dict(self) -> dict[str, Any]:
        """Filter as plain values for `from_dict`; raises as `expressed`."""
        plant = self.expressed()
        both = ca.Function("both", [plant.x, plant.u, plant.w], [plant.dynamics, plant.outputs])
        timing = {"dt": plant.dt, "continuous": plant.continuous, "substeps": plant.substeps}
        known = {name: getattr(self, name).tolist() for name in KNOWN}
        known["disturbance"] = [part.tolist() for part in self.disturbance]
        return known | {"expressions": Vectorised(both).to_dict(), "timing": timing}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> CubatureKalmanFilter:
        """Filter of what `to_dict` gives.

        Raises
        ------
        KeyError, IndexError, TypeError, ValueError
            If they are others.
        """
        known = {name: values[name] for name in (*KNOWN, "disturbance")}
        x, u, w = (ca.SX.sym(name, size) for name, size in zip("xuw", values["expressions"]["arguments"], strict=True))
        after, y = function_of(values["expressions"])(x, u, w)
        return cls(settled_plant(x, u, w, after, outputs=y, **values["timing"]), **known)

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return int(self.model.nu)

    @cached_property
    def _symbols(self) -> tuple[Any, Any, Any]:
        """x, P and u."""
        return ca.MX.sym("x", self.nx), ca.MX.sym("P", self.nx, self.nx), ca.MX.sym("u", self.nu)

    @cached_property
    def _f(self) -> ca.Function:
        """Function (x, P, u) → x⁺ over a belief, its slope and what that misses."""
        x, P, u = self._symbols
        mean, S = map(ca.DM, self.disturbance)
        return _function(self._symbols, regressed_step(lambda x, w: self._step(x, u, w), x, P, (mean, S)))

    @cached_property
    def _h(self) -> Output:
        """Outputs, checked."""
        output: Output = self.output.at(self.nx, self.nu, self.design)
        return output

    @cached_property
    def _over_outputs(self) -> ca.Function | None:
        """Function (x, P, u) → outputs over a belief, slope and what that misses; None if they are in Python."""
        if not isinstance(self.output.output, Plant | np.ndarray):
            return None
        x, P, u = self._symbols
        return _function(self._symbols, regression(lambda x: self._seen(x, u), x, P))

    def _transition(self, belief: Belief, u: Array) -> Regressed:
        after, F, missed = _rows(self._f(belief.mean.T, _columns(belief), u.T), len(u))
        return after + self.c, F, missed

    def _expected(self, belief: Belief, u: Array) -> Regressed:
        if self._over_outputs is not None:
            return _rows(self._over_outputs(belief.mean.T, _columns(belief), u.T), len(u))
        L = root(self.nx)(_columns(belief))
        at = np.asarray(points(self.nx)(belief.mean.T, L))
        values = self._h.of(at.T, np.repeat(u, 2 * self.nx, axis=0))
        return _rows(regressed(values.shape[1], self.nx)(values.T, L), len(u))


def _function(symbols: tuple[Any, Any, Any], parts: Regressed) -> ca.Function:
    """Function (x, P, u) → parts of a regression."""
    function = ca.Function("over", list(symbols), [ca.densify(part) for part in parts])
    with contextlib.suppress(RuntimeError):  # an implicit step has no scalar instructions, which are faster
        given: list[Any] = function.sx_in()
        return ca.Function("over", given, list(function.expand()(*given)), {"cse": True})
    return function


def _columns(belief: Belief) -> Array:
    """Covariances (nx, n nx) of all runs beside each other."""
    return belief.covariance.swapaxes(0, 1).reshape(belief.mean.shape[1], -1)


def _rows(parts: Any, n: int) -> Regressed:
    """Regressions beside each other as arrays (n, m), (n, m, nx) and (n, m, m)."""
    mean, slope, missed = (np.asarray(part, dtype=float).reshape(part.shape[0], n, -1).swapaxes(0, 1) for part in parts)
    return frozen(mean[:, :, 0]), slope, missed
