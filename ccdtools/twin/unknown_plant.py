"""Plants with unknown entries beside the design."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.problem import CoDesignProblem, FixedStart
from ccdtools.co_design.random_starts import RandomStarts
from ccdtools.disturbances.combinations import Stacked, Sum
from ccdtools.disturbances.disturbance import Gaussian, drawn_moments
from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.discretisation import discretise
from ccdtools.plants.models import Model
from ccdtools.plants.plant import Plant
from ccdtools.plants.sampled_model import SampledModel
from ccdtools.plants.simulated_model import SimulatedModel
from ccdtools.plants.symbols import elements
from ccdtools.twin.transport import Transport
from ccdtools_ground.door import as_instance, shown


@dataclass(frozen=True, eq=False)
class UnknownPlant:
    """Plant with outputs and unknown entries in its design.

    Attributes
    ----------
    plant : Plant
    free : tuple of str
        Names of the unknown entries (m,): within their bounds, or about the middle of them if they change a model.
    constants : int
        So many of the last are constant parts of w of a changed model; 0 of a stated plant.
    """

    plant: Plant
    free: tuple[str, ...]
    constants: int = 0

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (m,)."""
        places = [self.plant.design.names.index(name) for name in self.free]
        return self.plant.design.lower[places], self.plant.design.upper[places]

    def functions(self, problem: CoDesignProblem, p: Array) -> tuple[ca.Function, ca.Function]:
        """Functions x⁺(x, u, w, θ) and y(x, u, θ) at a design."""
        x, u, w = (ca.MX.sym(*sized) for sized in zip("xuw", (self.plant.nx, self.plant.nu, self.plant.nw)))
        theta, names = ca.MX.sym("theta", len(self.free)), (*problem.design.names, *self.free)
        whole = ca.vertcat(ca.DM(p), theta)[[names.index(name) for name in self.plant.design.names]]
        after = _sampled(problem, self.plant).step(x, u, w, whole)
        outputs = ca.Function("output", [x, u, theta], [self.plant.output(x, u, whole)])
        return ca.Function("step", [x, u, w, theta], [after]), outputs

    def at(self, box: DesignSpace, values: Array) -> tuple[Plant, ca.SX]:
        """Plant of a box of designs at values (m,) of its unknown entries, moved to rest at 0, and by what (nx, 1)."""
        if set(self.plant.design.names) != {*box.names, *self.free}:
            expected = "a problem with the design of the one that was fitted"
            raise InputError("problem", f"a design of {', '.join(box.names) or 'nothing'}", expected)
        symbols = dict(zip(self.plant.design.names, elements(self.plant.p)))
        p, rest = (ca.vertcat(*(symbols[name] for name in names)) for names in (box.names, self.free))
        cut = len(values) - self.constants
        held = ca.DM([*values[:cut], *(0 * values[cut:])])
        put: Callable[[ca.SX], ca.SX] = lambda expression: ca.substitute(expression, rest, held)  # noqa: E731
        own, dynamics = self.plant, put(self.plant.dynamics)
        signals = ca.vertcat(own.x, own.u, own.w)
        slope = ca.substitute(dynamics, signals, ca.DM.zeros(signals.shape))
        plant = replace(own, p=p, dynamics=dynamics - slope, outputs=put(own.outputs), design=box)
        return plant, slope

    def known(self, problem: CoDesignProblem, values: Array) -> CoDesignProblem:
        """Problem with the unknown entries at values (m,).

        A constant part of w is added to the disturbance. Anything else that moves the plant at rest, such as a slope,
        enters with a further disturbance, which is 1.
        """
        plant, slope = self.at(problem.design, values)
        sensors, scenarios = problem.measurement, problem.scenarios
        constant = values[len(values) - self.constants :]
        if constant.any():
            scenarios = disturbed(problem, lambda w: Sum((w, Gaussian(0 * constant, constant))))
        plant, scenarios = moved_at_rest(replace(problem, scenarios=scenarios), plant, slope)
        if sensors is not None and isinstance(sensors.output, Plant):
            sensors = replace(sensors, output=plant)
        return replace(problem, model=_sampled(problem, plant), measurement=sensors, scenarios=scenarios)


def mean_disturbance(problem: CoDesignProblem) -> Array:
    """Mean (nw,), by a sample where the scenarios do not know it."""
    known = getattr(getattr(problem.scenarios, "disturbance", None), "mean", None)
    if isinstance(known, np.ndarray):
        return known
    return drawn_moments(problem.scenarios, problem.steps)[2]


def disturbed(problem: CoDesignProblem, changed: Callable[[Any], Any]) -> Any:
    """Scenarios with a changed disturbance."""
    scenarios = problem.scenarios
    if not isinstance(scenarios, FixedStart | RandomStarts):
        cure = "What the log tells of a constant part is added to its disturbance."
        raise InputError("problem.scenarios", shown(scenarios), "a FixedStart or RandomStarts", cure)
    return replace(scenarios, disturbance=changed(scenarios.disturbance))


def moved_at_rest(problem: CoDesignProblem, plant: Plant, slope: ca.SX) -> tuple[Plant, Any]:
    """Plant and scenarios with `slope` (nx, 1) added, by a disturbance of 1."""
    if slope.is_zero():
        return plant, problem.scenarios
    one = ca.SX.sym("one")
    plant = replace(plant, w=ca.vertcat(plant.w, one), dynamics=plant.dynamics + slope * one)
    return plant, disturbed(problem, lambda w: Stacked((w, Gaussian([0.0], [1.0]))))


def _sampled(problem: CoDesignProblem, plant: Plant) -> Model:
    """Model of a plant, as the problem's was made."""
    own = problem.model
    if isinstance(own, SampledModel) and not plant.linear:
        return replace(own, plant=plant, error=None)
    return discretise(plant, own.dt, sampling_guard="ignore")


def stated_plant(problem: CoDesignProblem, plant: Plant) -> UnknownPlant:
    """Plant of a user, with unknown entries."""
    as_instance("plant", plant, Plant, "a Plant with unknown entries in its design, or None")
    names, own, model = plant.design.names, problem.design.names, problem.model
    free = tuple(name for name in names if name not in own)
    if not free or len(free) + len(own) != len(names):
        got = f"a design of {', '.join(names)}"
        raise InputError("plant", got, f"one of {', '.join(own)}, and what is unknown besides")
    sizes = [(one.nx, one.nu, one.nw) for one in (plant, model)]
    if sizes[0] != sizes[1]:
        cure = "An updated problem may have a further disturbance: fit the one that it was made of."
        raise InputError("plant", f"(nx, nu, nw) = {sizes[0]}", f"{sizes[1]}, as of the problem's model", cure)
    C = None if problem.measurement is None else problem.measurement.output
    if isinstance(C, Plant) and plant.ny != C.ny:
        raise InputError("plant", f"{plant.ny} outputs", f"{C.ny}, as many as the problem measures")
    if isinstance(C, np.ndarray):
        plant = replace(plant, outputs=ca.DM(C) @ plant.x, output_names=(), output_limits=None)
    return UnknownPlant(plant, free)


def changed_plant(problem: CoDesignProblem, p: Array) -> UnknownPlant:
    """Nominal model with an unknown affine part of w.

    It has w + Θx x + Θu u + θ in the place of w. Units are the largest effect that the model has through w, at the edge
    of X and U.
    """
    model, box, scale = problem.model, problem.design, problem.state_scale
    if isinstance(model, SimulatedModel):
        expected = "a model by discretise(plant)"
        raise InputError("problem.model", repr(model), expected, "Pass plant=, with what is unknown.")
    A, B, _ = model.matrices(p)
    span = np.concatenate([scale, np.abs(problem.input_bounds).max(axis=0), [1.0]])
    through = Transport.at(model, p, scale).inverse @ np.hstack([A - np.eye(model.nx), B])
    units = (np.abs(through * span[:-1]).max(axis=1, initial=0.0)[:, None] / span).T.ravel()
    if not (len(units) and (units > 0).all()):
        got = "a model into which a disturbance enters nowhere, or nothing else does"
        raise InputError("problem.model", got, "one that changes where w enters", "Pass plant=, with what is unknown.")
    by = (*problem.state_names, *problem.input_names, "constant")
    free = tuple(f"w{i + 1} by {name}" for name in by for i in range(model.nw))
    theta = ca.SX.sym("theta", len(free))
    x, u, w = (ca.SX.sym(*sized) for sized in zip("xuw", (model.nx, model.nu, model.nw)))
    sampled = isinstance(model, SampledModel)
    design = ca.SX.sym("p", box.dim)
    rates = model.plant.right_hand_side if sampled else model.step
    dynamics = rates(x, u, w + ca.reshape(theta, model.nw, -1) @ ca.vertcat(x, u, 1), design)
    C = np.zeros((0, model.nx)) if problem.measurement is None else problem.measurement.output
    outputs = C.output(x, u, design) if isinstance(C, Plant) else ca.DM(C) @ x
    space = DesignSpace((*box.names, *free), np.r_[box.lower, -units], np.r_[box.upper, units])
    continuous = sampled and model.plant.continuous
    plant = Plant(x, u, w, ca.vertcat(design, theta), dynamics, space, model.dt, continuous, outputs=outputs,
                  state_names=problem.state_names, input_names=problem.input_names)  # fmt: skip
    return UnknownPlant(plant, free, constants=model.nw)
