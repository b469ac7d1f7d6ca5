"""Chain of masses, springs and dampers; stiffness and damping are the design."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.library.elements import dry_friction, hardening_spring
from ccdtools.plants.plant import Plant
from ccdtools_ground.door import as_count, as_different, as_flag, as_positive

HARDENING = 5.0  # 1/m², of the real springs
DRY_FRICTION = 0.2  # N, of each real mass
SLIDING = 0.05  # m/s, below which that is smoothed


def mass_chain(n: int = 10, *, mass: float = 1.0, walls: int = 2, driven: Sequence[int] = (1,),
               disturbed: Sequence[int] | None = None, real: bool = False, dt: float = 0.05) -> Plant:  # fmt: skip
    """Chain of `n` equal masses with typical values, linear unless `real`.

    Parameters
    ----------
    n : int
        Number of masses, at least 1.
    mass : float
        Of each [kg].
    walls : {1, 2}
        Whether the chain is held at its beginning or at both ends, by links like the others.
    driven, disturbed : sequences of int
        Numbers (from 1) of the masses that an input and a disturbance push [N]; the last mass is disturbed by default.
    real : bool
        With springs that harden and dry friction under every mass (smoothed).
    dt : float
        Sampling time [s]; the default resolves masses of 1 kg.

    Returns
    -------
    Plant
        x = [positions, speeds], p = [stiffness k, damping c] of every link.
    """
    n = as_count("n", n)
    mass = as_positive("mass", mass, unit="kg")
    if as_count("walls", walls) > 2:
        raise InputError("walls", walls, "1 or 2")
    pushed = as_different("driven", driven, 1, n)
    shaken = as_different("disturbed", (n,) if disturbed is None else disturbed, 1, n)
    real = as_flag("real", real)
    x = ca.SX.sym("x", 2 * n)
    u = ca.SX.sym("u", len(pushed))
    w = ca.SX.sym("w", len(shaken))
    p = ca.SX.sym("p", 2)
    links = _links(x[:n], x[n:], p, walls, real=real)
    forces = links[1:] - links[:-1]
    if real:
        forces -= dry_friction(DRY_FRICTION, x[n:], SLIDING)
    for numbers, given in ((pushed, u), (shaken, w)):
        for j, number in enumerate(numbers):
            forces[number - 1] += given[j]
    design = DesignSpace(["k", "c"], lower=[20.0, 0.1], upper=[200.0, 4.0], units=["N/m", "N·s/m"])
    names = [f"{name} {i + 1} [{unit}]" for name, unit in (("position", "m"), ("speed", "m/s")) for i in range(n)]
    inputs = [f"force on mass {number} [N]" for number in pushed]
    return Plant(x, u, w, p, ca.vertcat(x[n:], forces / mass), design, dt=dt, state_names=names, input_names=inputs)


def _links(q: ca.SX, v: ca.SX, p: ca.SX, walls: int, *, real: bool) -> ca.SX:
    """Tensions (n + 1, 1) of the links; 0 without a second wall."""
    ends = ca.SX(1, 1)
    stretch = ca.vertcat(q, ends) - ca.vertcat(ends, q)
    rate = ca.vertcat(v, ends) - ca.vertcat(ends, v)
    tension = p[1] * rate + (hardening_spring(p[0], stretch, HARDENING) if real else p[0] * stretch)
    if walls == 1:
        tension[-1] = 0
    return ca.densify(tension)
