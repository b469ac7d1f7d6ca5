"""Plants that another tool exported as an FMU.

References
----------
Modelica Association, "Functional mock-up interface for model exchange and co-simulation", version 2.0, 2014;
"Functional mock-up interface specification", version 3.0, 2022.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from shutil import rmtree
from typing import Any, NamedTuple
from weakref import finalize

import numpy as np

from ccdtools.arrays import Array
from ccdtools.exceptions import InputError
from ccdtools.plants.black_box import BlackBox
from ccdtools.plants.budgets import EVENT_ROUNDS
from ccdtools.plants.design_space import NO_DESIGN, DesignSpace
from ccdtools_ground.door import as_count, as_instance, as_positive, nearest, shown
from ccdtools_ground.own_process import OwnProcess
from ccdtools_ground.user_functions import in_words


class Words(NamedTuple):
    """Words of a version of FMI for the same things, as FMPy has them."""

    model: str
    real: str
    set_values: str
    update: str
    derivatives: str


FMI = {
    "2": Words("FMU2Model", "Real", "setReal", "newDiscreteStates", "getDerivatives"),
    "3": Words("FMU3Model", "Float64", "setFloat64", "updateDiscreteStates", "getContinuousStateDerivatives"),
}


def from_fmu(
    path: str | Path, *, dt: float, inputs: Sequence[str] | None = None, disturbances: Sequence[str] = (),
    design: DesignSpace = NO_DESIGN, substeps: int = 10, step_limit: float | None = None,
) -> BlackBox:  # fmt: skip
    """Plant of an FMU for model exchange (FMI 2.0 or 3.0), from any state.

    Its derivatives are integrated by Runge–Kutta steps with inputs held; its time stands at 0. Events are handled at
    its begin alone: what they would change later, such as a speed at a bounce, stays. An FMU that has some is warned
    of. FMPy (``pip install "ccdtools[fmu]"``) loads it.

    Parameters
    ----------
    path : path
        The .fmu file, with a binary for this platform.
    dt : float
        Sampling time [s].
    inputs, disturbances : sequence of str, optional
        Real inputs of the FMU that are u and w; by default all that are not disturbances are u.
    design : DesignSpace
        Its names are those of real parameters of the FMU.
    substeps : int
        Runge–Kutta steps a sample.
    step_limit : float, optional
        Longest time of a sample [s], see `BlackBox`; the FMU is then loaded in a process of its own alone.

    Returns
    -------
    BlackBox
        Its states are in the order of the FMU's derivatives.

    Raises
    ------
    InputError
        If FMPy is missing, the file is none, of another version or kind or without a binary for this platform, it has
        no state, or names are not those of its inputs and parameters.

    Examples
    --------
    >>> plant = from_fmu("pendulum.fmu", dt=0.02, design=DesignSpace(["m"], [0.5], [2.0], ["kg"]))  # doctest: +SKIP
    """
    where = Path(as_instance("path", path, (str, Path), "the path of an .fmu file")).resolve()
    as_instance("design", design, DesignSpace, "a DesignSpace")
    described = _described(where)
    known = {v.name: v for v in described.modelVariables}
    words = FMI[described.fmiVersion[0]]
    real = [v for v in described.modelVariables if v.type == words.real and not v.dimensions]
    of_kind = {kind: [v.name for v in real if v.causality == kind] for kind in ("input", "parameter")}
    for argument, names in (("inputs", () if inputs is None else inputs), ("disturbances", disturbances)):
        if not isinstance(names, list | tuple):
            raise InputError(argument, shown(names), "a list of names")
    given = [name for name in of_kind["input"] if name not in disturbances] if inputs is None else list(inputs)
    for argument, names, kind in (
        ("inputs", given, "input"), ("disturbances", disturbances, "input"), ("design", design.names, "parameter")
    ):  # fmt: skip
        unknown = next((name for name in names if name not in of_kind[kind]), None)
        if unknown is not None:
            expected = f"real {kind}s of the FMU: {', '.join(of_kind[kind]) or 'none'}"
            raise InputError(argument, shown(unknown), expected, nearest(unknown, of_kind[kind]))
    if len({*given, *disturbances}) < len(given) + len(disturbances):
        raise InputError("inputs", f"{given} beside disturbances {list(disturbances)}", "each input of the FMU once")
    left = [name for name in of_kind["input"] if name not in given and name not in disturbances]
    events = described.numberOfEventIndicators or len(described.eventIndicators)
    for number, said in (
        (len(left), f"inputs of the FMU that are neither u nor w stay at their start: {', '.join(left)}"),
        (events, f"the FMU has {events} event indicators, and no event is handled after its begin: bounces, stops and "
                 "relays that it states as events are left out; those in its derivatives are not"),
    ):  # fmt: skip
        if number:
            warnings.warn(f"path: {said}", UserWarning, stacklevel=2)
    references = tuple(tuple(known[name].valueReference for name in names) for names in
                       (given, disturbances, design.names))  # fmt: skip
    step = FmuStep(where, as_positive("dt", dt, unit="s"), as_count("substeps", substeps), references)
    plant = BlackBox(
        step, nx=step.nx, nu=len(given), nw=len(disturbances), dt=step.dt, design=design, step_limit=step_limit
    )
    begin = step.begin if plant.step_limit is None else OwnProcess(step.begin, plant.step_limit)
    begin(design.project(design.centre))  # what does not load is told here
    return plant


@dataclass(frozen=True, eq=False)
class FmuStep:
    """Sample of an FMU, which is loaded where it is first asked for, in every process anew.

    Attributes
    ----------
    path : Path
    dt : float
    substeps : int
    references : tuples of int
        Value references of inputs, disturbances and design parameters.
    """

    path: Path
    dt: float
    substeps: int
    references: tuple[tuple[int, ...], ...]

    def as_given(self) -> tuple[Any, ...]:
        """What the file holds and how it is stepped, wherever it lies."""
        return self.path.read_bytes(), self.dt, self.substeps, self.references

    def __getstate__(self) -> dict[str, Any]:
        fields = ("path", "dt", "substeps", "references")
        return {name: self.__dict__[name] for name in fields}

    @cached_property
    def nx(self) -> int:
        """Number of states."""
        return len(_described(self.path).derivatives)

    @cached_property
    def _words(self) -> Words:
        """Words of its version of FMI."""
        return FMI[_described(self.path).fmiVersion[0]]

    @cached_property
    def _loaded(self) -> tuple[Any, dict[str, Any]]:
        """The FMU, and the design that it stands at."""
        import fmpy

        described = _described(self.path)
        kind = getattr(import_module(f"fmpy.fmi{described.fmiVersion[0]}"), self._words.model)
        name = described.modelExchange.modelIdentifier
        try:
            folder = fmpy.extract(str(self.path))
            model = kind(guid=described.guid, unzipDirectory=folder, modelIdentifier=name, instanceName=name)
            finalize(model, rmtree, folder, ignore_errors=True)
            model.instantiate()
        except Exception as error:
            got = f"an FMU that does not load: {' '.join(str(error).split())[:120]}"
            has = ", ".join(fmpy.supported_platforms(str(self.path))) or "none"
            raise InputError("path", got, f"one with a binary for {fmpy.platform}; it has {has}") from error
        return model, {}

    def begin(self, p: Array) -> None:
        """Load the FMU, and bring it to a design."""
        self.at(p)

    def at(self, p: Array) -> Any:
        """The FMU at a design, begun anew where it stands at another or has stopped."""
        model, stands = self._loaded
        stood: Any = stands.get("p")
        if np.array_equal(stood, p):
            return model
        try:
            if stands:
                model.reset()
            stands["p"] = None
            if hasattr(model, "setupExperiment"):  # FMI 3 has none
                model.setupExperiment(startTime=0.0)
            if len(p):
                self._set(model, self.references[2], p)
            model.enterInitializationMode()
            model.exitInitializationMode()
            if all(getattr(model, self._words.update)()[0] for _ in range(EVENT_ROUNDS)):
                raise RuntimeError(f"its events go on after {EVENT_ROUNDS} rounds")
            model.enterContinuousTimeMode()
        except Exception as error:
            got = f"{p.tolist()}, at which the FMU does not begin: {' '.join(str(error).split())[:120]}"
            raise InputError("design", got, "one that it accepts") from error
        stands["p"] = p.copy()
        return model

    def __call__(self, x: Array, u: Array, w: Array, p: Array) -> Array:
        """State (nx,) a sample later."""
        model, n, h = self.at(p), self.nx, self.dt / self.substeps
        state, rate = np.array(x, dtype=float), np.empty(n)
        to_state, to_rate, rates = _pointer(state), _pointer(rate), getattr(model, self._words.derivatives)

        def derivatives(at: Array) -> Array:
            """dx/dt (nx,)."""
            state[:] = at
            model.setContinuousStates(to_state, n)
            rates(to_rate, n)
            return rate.copy()

        try:
            for references, values in zip(self.references, (u, w)):  # held over the sample
                if references:
                    self._set(model, references, values)
            for _ in range(self.substeps):
                first = derivatives(x)
                second = derivatives(x + h / 2 * first)
                third = derivatives(x + h / 2 * second)
                x = x + h / 6 * (first + 2 * second + 2 * third + derivatives(x + h * third))
        except Exception as error:
            self._loaded[1]["p"] = None  # what has stopped begins anew
            got = f"an FMU that stops with {in_words(error)[0]} at x = {shown(state)}, u = {shown(u)}"
            raise InputError("path", got, "one that answers at every state on the way") from error
        return x

    def _set(self, model: Any, references: tuple[int, ...], values: Array) -> None:
        """Set real variables."""
        getattr(model, self._words.set_values)(references, values.tolist())


def _described(path: Path) -> Any:
    """Description of an FMU for model exchange."""
    try:
        import fmpy
    except ImportError as error:
        raise InputError("path", "an FMU, without FMPy", "FMPy", 'pip install "ccdtools[fmu]"') from error
    try:
        described = fmpy.read_model_description(str(path))
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise InputError("path", f"{path}, which cannot be read: {reason[:120]}", "an .fmu file") from error
    if described.fmiVersion[0] not in FMI or described.modelExchange is None:
        alone = described.modelExchange is None
        kind = "co-simulation alone" if alone else "model exchange"
        cure = "A co-simulation goes on from where it stands; a BlackBox steps from any state." if alone else ""
        raise InputError("path", f"FMI {described.fmiVersion} for {kind}", "FMI 2.0 or 3.0 for model exchange", cure)
    if not described.derivatives:
        raise InputError("path", "an FMU without a continuous state", "at least one")
    if any(one.variable.dimensions for one in described.derivatives):
        raise InputError("path", "an FMU whose states are arrays", "states that are single numbers")
    return described


def _pointer(values: Array) -> Any:
    """Pointer to doubles."""
    from ctypes import POINTER, c_double

    return values.ctypes.data_as(POINTER(c_double))
