"""Signals of a simulation for controllers, beside the state."""

from __future__ import annotations

import copy
import functools
import inspect
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, ArrayField, Immutable
from ccdtools.controllers.controllers import SIGNALS, Controller
from ccdtools.estimation.measurement import Sensor
from ccdtools.exceptions import InputError
from ccdtools_ground.door import as_count, as_finite, as_floats, shown


@dataclass(frozen=True, eq=False)
class Reference(Immutable):
    """Reference that a tracking controller is to follow.

    Parameters
    ----------
    x : (nx,) or (T, nx) array_like
        State reference; a shorter one holds its last row.
    u : (nu,) or (T, nu) array_like, optional
        The input that belongs to it.
    """

    x: ArrayField
    u: ArrayField = None

    def __post_init__(self) -> None:
        for name in ("x", "u"):
            value = getattr(self, name)
            if value is None and name == "u":
                continue
            rows = np.atleast_2d(as_floats(f"reference.{name}", value))
            if rows.ndim != 2 or rows.size == 0:
                raise InputError(f"reference.{name}", f"shape {rows.shape}", "one row, or one row per sample")
            self._set(**{name: as_finite(f"reference.{name}", rows)})

    def check(self, nx: int, nu: int) -> None:
        """Raise an `InputError` unless sizes are `nx` and `nu`."""
        for name, rows, size in (("x", self.x, nx), ("u", self.u, nu)):
            if rows is not None and rows.shape[1] != size:
                raise InputError(f"reference.{name}", f"{rows.shape[1]} columns", str(size))


class Driver:
    """Controller with memory for n runs, called with what it needs.

    Parameters
    ----------
    controller : callable
    runs, nu : int
    disturbances : (n, T, nw) array
    recorded : bool
        Whether these are a record, which a preview ends with.
    reference : Reference, optional
    output : Sensor, optional
        What is measured; the state itself by default.

    Raises
    ------
    InputError
        If the controller cannot be called, needs an unknown signal, a reference that was not given, or a preview that
        is longer than the whole record.
    """

    def __init__(
        self, controller: Controller, runs: int, nu: int, *, disturbances: Array, recorded: bool = True,
        reference: Reference | None = None, output: Sensor | None = None,
    ) -> None:  # fmt: skip
        self.needs, self.copies, self.batched = opened(controller, runs)
        if "reference" in self.needs and reference is None:
            raise InputError("reference", "nothing", "a reference, which the controller needs")
        self.disturbances = disturbances
        self.reference = reference
        self.output = output
        self.horizon = getattr(self.copies[0], "horizon", None)
        self.last = np.zeros((runs, nu))
        self.heard: list[Array] = []  # of the sensors, sample by sample
        length = disturbances.shape[1]
        if "preview" in self.needs and recorded and (self.horizon or 0) > length:
            got = f"{self.horizon} samples, which the controller previews"
            cure = "Take a shorter horizon, or a longer disturbance."
            raise InputError("horizon", got, f"at most {length}, the samples of the disturbance", cure)

    def __call__(self, k: int, x: Array) -> Any:
        """Inputs (n, nu) at sample k for states (n, nx)."""
        if not self.needs and self.batched:
            return self.copies[0](x)
        y = None
        if "output" in self.needs:
            y = x if self.output is None else self.output(k, x, self.last)
            self.heard += [] if self.output is None else [y]
        if self.batched:
            return self.copies[0](x, **self._signals(k, y, slice(None)))
        return np.stack([
            np.asarray(controller(x[i], **self._signals(k, y, i)), dtype=float)
            for i, controller in enumerate(self.copies)
        ])  # fmt: skip

    def remember(self, u: Array) -> None:
        """Keep the inputs (n, nu) that were applied."""
        self.last = u

    def _signals(self, k: int, y: Array | None, run: int | slice) -> dict[str, Any]:
        """Keyword arguments of one call, for one run or all."""
        ahead = self.horizon
        signals = dict[str, Any]()
        if "time" in self.needs:
            signals["time"] = k
        if "reference" in self.needs and self.reference is not None:
            signals["x_ref"] = _window(self.reference.x, k, None if ahead is None else ahead + 1)
            if self.reference.u is not None:
                signals["u_ref"] = _window(self.reference.u, k, ahead)
        if "preview" in self.needs:
            signals["w"] = _window(self.disturbances[run], k, ahead)
        if "last_input" in self.needs:
            signals["u_prev"] = self.last[run]
        if y is not None:
            signals["y"] = y[run]
        return signals


class Around(Immutable):
    """Base of the dataclasses around a `controller`, of which a closed loop may ask for what is `passed_on`."""

    passed_on: ClassVar[tuple[str, ...]]

    def __getattr__(self, name: str) -> Any:
        """Attribute of the inner controller; its loop, with this one around."""
        inner = self.__dict__.get("controller")
        if inner is None or name not in self.passed_on:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        found = getattr(inner, name)
        return found if name != "loop" else lambda n: replace(self, controller=found(n))  # type: ignore[call-arg]

    @functools.cached_property
    def _memory(self) -> dict[str, Any]:
        """Values kept from sample to sample; copies begin without any."""
        return {}


def _predicted(model: Any, deterministic: bool, x: ArrayLike) -> Array:
    """Inputs (n, nu) or (nu,) from ``predict(x)`` → u or ``predict(x, deterministic=True)`` → (u, memory)."""
    rows = np.atleast_2d(np.asarray(x))
    found = model.predict(rows, deterministic=True)[0] if deterministic else model.predict(rows)
    u = np.asarray(found, dtype=float).reshape(len(rows), -1)  # of one input a model may return (n,)
    return u if np.ndim(x) > 1 else u[0]


def as_controller(controller: Any) -> Any:
    """Controller as given, or made from a model with ``predict``.

    Raises
    ------
    InputError
        If it is an agent with spaces of its own, whose units only its environment knows.
    """
    predict = getattr(controller, "predict", None)
    if callable(controller) or not callable(predict):
        return controller
    if hasattr(controller, "observation_space") and not isinstance(controller, type):
        cure = (
            "Of an agent of a DesignEnv that is env.controller(lambda seen: agent.predict(seen, deterministic=True)); "
            "of one in units of the plant, lambda x: agent.predict(x, deterministic=True)[0]."
        )
        got = f"{type(controller).__name__}, an agent in units of its environment"
        raise InputError("controller", got, "a controller in units of the plant", cure)
    signature = inspect.signature(predict)
    try:
        signature.bind(None)
    except TypeError:  # an estimator's, of a belief and an input
        return controller
    return functools.partial(_predicted, controller, "deterministic" in signature.parameters)


def needs_of(controller: Any) -> frozenset[str]:
    """Names of what a controller needs beside the state.

    Raises
    ------
    InputError
        If it cannot be called, or names a signal that does not exist.
    """
    controller = as_controller(controller)
    if isinstance(controller, type) or not callable(controller):
        cure = "A gain K becomes a controller with LinearFeedback(K), for u = −K x."
        cure = cure if isinstance(controller, np.ndarray | list | tuple) else ""
        cure = "Observed(controller, estimator) is one." if hasattr(controller, "predict") else cure
        raise InputError("controller", shown(controller), "a callable u = controller(x)", cure)
    if hasattr(controller, "state_dict") and hasattr(controller, "forward"):
        cure = "Use LearnedPolicy(agent, design), or a function that calls the module."
        raise InputError("controller", f"the torch module {type(controller).__name__}", "one on NumPy arrays", cure)
    _check_takes_state(controller)
    needs: Any = getattr(controller, "needs", frozenset())
    if isinstance(needs, str) or not isinstance(needs, Iterable) or not set(needs) <= set(SIGNALS):
        raise InputError("controller.needs", shown(needs), f"some of {', '.join(SIGNALS)}")
    horizon = getattr(controller, "horizon", None)
    if needs and horizon is not None:
        as_count("controller.horizon", horizon)
    return frozenset(needs)


def _check_takes_state(controller: Any) -> None:
    try:
        signature = inspect.signature(controller)
    except (TypeError, ValueError):  # a callable in C need not have one
        return
    try:
        signature.bind_partial(None)
    except TypeError:
        got = f"a {type(controller).__name__} with the arguments {signature}"
        raise InputError("controller", got, "a callable u = controller(x)") from None


def needs_in_loop(controller: Any) -> frozenset[str]:
    """Signals that a controller, or its ``loop``, needs in a closed loop."""
    return needs_of(_in_loop(controller, 1))


def opened(controller: Any, runs: int) -> tuple[frozenset[str], list[Any], bool]:
    """Needs, controllers to call for all runs, and whether one takes all at once.

    Those with memory are copies, which are reset.
    """
    needs = needs_of(controller)
    in_loop = _in_loop(controller, 1 if "preview" in needs else runs)
    if in_loop is not controller:
        controller, needs = in_loop, needs_of(in_loop)
    return needs, *_copies(controller, runs, one_by_one="preview" in needs)


def _in_loop(controller: Any, runs: int) -> Any:
    """Controller itself, or the one with memory it makes for the runs."""
    return controller.loop(runs) if callable(getattr(controller, "loop", None)) else as_controller(controller)


def _copies(controller: Any, runs: int, *, one_by_one: bool) -> tuple[list[Any], bool]:
    """Controllers to call, and whether one takes all runs at once."""
    reset = getattr(controller, "reset", None)
    if reset is None:
        return [controller] * (runs if one_by_one else 1), not one_by_one
    if _takes_count(reset) and not one_by_one:
        own = copy.deepcopy(controller)
        own.reset(runs)
        return [own], True
    copies = [copy.deepcopy(controller) for _ in range(runs)]
    for own in copies:
        own.reset(*((1,) if _takes_count(reset) else ()))
    return copies, False


def _takes_count(reset: Any) -> bool:
    return len(inspect.signature(reset).parameters) > 0


def _window(rows: ArrayLike, k: int, length: int | None) -> Array:
    """Row k, or `length` rows from k; the last row is held."""
    rows = np.asarray(rows)
    if length is None:
        row: Array = rows[min(k, len(rows) - 1)]
        return row
    return rows[np.minimum(np.arange(k, k + length), len(rows) - 1)]
