"""Pole on a cart, upright at x = 0; pole length and cart mass designed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import casadi as ca

from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.library.elements import Parameters, dry_friction, given_or_default, limited, linear_part
from ccdtools.plants.plant import Plant
from ccdtools_ground.door import as_flag


@dataclass(frozen=True)
class CartPole(Parameters):
    """Uniform pole on a cart; the last five fields are of the real one.

    Attributes
    ----------
    pole : float
        Mass of the pole [kg].
    friction : float
        Viscous, of the cart [N·s/m].
    gravity : float
        [m/s²].
    pivot_friction : float
        Viscous, of the real pivot [N·m·s].
    dry_friction, sliding : float
        Of the real cart [N], smoothed below a speed [m/s].
    drag : float
        Of the air on the real pole: force at its centre per square of the centre's speed over ground [N·s²/m²].
    force_limit : float
        Of the real motor [N].

    References
    ----------
    "Inverted Pendulum: System Modeling", Control Tutorials for MATLAB and Simulink, University of Michigan: cart
    0.5 kg, pole 0.2 kg, its centre at 0.3 m and its inertia 0.006 kg·m², which is that of a uniform pole of 0.6 m;
    friction 0.1 N·s/m. What the real one has besides is of typical size.
    """

    may_be_zero: ClassVar[tuple[str, ...]] = ("friction", "gravity", "pivot_friction", "dry_friction", "drag")

    pole: float = 0.2
    friction: float = 0.1
    gravity: float = 9.81
    pivot_friction: float = 1e-3
    dry_friction: float = 0.3
    sliding: float = 0.05
    drag: float = 0.01
    force_limit: float = 12.0


def pendulum_on_cart(*, linear: bool = False, real: bool = False, cart: CartPole | None = None,
                     dt: float = 0.02) -> Plant:  # fmt: skip
    """Pole on a cart, without small angles.

    Parameters
    ----------
    linear : bool
        The linearisation about upright instead.
    real : bool
        With friction in the pivot, dry friction of the cart (smoothed), drag of the air and a largest force.
    cart : CartPole, optional
        Masses, friction and what the real one has.
    dt : float
        Sampling time [s].

    Returns
    -------
    Plant
        x = [cart position, cart speed, angle from upright (towards positive positions), its rate], u = force on the
        cart [N], w = horizontal force of the wind at the centre of the pole [N], p = [pole length l, cart mass M].
    """
    cart = given_or_default("cart", cart, CartPole)
    linear = as_flag("linear", linear)
    if as_flag("real", real) and linear:
        raise InputError("linear", True, "False where real=True", "A real plant is not linear.")
    x = ca.SX.sym("x", 4)
    u = ca.SX.sym("u")
    w = ca.SX.sym("w")
    p = ca.SX.sym("p", 2)
    dynamics = _dynamics(x, u, w, p, cart, real=real)
    if linear:
        dynamics = linear_part(dynamics, x, u, w)
    design = DesignSpace(["l", "M"], lower=[0.3, 0.3], upper=[1.2, 1.5], units=["m", "kg"])
    names = ["position [m]", "speed [m/s]", "angle [rad]", "angular rate [rad/s]"]
    return Plant(x, u, w, p, dynamics, design, dt=dt, state_names=names, input_names=["force [N]"])


def _dynamics(x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX, cart: CartPole, *, real: bool) -> ca.SX:
    """Newton's law for horizontal motion and rotation about the pivot."""
    _, speed, angle, rate = ca.vertsplit(x)
    length, mass = ca.vertsplit(p)
    arm = length / 2  # from the pivot to the centre of the pole
    sine = ca.sin(angle)
    cosine = ca.cos(angle)
    push = u
    across, along = w, ca.SX(0)  # horizontal and vertical force at the centre of the pole
    resistance = cart.friction * speed
    torque = ca.SX(0)
    if real:
        push = limited(u, cart.force_limit)
        resistance += dry_friction(cart.dry_friction, speed, cart.sliding)
        torque = -cart.pivot_friction * rate
        sideways = speed + arm * cosine * rate
        falling = -arm * sine * rate
        over_ground = ca.sqrt(sideways**2 + falling**2 + 1e-12)
        across = w - cart.drag * over_ground * sideways
        along = -cart.drag * over_ground * falling
    inertia = cart.pole * length**2 / 12 + cart.pole * arm**2
    coupling = cart.pole * arm * cosine
    total = mass + cart.pole
    forward = push - resistance + across + cart.pole * arm * sine * rate**2
    turning = torque + cart.pole * cart.gravity * arm * sine + arm * (cosine * across - sine * along)
    determinant = total * inertia - coupling**2
    acceleration = (inertia * forward - coupling * turning) / determinant
    angular = (total * turning - coupling * forward) / determinant
    return ca.vertcat(speed, acceleration, rate, angular)
