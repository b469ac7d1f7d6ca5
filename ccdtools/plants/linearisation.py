"""Linearised plants, and plants in deviations from rest."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools.exceptions import InputError
from ccdtools.plants.equilibrium import Equilibrium
from ccdtools.plants.jumps import SMOOTHER, Switches
from ccdtools.plants.plant import ABOUT_REST, Plant
from ccdtools_ground.door import as_instance, as_vector


def linearise(
    plant: Plant, about: Equilibrium | ArrayLike, u: ArrayLike | None = None, w: ArrayLike | None = None
) -> Plant:
    """Linear plant near a point, symbolic in the design.

    About an `Equilibrium` it is in deviations from the state and input at rest, x_e(p) and u_e(p), which follow the
    design; there is no constant term. About any other point it is in x, u and w themselves, with a constant term.

    Outputs are linearised about the same point, and remain those of the plant: y = h(z_e) + Dh z of deviations z, and
    h(z₀) + Dh (z − z₀) about another point z₀. Their limits hold as they are.

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
        Of the same names, design, sampling time, limits of outputs; `discretise` makes an exact `LinearModel` of it.

    Raises
    ------
    InputError
        If a size is wrong, the equilibrium is one of another plant, or at some design of the box a derivative is not
        finite or the dynamics jump at the point.
    """
    as_instance("plant", plant, Plant, "a Plant")
    z = ca.vertcat(plant.x, plant.u, plant.w)
    if isinstance(about, Equilibrium):
        if u is not None or w is not None:
            raise InputError("u, w", "values beside an equilibrium", "nothing, for it has its own")
        if about.plant is not plant:
            raise InputError("about", "an equilibrium of another plant", "one of this plant", "equilibrium(plant, p)")
        point, origin = _point(plant, about), ca.SX.zeros(z.shape)
    else:
        x = as_vector("about", about, plant.nx)
        u = np.zeros(plant.nu) if u is None else as_vector("u", u, plant.nu)
        w = np.zeros(plant.nw) if w is None else as_vector("w", w, plant.nw)
        point = origin = ca.SX(ca.DM(np.r_[x, u, w]))
    J, H = (ca.substitute(ca.jacobian(f, z), z, point) for f in (plant.dynamics, plant.outputs))
    _check_smooth(plant, ca.vertcat(J, H), point)
    at, y = (ca.substitute(f, z, point) for f in (plant.dynamics, plant.outputs))
    rest = ca.SX.zeros(plant.nx, 1) if isinstance(about, Equilibrium) else at - J @ point
    return replace(plant, dynamics=ca.densify(J @ z + rest), outputs=ca.densify(y + H @ (z - origin)))


def deviations(plant: Plant, about: Equilibrium) -> Plant:
    """Plant in deviations from its rest x_e(p), u_e(p).

    A disturbance at rest that is not 0 is counted from, too: w = 0 is then that one.
    Outputs remain those of the plant, y = h(x_e + x, u_e + u, p), and their limits hold as they are.

    So that p stays symbolic, every right-hand side holds the way to rest: 170 instructions in place of 22 of the
    hanging mass of docs/how_to/plant.md. A sample of 1000 runs takes 1.6 times as long at one design, 2.9 times with
    one each.

    Parameters
    ----------
    plant : Plant
    about : Equilibrium
        Of the plant; or of another of the same numbers of states, inputs and disturbances whose design is in the
        plant's, such as the nominal one of a real plant, or of one with unknown entries besides. The plant is then in
        the coordinates of the nominal one, and rests at 0 only where both rest alike.

    Raises
    ------
    InputError
        If the equilibrium is one of a plant of other sizes or designs, or is not found at some design of the box.
    """
    as_instance("plant", plant, Plant, "a Plant", ABOUT_REST)
    as_instance("about", about, Equilibrium, "an Equilibrium", "equilibrium(plant, p) finds one.")
    _check_alike(plant, about.plant)
    z = ca.vertcat(plant.x, plant.u, plant.w)
    point = _point(plant, about)
    moved, outputs = (ca.substitute(f, z, z + point) for f in (plant.dynamics, plant.outputs))
    if not plant.continuous:
        moved = moved - point[: plant.nx]
    return replace(plant, dynamics=ca.densify(moved), outputs=ca.densify(outputs))


def _check_alike(plant: Plant, other: Plant) -> None:
    """Raise an `InputError` unless sizes and boxes of designs agree."""
    own, its = ((f"{one.nx} states, {one.nu} inputs and {one.nw} disturbances", one.design) for one in (plant, other))
    box, its_box = (set(zip(d.names, d.lower.tolist(), d.upper.tolist())) for d in (own[1], its[1]))
    if own[0] != its[0]:
        raise InputError("about", f"an equilibrium of a plant of {its[0]}", f"one of {own[0]}")
    if not its_box <= box:
        raise InputError("about", f"an equilibrium over {its[1]!r}", f"one over the designs of the plant, {own[1]!r}")


def _point(plant: Plant, about: Equilibrium) -> ca.SX:
    """(x, u, w) at rest, as expressions in the design."""
    names = list(plant.design.names)
    x, u = about.function(plant.p[[names.index(name) for name in about.plant.design.names]])
    return ca.vertcat(x, u, ca.SX(ca.DM(about.w)) if plant.nw else ca.SX(0, 1))


def _check_smooth(plant: Plant, J: ca.SX, point: ca.SX) -> None:
    """Raise an `InputError` where a derivative is not finite, or dynamics or outputs jump, at a sample design."""
    given = [plant.x, plant.u, plant.w, plant.p]
    switches = Switches(ca.Function("rows", given, [ca.vertcat(plant.dynamics, plant.outputs)]))
    names = [*(f"the dynamics of {name}" for name in plant.state_names), *plant.output_names]
    function = ca.Function("point", [plant.p], [ca.densify(J), ca.densify(point)])
    for p in plant.design.spread():
        slopes, z = (np.asarray(part, dtype=float) for part in function(p))
        jump = switches.at(z.ravel(), p)
        place = f" at {plant.design.describe(p)}" if plant.design.dim else ""
        if not np.isfinite(slopes).all():
            got = f"a point where a derivative is not finite{place}"
            raise InputError("about", got, "one where the plant is smooth")
        if jump is not None:
            got = f"a point at which {names[jump.row]} jump ({', '.join(jump.names)}){place}"
            raise InputError("about", got, "one where the plant is smooth", SMOOTHER)
