"""Checks of model and real plant over the whole design box, and of the steps of the real one."""

from __future__ import annotations

import warnings

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.disturbances.disturbance import Disturbance
from ccdtools.exceptions import InputError, SamplingWarning
from ccdtools.plants.design_space import NO_DESIGN
from ccdtools.plants.integration_error import IntegrationError, Region, measured_error
from ccdtools.plants.plant import Plant
from ccdtools.plants.runge_kutta import ExplicitStep
from ccdtools.studies.real_plant import RealPlant
from ccdtools.studies.tolerances import NEAR_MIDDLE, THROWN_OUT, UNSTABLE_SAMPLE, WRONG_SAMPLE
from invariant_sets import Polytope


def check_finite(plant: Plant) -> None:
    """Raise unless the derivatives of the dynamics are finite over the designs."""
    z = ca.vertcat(plant.x, plant.u, plant.w)
    at_zero = ca.substitute(ca.densify(ca.jacobian(plant.dynamics, z)), z, ca.SX.zeros(z.shape))
    matrices = ca.Function("matrices", [plant.p], [at_zero])
    for design in plant.design.spread():
        if not np.isfinite(np.asarray(matrices(design), dtype=float)).all():
            got = f"dynamics that are not finite at {plant.design.describe(design)}"
            raise InputError("plant", got, "finite ones over the whole design box", "Move the bounds of the design.")


def check_same_plant(model: Plant, real: RealPlant) -> None:
    """Raise unless the real plant is finite and sized like the model."""
    plant = real.plant
    space = plant.design or NO_DESIGN
    for what, own, other in (("states", plant.nx, model.nx), ("inputs", plant.nu, model.nu)):
        if own != other:
            raise InputError("real.plant", f"{own} {what}", f"{other}, as the model has")
    if not np.isclose(plant.dt, model.dt, rtol=1e-9, atol=0.0):
        raise InputError("real.plant", f"dt = {plant.dt:g} s", f"{model.dt:g} s, the sampling time of the model")
    own_space = (tuple(space.names), space.lower.tolist(), space.upper.tolist())
    if own_space != (tuple(model.design.names), model.design.lower.tolist(), model.design.upper.tolist()):
        raise InputError("real.plant", "another design space", "the parameters and bounds of the model")
    u = np.zeros((1, plant.nu))
    w = np.zeros((1, plant.nw))
    for design in space.spread():
        if not np.isfinite(plant.stepper(design, batch=1)(real.x0[None], u, w)).all():
            got = f"a first step that is not finite at {space.describe(design)}"
            raise InputError("real.plant", got, "finite dynamics over the whole design box")


def check_real_step(plant: Plant, X: Polytope, U: Polytope, W: tuple[Array, Array], *, guard: str) -> None:
    """Warn if a real plant's sample may be wrong by 0.1 of X.

    A sample in `plant.substeps` parts is compared with one of twice as many, within X, U and W and at all designs. A
    disturbance that no plant bears is left to the check of the disturbance.

    Raises
    ------
    InputError
        If the difference exceeds three half-widths of X even within a tenth of it.
    """
    if not plant.continuous:
        return
    region = Region.of(X.bounding_box(), U.bounding_box(), W, (plant.design.lower, plant.design.upper))
    found = _error(plant, region, plant.substeps)
    if found.relative <= WRONG_SAMPLE:
        return
    calm = Region.of(*region.boxes[:2], (0 * W[0], 0 * W[1]), region.boxes[3])
    if not found.relative < THROWN_OUT and _error(plant, calm, plant.substeps).relative <= WRONG_SAMPLE:
        return
    where = f"x = {found.x.round(6).tolist()}, {plant.design.describe(found.p)}"
    got = f"{plant.substeps} Runge–Kutta steps a sample, too long for it: the worst at {where}"
    advice = _advice(plant, region)
    low, high = (calm.centre + NEAR_MIDDLE * (end - calm.centre) for end in calm.boxes[0])
    near = Region.of((low, high), *calm.boxes[1:])
    if not NEAR_MIDDLE * _error(plant, near, plant.substeps).relative <= UNSTABLE_SAMPLE:
        raise InputError("real.plant", got, "steps that follow the plant", advice)
    if guard == "warn":
        wrong = f"a sample may be wrong by {found.relative:.2g} of half the range in X"
        warnings.warn(f"real.plant: {got}, where {wrong}. {advice}", SamplingWarning, stacklevel=5)


def extent_of(disturbance: Disturbance) -> tuple[Array, Array]:
    """Bounds (nw,) of draws of a disturbance.

    They are symmetric but for what does not change in a run: an uncertain mass may be far heavier, and is not negative.
    """
    several = disturbance.sample(200, 2, np.random.default_rng(0))  # what differs from run to run
    steps = 1000
    while True:
        try:
            single = disturbance.sample(1, steps, np.random.default_rng(0))
            break
        except InputError:
            if steps <= 2:
                raise
            steps //= 2
    constant = (several[:, :1] == several).all(axis=(0, 1)) & (single[:, :1] == single).all(axis=(0, 1))
    drawn = np.concatenate([single[0], several.reshape(-1, several.shape[2])])
    largest = np.abs(drawn).max(axis=0)
    lower, upper = drawn.min(axis=0, initial=0.0), drawn.max(axis=0, initial=0.0)
    return np.where(constant, lower, -largest), np.where(constant, upper, largest)


def _error(plant: Plant, region: Region, substeps: int) -> IntegrationError:
    coarse, fine = (ExplicitStep.of(plant.right_hand_side, plant.dt, k * substeps) for k in (1, 2))
    return measured_error(coarse, fine, region)


def _advice(plant: Plant, region: Region) -> str:
    substeps = 2 * plant.substeps
    while substeps <= 1000:  # no more are recommended
        if _error(plant, region, substeps).relative <= WRONG_SAMPLE:
            return f"Give the plant substeps={substeps}."
        substeps *= 2
    return "Shorten dt, or give discretise(plant, X=…, U=…, W=…, method='collocation') as the real plant."
