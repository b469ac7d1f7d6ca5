"""Plants that step, and kinds of discrete models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import NoneType
from typing import Any, TypeAlias

import numpy as np

from ccdtools.arrays import Array
from ccdtools.exceptions import InputError
from ccdtools.plants.budgets import COMPILED_FROM
from ccdtools.plants.design_space import DesignSpace, sample_designs
from ccdtools.plants.linear_model import LinearModel
from ccdtools.plants.plant import ABOUT_REST, Plant
from ccdtools.plants.sampled_model import SampledModel
from ccdtools.plants.simulated_model import Simulable as Simulable, SimulatedModel, Step as Step
from ccdtools.plants.tolerances import MODEL_AT_REST
from ccdtools_ground.door import as_count, as_instance, as_number, shown

Model: TypeAlias = LinearModel | SampledModel | SimulatedModel

DEVIATIONS = "State it about its equilibrium, as discretise(deviations(plant, equilibrium(plant, p))) does."


class PlantOfModel:
    """Sizes, sampling time and designs of a plant with a `model`."""

    model: Model

    @property
    def nx(self) -> int:
        """Number of states."""
        return self.model.nx

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self.model.nu

    @property
    def nw(self) -> int:
        """Number of disturbances."""
        return self.model.nw

    @property
    def dt(self) -> float:
        """Sampling time [s]."""
        return self.model.dt

    @property
    def design(self) -> DesignSpace | None:
        """Box of designs."""
        return self.model.design


def as_simulable(plant: Any, argument: str = "plant") -> Simulable:
    """Plant that `simulate` can step; a `control.StateSpace` becomes a `LinearModel`."""
    if isinstance(plant, type):
        raise InputError(argument, shown(plant), "an object of it")
    if hasattr(plant, "stepper"):
        missing = [name for name in ("nx", "nu", "nw", "dt", "design") if not hasattr(plant, name)]
        if missing:
            raise InputError(argument, f"{shown(plant)} without {', '.join(missing)}", "a Simulable, which has them")
        for name, least in (("nx", 1), ("nu", 1), ("nw", 0)):
            as_count(f"{argument}.{name}", getattr(plant, name), least=least)
        as_number(f"{argument}.dt", plant.dt, expected="a sampling time > 0 s", low=0.0, strict=True)
        as_instance(f"{argument}.design", plant.design, (DesignSpace, NoneType), "a DesignSpace or None")
        if not callable(plant.stepper):
            raise InputError(f"{argument}.stepper", shown(plant.stepper), "a method (p, batch) → step")
        simulable: Simulable = plant
        return simulable
    if not all(hasattr(plant, name) for name in ("A", "B", "dt")):
        cure = "Convert it with control.ss." if hasattr(plant, "num") else ""
        expected = "a Plant, a model, a control.StateSpace, or an object with the members of `Simulable`"
        raise InputError(argument, shown(plant), expected, cure)
    return LinearModel.from_state_space(plant)


def steps_alone(value: Any) -> bool:
    """Whether only a step is known of a plant, as of a simulator."""
    known = isinstance(value, type | Plant | PlantOfModel | LinearModel | SampledModel)
    return hasattr(value, "stepper") and not known


def as_model(argument: str, value: Any) -> Model:
    """`value`, if it is a model; the model of a simulator; else an `InputError`."""
    if steps_alone(value) and not isinstance(value, SimulatedModel):
        return SimulatedModel(as_simulable(value, argument))
    if not isinstance(value, LinearModel | SampledModel | SimulatedModel):
        raise InputError(argument, shown(value), "a LinearModel or a SampledModel", "Pass discretise(plant).")
    return value


def for_long_work(model: Model, samples: int) -> Model:
    """Model, compiled if that pays for so many samples."""
    if isinstance(model, SampledModel) and samples >= COMPILED_FROM:
        return replace(model, compiled=True)
    return model


def as_regulated_model(argument: str, value: Any) -> Model:
    """`value`, if it is a model that rests at 0 at every design."""
    model = as_model(argument, value)
    if isinstance(model, SampledModel):
        check_at_rest(argument, model, model.plant.state_names)
    elif isinstance(model, LinearModel) and model.affine:
        raise InputError(argument, "a constant term in the dynamics", "a model that rests at 0", DEVIATIONS)
    return model


def check_at_rest(argument: str, model: Any, names: Sequence[str], slack: Array | float = 0.0) -> None:
    """Raise an `InputError` unless a model rests at 0 within `slack` (nx,)."""
    for p in sample_designs(model.design):
        A, B, _ = model.matrices(p)
        moved = np.abs(model.undisturbed(p)(np.zeros(model.nx), np.zeros(model.nu)))
        size = np.maximum(np.abs(A).sum(axis=1), np.abs(B).sum(axis=1))
        if not (moved <= slack + MODEL_AT_REST * np.maximum(size, np.finfo(float).tiny)).all():
            i = int(np.argmax(moved))
            where = f"{names[i]} moves by {moved[i]:.3g} a sample at {model.design.describe(p)}"
            got = f"a plant that does not rest at x = 0, u = 0: {where}"
            raise InputError(argument, got, "one that does", ABOUT_REST if steps_alone(model) else DEVIATIONS)
