"""Controller that acts on the last outputs and inputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.signals import Around, needs_of
from ccdtools.exceptions import InputError
from ccdtools_ground.door import as_count, as_floats


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
        known = np.isfinite(seen).all(axis=1, keepdims=True)
        u = np.where(known, np.asarray(self.controller(np.where(known, seen, 0.0)), dtype=float), np.nan)
        return u[0] if np.ndim(y) < 2 else u


def histories(y: Array, u: Array, length: int) -> Array:
    """Histories (n, T, m (ny + nu)) along records y (n, T, ny) and u (n, T, nu), as `History` sees them."""
    n, steps = y.shape[:2]
    last = np.concatenate([np.zeros((n, 1, u.shape[2])), u[:, :-1]], axis=1)
    parts = []
    for record in (y, last):
        padded = np.concatenate([np.zeros((n, length - 1, record.shape[2])), record], axis=1)
        window = np.arange(length)[::-1] + np.arange(steps)[:, None]
        parts.append(padded[:, window].reshape(n, steps, -1))
    return np.concatenate(parts, axis=2)
