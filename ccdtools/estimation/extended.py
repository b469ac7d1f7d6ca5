"""Extended Kalman filter, linearised about its own estimate."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array, ArrayField, frozen
from ccdtools.estimation.belief import Belief, Filter, as_noise_covariances, as_start, undisturbed_plant
from ccdtools.estimation.measurement import as_measurement
from ccdtools.estimation.outputs import Output
from ccdtools.estimation.steady_state import Detectability, detectability
from ccdtools.exceptions import InputError
from ccdtools.plants.casadi_arrays import Vectorised, function_of
from ccdtools.plants.linear_model import LinearModel
from ccdtools.plants.plant import Plant
from ccdtools.plants.sampled_model import SampledModel
from ccdtools_ground.door import as_instance, as_vector

KNOWN = ("W", "V", "P0", "x0", "c")  # what a file holds beside the expressions
Transition = Callable[[Array, Array], tuple[Array, Array]]


@dataclass(frozen=True, eq=False, repr=False)
class ExtendedKalmanFilter(Filter):
    """Kalman filter of x⁺ = f(x, u, p) + c + w, y_k = h(x_k, u_{k-1}, p) + v_k, linearised about its estimate.

    In current form: x̂_{k|k} has y_k in it. f is differentiated exactly; so are the outputs of a plant, while those of
    a function are by central differences in parts of the estimate's standard deviation. On a linear model it is the
    time-varying `KalmanFilter`. It is no optimal filter, and may diverge where the first estimate is far off.

    Parameters
    ----------
    model : Plant, SampledModel or LinearModel
        f at w = 0.
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
    Anderson, Moore (1979), Optimal filtering, section 8.2; Bucy, Joseph (1968) for the update of covariances.

    Examples
    --------
    >>> estimator = ExtendedKalmanFilter(plant, [[1.0, 0.0]], W=[1e-6, 1e-4], V=[1e-4], P0=[0.1, 1.0], design=p)
    >>> controller = Observed(policy, estimator)
    """

    model: Any
    output: Any = None
    W: ArrayField = field(kw_only=True)
    V: ArrayField = field(kw_only=True)
    P0: ArrayField = field(kw_only=True)
    x0: ArrayField = field(default=None, kw_only=True)
    c: ArrayField = field(default=None, kw_only=True)
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
        ny = self._h.of(x0[None], np.zeros((1, self.nu))).shape[1]
        W, V = as_noise_covariances(self.W, self.V, self.nx, ny)
        self._set(W=W, V=V)
        self._set(detectability=detectability(self._slopes, self.x0, self.P0))

    def _slopes(self, x: Array) -> tuple[Array, Array]:
        """Slopes ∂x⁺/∂x (n, nx, nx) and ∂h/∂x (n, ny, nx) without input."""
        u = np.zeros((len(x), self.nu))
        spread = np.tile(np.sqrt(np.maximum(np.diag(self.P0), 0.0)), (len(x), 1))
        F, H = self._f(x, u)[1], self._h.slope(x, u, np.where(spread > 0, spread, 1.0))
        return tuple(np.broadcast_to(part, (len(x), *part.shape[-2:])) for part in (F, H))  # type: ignore[return-value]

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
        return f"ExtendedKalmanFilter({self.nx} states, {self.nu} inputs, {self.ny} outputs, {self.model!r}{said})"

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
        y = stated.output(x, u, p) if isinstance(stated, Plant) else ca.DM(stated) @ x
        timing = {"dt": model.dt, "continuous": False, "outputs": y}
        if isinstance(model, LinearModel):
            A, B, _ = model.matrices(self.design)
            after = ca.DM(A) @ x + ca.DM(B) @ u + ca.DM(model.constant(self.design))
            return undisturbed_plant(x, u, after, **timing)
        rates = plant.right_hand_side(x, u, ca.DM.zeros(plant.nw), p)
        timing |= {"continuous": plant.continuous, "substeps": model.substeps}
        return undisturbed_plant(x, u, rates, **timing)

    def to_dict(self) -> dict[str, Any]:
        """Filter as plain values for `from_dict`; raises as `expressed`."""
        plant = self.expressed()
        both = ca.Function("both", [plant.x, plant.u], [plant.dynamics, plant.outputs])
        timing = {"dt": plant.dt, "continuous": plant.continuous, "substeps": plant.substeps}
        known = {name: getattr(self, name).tolist() for name in KNOWN}
        return known | {"expressions": Vectorised(both).to_dict(), "timing": timing}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> ExtendedKalmanFilter:
        """Filter of what `to_dict` gives.

        Raises
        ------
        KeyError, IndexError, TypeError, ValueError
            If they are others.
        """
        known = {name: values[name] for name in KNOWN}
        x, u = (ca.SX.sym(name, size) for name, size in zip("xu", values["expressions"]["arguments"], strict=True))
        after, y = function_of(values["expressions"])(x, u)
        return cls(undisturbed_plant(x, u, after, outputs=y, **values["timing"]), **known)

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return int(self.model.nu)

    @cached_property
    def _h(self) -> Output:
        output: Output = self.output.at(int(self.model.nx), self.nu, self.design)
        return output

    @cached_property
    def _f(self) -> Transition:
        """Function (x, u) → x⁺ (n, nx), ∂x⁺/∂x (nx, nx) or (n, nx, nx)."""
        if isinstance(self.model, LinearModel):
            A, B, _ = self.model.matrices(self.design)
            c = self.model.constant(self.design)
            return lambda x, u: (x @ A.T + u @ B.T + c, A)
        return _differentiated(self.model, self.design)

    def _transition(self, belief: Belief, u: Array) -> Any:
        after, F = self._f(belief.mean, u)
        return after + self.c, F, 0.0

    def _expected(self, belief: Belief, u: Array) -> Any:
        variances = np.diagonal(belief.covariance, axis1=-2, axis2=-1)
        slope = self._h.slope(belief.mean, u, np.sqrt(np.maximum(variances, 0.0)))
        return self._h.of(belief.mean, u), slope, 0.0


def _differentiated(model: Plant | SampledModel, p: Array) -> Transition:
    """Function (x, u) → x⁺ (n, nx), ∂x⁺/∂x (n, nx, nx) at w = 0."""
    nx = model.nx
    x, u, design = (ca.MX.sym(name, size) for name, size in zip("xup", (nx, model.nu, model.design.dim)))
    after = model.step(x, u, ca.DM.zeros(model.nw, 1), design)
    both = ca.vertcat(after, ca.vec(ca.jacobian(after, x)))
    function = ca.Function("transition", [x, u, design], [ca.densify(both)])
    with contextlib.suppress(RuntimeError):  # an implicit step has no scalar instructions, which are faster
        function = function.expand()

    def transition(states: Array, inputs: Array) -> tuple[Array, Array]:
        """Next states (n, nx) and slopes ∂x⁺/∂x (n, nx, nx)."""
        columns = np.asarray(function(states.T, inputs.T, p), dtype=float).T
        F = columns[:, nx:].reshape(-1, nx, nx).swapaxes(1, 2)
        return frozen(columns[:, :nx]), F

    return transition
