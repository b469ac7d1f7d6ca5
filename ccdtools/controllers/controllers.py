"""Controllers: anything with ``u = controller(x)``, batched.

A controller is called with states (n, nx) and returns inputs (n, nu); with one state (nx,) it returns (nu,). One that
needs more than the state says so in an attribute ``needs``, a set of the words below, and is then called with the
keyword arguments that belong to them:

============== ======================== ============================================================================
word           arguments                what they hold
============== ======================== ============================================================================
"time"         ``time=k``               index of the sample, an int
"reference"    ``x_ref=``, ``u_ref=``   reference (nx,) and (nu,); with an attribute ``horizon`` N, (N + 1, nx), (N, nu)
"preview"      ``w=``                   disturbances known ahead, (N, nw), held beyond the end of the record
"last_input"   ``u_prev=``              input applied one sample ago, zero at first, (nu,)
"output"       ``y=``                   measured output (ny,), with its noise; the state where none is given
============== ======================== ============================================================================

`u_prev` and `y` have one row per run when the controller is called with a batch. A controller that needs a preview is
called run by run, because each run meets a disturbance of its own; its horizon is at most the whole record. Beside `y`
the state itself is handed over, too; `Observed` hands on an estimate in its place.

A controller with memory has ``reset``. `simulate` never changes the one it is given: it copies it, once for all runs
if ``reset(n)`` takes their number, else once per run, and resets the copies. One without memory that learns in a closed
loop, such as `mpc.OffsetFreeMPC`, has ``loop(n)`` instead, which makes such a controller for n runs.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, ArrayField, Immutable, frozen
from ccdtools.exceptions import InputError
from ccdtools_ground.door import as_array, as_count, as_finite, as_floats, as_positive, as_vector

SIGNALS = ("time", "reference", "preview", "last_input", "output")


class Controller(Protocol):
    """Map of states (n, nx) or (nx,) to inputs (n, nu) or (nu,), see the module."""

    def __call__(self, x: Array) -> Array:
        """Inputs of the states."""
        ...


NO_GAINS = "no gains were found that are better than none: this is the passive plant, not a PID to compare with"


@dataclass(frozen=True, eq=False)
class Passive:
    """Controller u = 0: what the plant does alone, with a remark where it stands for another."""

    nu: int = 1
    remark: str = field(default="", kw_only=True, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "nu", as_count("nu", self.nu))

    def __call__(self, x: ArrayLike) -> Array:
        """Zeros (n, nu) or (nu,)."""
        return np.zeros((*np.shape(x)[:-1], self.nu))


@dataclass(frozen=True, eq=False)
class LinearFeedback(Immutable):
    """Saturated static gain u = clip(offset − K x, lower, upper), such as LQR.

    Parameters
    ----------
    K : (nu, nx) array_like
    lower, upper : (nu,) array_like
        Input bounds, in the units of u; none by default.
    offset : (nu,) array_like
        Input at x = 0, 0 by default.
    """

    K: ArrayField
    lower: ArrayField = field(default_factory=lambda: np.array(-np.inf))
    upper: ArrayField = field(default_factory=lambda: np.array(np.inf))
    offset: ArrayField = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        K = np.atleast_2d(as_floats("K", self.K))
        if K.ndim != 2 or K.size == 0:
            raise InputError("K", f"shape {K.shape}", "a gain (nu, nx)")
        self._set(K=as_finite("K", K))
        offset = as_array("offset", self.offset, (), (len(K),))
        self._set(offset=np.broadcast_to(as_finite("offset", offset), (len(K),)).copy())
        _set_bounds(self, len(K))

    def __call__(self, x: ArrayLike) -> Array:
        """Saturated inputs (n, nu) or (nu,)."""
        u: Array = np.clip(self.offset - as_states(x, self.K.shape[1]) @ self.K.T, self.lower, self.upper)
        return u


@dataclass(frozen=True, eq=False)
class PID(Immutable):
    """PID on outputs y = C x, with clamping anti-windup.

    u = clip(−(kp y + ki ∫y dt + kd dy/dt)), fixed gains. `reset` clears integral and last output; copies start afresh.

    Parameters
    ----------
    C : (ny, nx) array_like
        Measured outputs, one per input.
    kp, ki, kd : (ny,) array_like
    dt : float
        Sampling time [s].
    lower, upper : (ny,) array_like
        Input bounds.
    remark : str
        What a table says of it: that it acts on nothing, where all gains are zero.
    """

    C: ArrayField
    kp: ArrayField
    ki: ArrayField
    kd: ArrayField
    dt: float = field(kw_only=True)
    lower: ArrayField = field(kw_only=True)
    upper: ArrayField = field(kw_only=True)
    remark: str = field(default="", kw_only=True, repr=False)

    def __post_init__(self) -> None:
        self._set(C=as_array("C", np.atleast_2d(as_floats("C", self.C)), ("ny", "nx")))
        for name in ("kp", "ki", "kd"):
            self._set(**{name: as_vector(name, getattr(self, name), len(self.C), of="one per output")})
        self._set(dt=as_positive("dt", self.dt, unit="s"))
        _set_bounds(self, len(self.C))
        if not np.any([self.kp, self.ki, self.kd]):
            self._set(remark=NO_GAINS)

    @cached_property
    def _memory(self) -> dict[str, Any]:
        """Values kept from sample to sample; copies begin without any."""
        return {}

    def reset(self, n: int) -> None:
        """Forget the past of `n` runs."""
        self._memory.update(integral=np.zeros((as_count("n", n), len(self.C))), last=None)

    def __call__(self, x: ArrayLike) -> Array:
        """Inputs (n, nu) or (nu,), advancing the memory one sample."""
        states = as_states(x, self.C.shape[1])
        if states.ndim > 2:
            raise InputError("x", f"shape {states.shape}", f"({self.C.shape[1]},) or (n, {self.C.shape[1]})")
        y = np.atleast_2d(states) @ self.C.T
        memory = self._memory
        if "integral" not in memory or len(memory["integral"]) != len(y):
            memory.update(integral=np.zeros(y.shape), last=None)
        rate = np.zeros_like(y) if memory["last"] is None else (y - memory["last"]) / self.dt
        integral = memory["integral"] + self.dt * y
        wanted = -(self.kp * y + self.ki * integral + self.kd * rate)
        u: Array = np.clip(wanted, self.lower, self.upper)
        memory.update(integral=np.where(wanted == u, integral, memory["integral"]), last=y)
        return u if states.ndim == 2 else u[0]


def as_states(x: ArrayLike, nx: int) -> Array:
    """States (..., nx) as a float array; NaN of lost runs passes."""
    states = np.asarray(x, dtype=float) if isinstance(x, np.ndarray) and x.dtype.kind in "iuf" else as_floats("x", x)
    if states.shape[-1:] != (nx,):
        raise InputError("x", f"shape {states.shape}", f"({nx},) or (n, {nx})")
    return states


def _set_bounds(controller: LinearFeedback | PID, size: int) -> None:
    """Check and freeze a controller's bounds, per input or one for all; infinite where there is none."""
    for name in ("lower", "upper"):
        bound = as_floats(name, getattr(controller, name))
        unknown = np.isnan(bound).any()
        if unknown or bound.shape not in ((), (1,), (size,)):
            raise InputError(name, "NaN" if unknown else f"shape {bound.shape}", f"({size},) bounds")
        object.__setattr__(controller, name, frozen(bound))
    lower, upper = controller.lower, controller.upper
    if not (lower <= upper).all():
        raise InputError("lower, upper", f"{lower.tolist()} and {upper.tolist()}", "lower ≤ upper")
