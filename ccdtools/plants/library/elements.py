"""Elements of real plants, each smooth, zero at rest and passive where the element is."""

from __future__ import annotations

import casadi as ca


def hardening_spring(stiffness: ca.SX, deflection: ca.SX, hardening: float) -> ca.SX:
    """k (d + h d³): `hardening` h [1/m²] of a spring of `stiffness` k at zero deflection."""
    return stiffness * (deflection + hardening * deflection**3)


def asymmetric_damper(damping: ca.SX, rate: ca.SX, asymmetry: float, knee: float) -> ca.SX:
    """c (v + a (√(v² + v₀²) − v₀)): slope c at rest, (1 + a) c in rebound and (1 − a) c in bump beyond the knee v₀."""
    return damping * (rate + asymmetry * (ca.sqrt(rate**2 + knee**2) - knee))


def dry_friction(force: float, speed: ca.SX, knee: float) -> ca.SX:
    """F tanh(v / v₀): Coulomb friction F, smoothed below the speed `knee`; it creeps where a real one sticks."""
    return force * ca.tanh(speed / knee)


def limited(value: ca.SX, limit: float) -> ca.SX:
    """L tanh(v / L): slope one at zero, never beyond ±`limit`."""
    return limit * ca.tanh(value / limit)


def clipped(value: ca.SX, upper: float, rounding: float) -> ca.SX:
    """`value` clipped to [0, upper], its corners rounded over the width `rounding`."""
    return (ca.sqrt(value**2 + rounding**2) - ca.sqrt((value - upper) ** 2 + rounding**2) + upper) / 2


def linear_part(dynamics: ca.SX, x: ca.SX, u: ca.SX, w: ca.SX) -> ca.SX:
    """A x + B u + E w of dynamics with an equilibrium at zero."""
    z = ca.vertcat(x, u, w)
    return ca.densify(ca.substitute(ca.jacobian(dynamics, z), z, ca.DM.zeros(z.shape)) @ z)
