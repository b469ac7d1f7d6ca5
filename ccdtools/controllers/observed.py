"""Controller that acts on an estimated state."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.learned import LearnedPolicy, saved_with
from ccdtools.controllers.policy_code import PolicyCode
from ccdtools.controllers.signals import Around, needs_in_loop, needs_of, opened
from ccdtools.estimation.belief import Belief, Filter
from ccdtools.exceptions import InputError
from ccdtools_ground.door import as_count, as_floats, as_instance, has_method

SIGNAL_OF = {"y": "output", "u_prev": "last_input"}
EXPECTED = "an estimator, such as a KalmanFilter or a CubatureKalmanFilter"


@dataclass(frozen=True, eq=False, repr=False)
class Observed(Around):
    """Controller u = κ(x̂_{k|k}) on an estimate from outputs and applied inputs.

    It needs "output" and "last_input", and asks for what the controller asks for besides (reference, preview, time);
    memory and design of the controller are its own. The state that a closed loop hands over is not looked at. Every run
    starts with the estimator's own first estimate; `reset` forgets, copies start afresh, and neither the controller nor
    the estimator is changed. One run may be controlled with vectors y (ny,) and u_prev (nu,), too.

    ``Observed(Filtered(controller, admissible), estimator)`` filters inputs by the estimate, as a real loop must;
    ``Filtered(Observed(controller, estimator), admissible)`` by the state itself. Only the latter keeps the state in
    the set of the filter; the former, the estimate, but for what the next measurement corrects.

    Parameters
    ----------
    controller : callable
        u = controller(x), batched; see `ccdtools.controllers.controllers`.
    estimator : KalmanFilter, CubatureKalmanFilter, or anything with their nu, ny, start, predict and update
        Of the same states, without memory: beliefs in, next beliefs out.

    Raises
    ------
    InputError
        If one is of another kind; in a loop, if outputs are missing or more or fewer than the estimator's.

    Examples
    --------
    >>> lqg = Observed(LinearFeedback(K), KalmanFilter(A, B, C, W, V))
    >>> run = simulate(plant, lqg, x0=x0, steps=100, output=Measurement(C, noise=[0.01]), rng=rng)
    """

    passed_on: ClassVar[tuple[str, ...]] = ("horizon", "design", "agent")
    controller: Controller
    estimator: Any

    def __post_init__(self) -> None:
        needs_of(self.controller)
        for method in ("start", "predict", "update"):
            has_method("estimator", self.estimator, method, EXPECTED)

    def __repr__(self) -> str:
        return f"Observed({self.controller!r}, {self.estimator!r})"

    @property
    def needs(self) -> frozenset[str]:
        """Names of the signals needed besides the state."""
        return needs_in_loop(self.controller) | {"output", "last_input"}

    @property
    def estimate(self) -> Array | None:
        """Last estimate x̂_{k|k} (n, nx), None before the first; simulations use a copy."""
        belief = self._memory.get("belief")
        return None if belief is None else belief.mean

    def uncounted(self) -> Observed:
        """Copy whose filter, if any, counts on its own."""
        apart = getattr(self.controller, "uncounted", None)
        return Observed(self.controller if apart is None else apart(), self.estimator)

    def reset(self, n: int) -> None:
        """Start afresh with `n` runs."""
        runs = as_count("n", n)
        self._memory.update(runs=runs, opened=opened(self.controller, runs), belief=None)

    def __call__(
        self, x: ArrayLike | None = None, *, y: ArrayLike | None = None, u_prev: ArrayLike | None = None, **signals: Any
    ) -> Array:
        """Inputs (n, nu) or (nu,), NaN where the estimate is, advancing the memory."""
        nu = int(self.estimator.nu)
        outputs = self._rows("y", y, int(self.estimator.ny), "Pass output=Measurement(…) to the simulation.")
        last = self._rows("u_prev", u_prev, nu, "It is 0 before the first.")
        single = np.ndim(y) < 2  # type: ignore[arg-type]
        if last.shape[0] != outputs.shape[0]:
            raise InputError("u_prev", f"{len(last)} rows", f"{len(outputs)}, as many as outputs")
        memory = self._memory
        if memory.get("runs") != len(outputs):
            self.reset(len(outputs))
        before: Belief | None = memory["belief"]
        with np.errstate(all="ignore"):  # of a run that is lost
            start = self.estimator.start(len(outputs)) if before is None else self.estimator.predict(before, last)
            belief = memory["belief"] = self.estimator.update(start, outputs, last)
        known = np.isfinite(belief.mean).all(axis=1, keepdims=True)
        states = np.where(known, belief.mean, 0.0)
        u = np.where(known, self._inputs(states, outputs, last, signals), np.nan)
        return u[0] if single else u

    def to_c(self, folder: str | Path, *, name: str = "policy", scalar: str = "double") -> PolicyCode:
        """Write a learned policy and its filter in C99, and report the costs of the policy.

        As `History.to_c`; x of `name_law` is the estimate. An output that is not finite leaves none until a reset. Of
        a `CubatureKalmanFilter`, the code may call functions of math.h. Its variances in "float" are none where a state
        is known ten thousand times less well at the start than a sensor shows it: take "double" there.

        Raises
        ------
        InputError
            As `LearnedPolicy.to_c`; or if the controller is no `LearnedPolicy`, the estimator neither a `KalmanFilter`
            nor a `CubatureKalmanFilter`, or that has an implicit step or outputs by a function in Python.
        """
        policy, known = self._parts()
        return policy.to_c(folder, name=name, scalar=scalar, estimator=known)

    def to_casadi(self) -> ca.Function:
        """Mean action of a learned policy as `LearnedPolicy.to_casadi` has it: estimates (nx,) to u (nu,)."""
        return self._learned.to_casadi()

    def to_onnx(self, path: str | Path) -> Path:
        """Write a learned policy as an ONNX model: estimates (n, nx) to u (n, nu).

        `Observed(OnnxPolicy(path), estimator)` is the controller again. It raises what `LearnedPolicy.to_onnx` raises,
        and an `InputError` if the controller is no `LearnedPolicy`.
        """
        return self._learned.to_onnx(path)

    def save(self, path: str | Path, **notes: str) -> None:
        """Save a learned policy, its filter and notes for `load_policy`; raises as `to_c`."""
        policy, known = self._parts()
        saved_with(policy, path, notes, {"filter": known.to_dict()})

    @property
    def _learned(self) -> LearnedPolicy:
        """Policy inside."""
        policy: LearnedPolicy = as_instance("controller", self.controller, LearnedPolicy, "a LearnedPolicy")
        return policy

    def _parts(self) -> tuple[LearnedPolicy, Filter]:
        """Policy and filter that leave Python."""
        policy = self._learned
        cure = "The model of another filter stays in Python: save the policy, and put the filter around it again."
        known = as_instance("estimator", self.estimator, Filter, "a KalmanFilter or a CubatureKalmanFilter", cure)
        if policy.nx != known.nx or policy.nu != known.nu:
            got = f"{known.nx} states and {known.nu} inputs"
            raise InputError("estimator", got, f"{policy.nx} and {policy.nu}, of the policy")
        return policy, known

    def _inputs(self, states: Array, y: Array, last: Array, signals: dict[str, Any]) -> Array:
        """Inputs (n, nu) at the estimates (n, nx) of all runs."""
        needs, controllers, batched = self._memory["opened"]
        given = {name: value for name, value in (("y", y), ("u_prev", last)) if SIGNAL_OF[name] in needs}
        if batched:
            u = controllers[0](states, **signals, **given)
        else:
            u = [controller(state, **signals, **{name: value[i] for name, value in given.items()})
                 for i, (controller, state) in enumerate(zip(controllers, states))]  # fmt: skip
        u = np.asarray(u, dtype=float)
        if u.shape != last.shape:
            raise InputError("controller", f"inputs of shape {u.shape}", f"{last.shape}")
        return u

    def _rows(self, name: str, value: ArrayLike | None, size: int, cure: str) -> Array:
        """Signal as rows (n, size), also of one run (size,)."""
        if value is None:
            raise InputError(name, "nothing", f"({size},) or (n, {size})", cure)
        rows = np.atleast_2d(as_floats(name, value))
        if rows.ndim != 2 or rows.shape[1] != size:
            raise InputError(name, f"shape {np.shape(value)}", f"({size},) or (n, {size}) of the estimator", cure)
        return rows
