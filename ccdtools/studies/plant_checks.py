"""Checks of model and real plant over the whole design box."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ccdtools.exceptions import InputError
from ccdtools.plants.plant import Plant
from ccdtools.studies.real_plant import RealPlant


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
    for what, own, other in (("states", plant.nx, model.nx), ("inputs", plant.nu, model.nu)):
        if own != other:
            raise InputError("real.plant", f"{own} {what}", f"{other}, as the model has")
    if not np.isclose(plant.dt, model.dt, rtol=1e-9, atol=0.0):
        raise InputError("real.plant", f"dt = {plant.dt:g} s", f"{model.dt:g} s, the sampling time of the model")
    own_space = (tuple(plant.design.names), plant.design.lower.tolist(), plant.design.upper.tolist())
    if own_space != (tuple(model.design.names), model.design.lower.tolist(), model.design.upper.tolist()):
        raise InputError("real.plant", "another design space", "the parameters and bounds of the model")
    u = np.zeros(plant.nu)
    w = np.zeros(plant.nw)
    for design in plant.design.spread():
        if not np.isfinite(np.asarray(plant.step(real.x0, u, w, design), dtype=float)).all():
            got = f"a first step that is not finite at {plant.design.describe(design)}"
            raise InputError("real.plant", got, "finite dynamics over the whole design box")
