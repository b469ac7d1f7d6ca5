"""Controller that acts on the last outputs and inputs."""

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
from ccdtools.controllers.observed import Observed
from ccdtools.controllers.policy_code import PolicyCode
from ccdtools.controllers.signals import Around, needs_of
from ccdtools.design_limits import DesignLimits
from ccdtools.estimation.cubature import CubatureKalmanFilter
from ccdtools.estimation.kalman import KalmanFilter
from ccdtools.exceptions import InputError
from ccdtools_ground.door import as_count, as_floats, as_instance
from learning import checkpoint
from learning.exceptions import CheckpointError
from learning.networks import ActorCritic


@dataclass(frozen=True, eq=False, repr=False)
class History(Around):
    """Controller u = π(y_k, …, y_{k−m+1}, u_{k−1}, …, u_{k−m}) of a policy on what was measured.

    Outputs and inputs before the first sample are zero. The state that a closed loop hands over is not looked at.
    Every run starts afresh; the policy is not changed. One run may be controlled with vectors y (ny,) and u_prev (nu,),
    too.

    Parameters
    ----------
    controller : callable
        Inputs (n, nu) of histories (n, m (ny + nu)): all outputs, the latest first, then all inputs.
    length : int
        m.

    Raises
    ------
    InputError
        If one is of another kind; in a loop, if outputs are missing.

    Examples
    --------
    >>> policy = imitate(lqg, scenario, limits=(-1, 1), history=8, objective=objective, rng=rng).controller
    """

    passed_on: ClassVar[tuple[str, ...]] = ("design", "agent")
    needs: ClassVar[frozenset[str]] = frozenset({"output", "last_input"})
    controller: Controller
    length: int

    def __post_init__(self) -> None:
        self._set(length=as_count("length", self.length))
        if needs_of(self.controller):
            raise InputError(
                "controller", f"one that needs {', '.join(needs_of(self.controller))}", "u = controller(z)"
            )

    def __repr__(self) -> str:
        return f"History({self.controller!r}, {self.length} samples)"

    def reset(self, n: int) -> None:
        """Start afresh with `n` runs."""
        self._memory.clear()
        self._memory["runs"] = as_count("n", n)

    def __call__(
        self, x: ArrayLike | None = None, *, y: ArrayLike | None = None, u_prev: ArrayLike | None = None
    ) -> Array:
        """Inputs (n, nu) or (nu,), NaN where the history is, advancing the memory."""
        if y is None or u_prev is None:
            raise InputError(
                "y, u_prev", "nothing", "outputs and last inputs", "Pass output=Measurement(…) to simulate."
            )
        outputs, inputs = (np.atleast_2d(as_floats(name, value)) for name, value in (("y", y), ("u_prev", u_prev)))
        memory = self._memory
        if memory.get("runs") != len(outputs):
            self.reset(len(outputs))
        for name, latest, words in (("y", outputs, "y"), ("u", inputs, "u_prev")):
            before = memory.get(name, np.zeros((len(outputs), self.length, latest.shape[-1])))
            if latest.shape != (len(before), before.shape[2]):
                raise InputError(words, f"shape {latest.shape}", f"({len(before)}, {before.shape[2]})")
            memory[name] = np.concatenate([latest[:, None], before[:, :-1]], axis=1)
        seen = np.concatenate([memory[name].reshape(len(outputs), -1) for name in ("y", "u")], axis=1)
        expected: Any = getattr(self.controller, "nx", seen.shape[1])
        if seen.shape[1] != expected:
            got = f"{outputs.shape[1]} outputs beside {inputs.shape[1]} inputs"
            cure = "Pass the output=Measurement(…) that the policy was trained with."
            raise InputError("y", got, f"{expected / self.length:g} together", cure)
        known = np.isfinite(seen).all(axis=1, keepdims=True)
        u = np.where(known, np.asarray(self.controller(np.where(known, seen, 0.0)), dtype=float), np.nan)
        return u[0] if np.ndim(y) < 2 else u

    def to_c(self, folder: str | Path, *, name: str = "policy", scalar: str = "double") -> PolicyCode:
        """Write a learned policy and its memory in C99, and report its costs.

        As `LearnedPolicy.to_c`; x of `name_law` is a history. One `name_state` a loop holds it, `void
        name_reset(name_state *)` begins a run, and in every sample `int name_step(name_state *, const name_real y[],
        const name_real u_prev[], name_real u[])` takes in what was measured, and what was applied before. It returns 2
        as long as the history holds what is not finite.

        Raises
        ------
        InputError
            As there; or if the controller is no `LearnedPolicy`, or not of histories of this length.
        """
        return self._learned.to_c(folder, name=name, scalar=scalar, history=self.length)

    def to_casadi(self) -> ca.Function:
        """Mean action of a learned policy as `LearnedPolicy.to_casadi` has it: histories (m (ny + nu),) to u (nu,)."""
        return self._learned.to_casadi()

    def to_onnx(self, path: str | Path) -> Path:
        """Write a learned policy as an ONNX model: histories (n, m (ny + nu)) to u (n, nu).

        `History(OnnxPolicy(path), m)` is the controller again. It raises what `LearnedPolicy.to_onnx` and `to_c` raise.
        """
        return self._learned.to_onnx(path)

    def save(self, path: str | Path, **notes: str) -> None:
        """Save a learned policy, its length and notes for `load_policy`; raises as `LearnedPolicy.save`."""
        saved_with(self._learned, path, notes, {"history": self.length})

    @property
    def _learned(self) -> LearnedPolicy:
        """Policy inside, which sees histories of this length."""
        policy: LearnedPolicy = as_instance("controller", self.controller, LearnedPolicy, "a LearnedPolicy")
        if policy.nx % self.length or policy.nx <= self.length * policy.nu:
            got = f"{self.length}, with a policy that sees {policy.nx} numbers and gives {policy.nu} inputs"
            raise InputError("length", got, "m, with one that sees m (ny + nu)")
        return policy


def load_policy(path: str | Path) -> LearnedPolicy | History | Observed:
    """Policy saved in a file, with its memory or filter where it has one.

    Raises
    ------
    InputError
        If `path` is no path.
    CheckpointError
        If the file is not a saved policy.
    """
    as_instance("path", path, (str, Path), "the path of a saved policy")
    agent, extra = checkpoint.load(path, action_limits=DesignLimits.from_dict)
    if not isinstance(agent, ActorCritic) or "design" not in extra:
        raise CheckpointError(path, f"a {type(agent).__name__} without a design", "a saved policy")
    policy = LearnedPolicy(agent, extra["design"])
    if "filter" in extra:
        return Observed(policy, _filter_of(path, extra["filter"]))
    return History(policy, extra["history"]) if "history" in extra else policy


def _filter_of(path: str | Path, known: dict[str, Any]) -> KalmanFilter | CubatureKalmanFilter:
    """Filter of its plain values."""
    try:
        return CubatureKalmanFilter.from_dict(known) if "expressions" in known else KalmanFilter(**known)
    except (KeyError, IndexError, TypeError, ValueError, NotImplementedError) as error:
        raise CheckpointError(path, f"a filter that cannot be read ({error})", "one saved by this version") from None


def histories(y: Array, u: Array, length: int) -> Array:
    """Histories (n, T, m (ny + nu)) along records y (n, T, ny), u (n, T, nu)."""
    n, steps = y.shape[:2]
    last = np.concatenate([np.zeros((n, 1, u.shape[2])), u[:, :-1]], axis=1)
    parts = []
    for record in (y, last):
        padded = np.concatenate([np.zeros((n, length - 1, record.shape[2])), record], axis=1)
        window = np.arange(length)[::-1] + np.arange(steps)[:, None]
        parts.append(padded[:, window].reshape(n, steps, -1))
    return np.concatenate(parts, axis=2)
