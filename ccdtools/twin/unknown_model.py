"""Models with unknown parameters beside the design."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.checks import as_instance, shown
from ccdtools.co_design.problem import CoDesignProblem, FixedStart
from ccdtools.co_design.random_starts import RandomStarts
from ccdtools.disturbances.combinations import Sum
from ccdtools.disturbances.disturbance import Gaussian
from ccdtools.estimation.measurement import Measurement
from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.discretisation import discretise
from ccdtools.plants.linear_model import LinearModel
from ccdtools.plants.models import Model
from ccdtools.plants.plant import Plant
from ccdtools.plants.sampled_model import SampledModel
from ccdtools.plants.symbols import elements
from ccdtools.twin.transport import Transport


@dataclass(frozen=True, eq=False)
class UnknownModel:
    """Model and outputs of a problem, with unknown parameters besides.

    Attributes
    ----------
    model : LinearModel or SampledModel
        In the problem's design and the unknown entries, in the order of `names`.
    measurement : Measurement
        Of a matrix, or of a plant of the model's design.
    names : tuple of str
    free : tuple of str
        Those of the unknown entries (m,).
    guess, units, lower, upper : (m,) arrays
    offsets : int
        So many of the last are constant parts of w.
    """

    model: Model
    measurement: Measurement
    names: tuple[str, ...]
    free: tuple[str, ...]
    guess: Array
    units: Array
    lower: Array
    upper: Array
    offsets: int = 0

    def functions(self, own: Sequence[str], p: Array) -> tuple[ca.Function, ca.Function]:
        """(x, u, w, θ) → x⁺ and (x, u, θ) → y at a named design."""
        nx, nu, nw = self.model.nx, self.model.nu, self.model.nw
        x, u, w, theta = (ca.MX.sym(*sized) for sized in zip("xuwq", (nx, nu, nw, len(self.free))))
        places = [(*own, *self.free).index(name) for name in self.names]
        whole = ca.vertcat(ca.DM(p), theta)[places]
        stated = self.measurement.output
        y = stated.output(x, u, whole) if isinstance(stated, Plant) else ca.DM(stated) @ x
        after = ca.Function("step", [x, u, w, theta], [self.model.step(x, u, w, whole)])
        return after, ca.Function("output", [x, u, theta], [y])

    def known(self, problem: CoDesignProblem, values: Array) -> CoDesignProblem:
        """Problem with the unknown entries at values (m,).

        Constant parts of w go into its disturbance.
        """
        box, cut = problem.design, len(values) - self.offsets
        if set(box.names) | set(self.free) != set(self.names) or len(box.names) + len(self.free) != len(self.names):
            own = [name for name in self.names if name not in self.free]
            raise InputError("problem", f"a design of {', '.join(box.names)}", ", ".join(own))
        held = dict(zip(self.free, np.concatenate([values[:cut], np.zeros(self.offsets)])))
        model = self.model
        if isinstance(model, LinearModel):
            p, put = _held(model.symbols, self.names, box, held)
            known: Model = replace(
                model, symbols=p, A=put(model.A), B=put(model.B), E=put(model.E), c=put(model.c), design=box
            )
        else:
            known = replace(model, plant=self._plant(model.plant, box, held), error=None)
        measurement = self.measurement
        if isinstance(measurement.output, Plant):
            measurement = replace(measurement, output=self._plant(measurement.output, box, held))
        scenarios, offset = problem.scenarios, values[cut:]
        if offset.any():
            if not isinstance(scenarios, FixedStart | RandomStarts):
                cure = "What the log tells of a constant part of w is added to a disturbance."
                raise InputError("problem.scenarios", shown(scenarios), "a FixedStart or RandomStarts", cure)
            scenarios = replace(scenarios, disturbance=Sum((scenarios.disturbance, Gaussian(0 * offset, offset))))
        return replace(problem, model=known, measurement=measurement, scenarios=scenarios)

    def _plant(self, plant: Plant, box: DesignSpace, held: dict[str, float]) -> Plant:
        """Plant of a problem's design alone."""
        p, put = _held(plant.p, self.names, box, held)
        return replace(plant, p=p, dynamics=put(plant.dynamics), outputs=put(plant.outputs), design=box)


def _held(
    symbols: ca.SX, names: tuple[str, ...], box: DesignSpace, held: dict[str, float]
) -> tuple[ca.SX, Callable[[ca.SX], ca.SX]]:
    """Symbols of a problem's design, and what removes the others."""
    known = dict(zip(names, elements(symbols)))
    rest = ca.vertcat(*(known[name] for name in held))
    numbers = ca.DM([*held.values()])
    return ca.vertcat(*(known[name] for name in box.names)), lambda M: ca.substitute(M, rest, numbers)


def stated_model(problem: CoDesignProblem, plant: Plant) -> UnknownModel:
    """Model of a plant with unknown entries in its design.

    Raises
    ------
    InputError
        If it has none more, lacks one, or has other states, inputs or disturbances.
    """
    model, box = problem.model, problem.design
    as_instance("plant", plant, Plant, "a Plant with unknown entries in its design, or None")
    free = tuple(name for name in plant.design.names if name not in box.names)
    lacking = [name for name in box.names if name not in plant.design.names]
    if lacking or not free:
        got = f"a design of {', '.join(plant.design.names)}"
        raise InputError("plant", got, f"one of {', '.join(box.names)}, and what is unknown besides")
    sizes = [(one.nx, one.nu, one.nw) for one in (plant, model)]
    if sizes[0] != sizes[1]:
        raise InputError("plant", f"(nx, nu, nw) = {sizes[0]}", f"{sizes[1]}, as of the problem's model")
    alike = isinstance(model, SampledModel) and not plant.linear
    wide = replace(model, plant=plant, error=None) if alike else discretise(plant, model.dt, sampling_guard="ignore")
    places = [plant.design.names.index(name) for name in free]
    lower, upper = plant.design.lower[places], plant.design.upper[places]
    measurement = problem.measurement
    if isinstance(measurement.output, Plant):
        measurement = replace(measurement, output=plant)
    names = tuple(plant.design.names)
    return UnknownModel(wide, measurement, names, free, (lower + upper) / 2, (upper - lower) / 2, lower, upper)


def changed_model(problem: CoDesignProblem, p: Array) -> UnknownModel:
    """Model with w + Θx x + Θu u + θ in the place of w, unknown Θ and θ.

    Units are the largest effect that the nominal model has through w at the edge of X and U.
    """
    model, scale, box = problem.model, problem.state_scale, problem.design
    nx, nu, nw = model.nx, model.nu, model.nw
    A, B, _ = model.matrices(p)
    span = np.concatenate([scale, np.abs(problem.input_bounds).max(axis=0), [1.0]])
    through = Transport.at(model, p, scale).inverse @ np.hstack([A - np.eye(nx), B])
    units = (np.abs(through * span[:-1]).max(axis=1, initial=0.0)[:, None] / span).T.ravel()
    if nw == 0 or not (units > 0).all():
        got = "a model into which a disturbance enters nowhere, or nothing else does"
        raise InputError("problem.model", got, "one that changes where w enters", "Pass plant=, with what is unknown.")
    by = (*problem.state_names, *problem.input_names, "constant")
    free = tuple(f"w{i + 1} by {name}" for name in by for i in range(nw))
    theta = ca.SX.sym("theta", len(free))
    change = ca.reshape(theta, nw, nx + nu + 1)
    names = (*box.names, *free)
    space = DesignSpace(names, np.r_[box.lower, -units], np.r_[box.upper, units])
    measurement = problem.measurement
    if isinstance(measurement.output, Plant):
        own = measurement.output
        measurement = replace(measurement, output=replace(own, p=ca.vertcat(own.p, theta), design=space))
    if isinstance(model, LinearModel):
        A, B, c = (model.E @ part for part in ca.horzsplit(change, [0, nx, nx + nu, nx + nu + 1]))
        symbols = ca.vertcat(model.symbols, theta)
        wide: Model = replace(model, symbols=symbols, A=model.A + A, B=model.B + B, c=model.c + c, design=space)
    else:
        plant = model.plant
        w = plant.w + change @ ca.vertcat(plant.x, plant.u, 1)
        dynamics = ca.substitute(plant.dynamics, plant.w, w)
        plant = replace(plant, p=ca.vertcat(plant.p, theta), dynamics=dynamics, design=space)
        wide = replace(model, plant=plant, error=None)
    none = np.zeros(len(free))
    return UnknownModel(
        wide, measurement, names, free, none, units, none - np.inf, none + np.inf, offsets=nw
    )  # fmt: skip
