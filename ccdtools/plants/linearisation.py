"""Linear plants that stand for a nonlinear one near a point, and the plant itself in deviations from where it rests."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools.checks import as_instance, as_vector
from ccdtools.exceptions import InputError
from ccdtools.plants.equilibrium import Equilibrium
from ccdtools.plants.jumps import SMOOTHER
from ccdtools.plants.plant import Plant


def linearise(
    plant: Plant, about: Equilibrium | ArrayLike, u: ArrayLike | None = None, w: ArrayLike | None = None
) -> Plant:
    """The linear plant that a plant looks like near a point, symbolic in the design.

    About an `Equilibrium` it is in deviations from the state and input at rest, x_e(p) and u_e(p), which follow the
    design; there is no constant term. About any other point it is in x, u and w themselves, with a constant term.

    Parameters
    ----------
    plant : Plant
    about : Equilibrium, or (nx,) array_like
        Where, or the state.
    u, w : (nu,) and (nw,) array_like, optional
        Input and disturbance beside a state; 0 by default.

    Returns
    -------
    Plant
        Of the same names, design, sampling time; `discretise` makes an exact `LinearModel` of it.

    Raises
    ------
    InputError
        If a size is wrong, or at some design of the box a derivative is not finite or the dynamics jump at the point.
    """
    as_instance("plant", plant, Plant, "a Plant")
    z = ca.vertcat(plant.x, plant.u, plant.w)
    if isinstance(about, Equilibrium):
        if u is not None or w is not None:
            raise InputError("u, w", "values beside an equilibrium", "nothing, for it has its own")
        point, rest = _point(plant, about), ca.SX.zeros(plant.nx, 1)
        J = ca.substitute(ca.jacobian(plant.dynamics, z), z, point)
    else:
        x = as_vector("about", about, plant.nx)
        u = np.zeros(plant.nu) if u is None else as_vector("u", u, plant.nu)
        w = np.zeros(plant.nw) if w is None else as_vector("w", w, plant.nw)
        point = ca.SX(ca.DM(np.r_[x, u, w]))
        J = ca.substitute(ca.jacobian(plant.dynamics, z), z, point)
        rest = ca.substitute(plant.dynamics, z, point) - J @ point
    _check_smooth(plant, J)
    _check_no_jump(plant, point)
    return replace(plant, dynamics=ca.densify(J @ z + rest))


def deviations(plant: Plant, about: Equilibrium) -> Plant:
    """The plant in deviations from its state and input at rest, x_e(p) and u_e(p): it rests at 0 at every design.

    Parameters
    ----------
    plant : Plant
    about : Equilibrium

    Raises
    ------
    InputError
        If the plant does not come to rest at some design of the box.
    """
    as_instance("plant", plant, Plant, "a Plant")
    as_instance("about", about, Equilibrium, "an Equilibrium", "equilibrium(plant, p) finds one.")
    z = ca.vertcat(plant.x, plant.u, plant.w)
    moved = ca.substitute(plant.dynamics, z, z + _point(plant, about))
    if not plant.continuous:
        moved = moved - _point(plant, about)[: plant.nx]
    return replace(plant, dynamics=ca.densify(moved))


def _point(plant: Plant, about: Equilibrium) -> ca.SX:
    """(x, u, w) at rest, as expressions in the design."""
    if about.plant is not plant:
        raise InputError("about", "an equilibrium of another plant", "one of this plant", "equilibrium(plant, p)")
    x, u = about.function(plant.p)
    return ca.vertcat(x, u, ca.SX(ca.DM(about.w)) if plant.nw else ca.SX(0, 1))


def _check_smooth(plant: Plant, J: ca.SX) -> None:
    """Raise an `InputError` unless the derivatives are finite at designs all over the box."""
    function = ca.Function("J", [plant.p], [ca.densify(J)])
    for p in plant.design.spread():
        if not np.isfinite(np.asarray(function(p), dtype=float)).all():
            place = f" at {plant.design.describe(p)}" if plant.design.dim else ""
            got = f"a point where a derivative is not finite{place}"
            raise InputError("about", got, "one where the plant is smooth")


def _check_no_jump(plant: Plant, point: ca.SX) -> None:
    """Raise an `InputError` if the dynamics jump at the point, at designs all over the box."""
    if not plant.switches:
        return
    function = ca.Function("point", [plant.p], [ca.densify(point)])
    for p in plant.design.spread():
        jump = plant.switches.at(np.asarray(function(p), dtype=float).ravel(), p)
        if jump is not None:
            place = f" at {plant.design.describe(p)}" if plant.design.dim else ""
            where = f"a point at which the dynamics of {plant.state_names[jump.row]} jump"
            got = f"{where} ({', '.join(jump.names)}){place}"
            raise InputError("about", got, "one where the plant is smooth", SMOOTHER)
